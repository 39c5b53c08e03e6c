"""Disk, phase and delay margins and H-infinity norms of every loop of a chunk, on demand.

See `jaxmodel.robustness`. Loops have `MARGIN_MODES` plant modes or more, at rest at the first
way-point, like those of the gain margin, which tells the unstable ones.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.frequency_response import SampledLoopResponse, response_of_loop
from jaxmodel.laws import LAWS
from jaxmodel.laws.imsc import IMSC
from jaxmodel.loop_figures import MARGINS
from jaxmodel.prepare import prepare
from jaxmodel.robustness import robustness_figures
from studies.engine.plan import padded_rows
from studies.engine.programs import kept_jit
from studies.engine.stability import with_margin_modes

#: Loops per call; each core takes one call after another.
BATCH = 8


def judge_robustness(
    structure: Structure, cases: Case, names: tuple[str, ...], gain_margin: np.ndarray
) -> dict[str, np.ndarray]:
    """Figures of the sampled loops of cases.

    Of a law whose channels act one at a time: the worst of its parts, each judged alone.

    Args:
        structure: of their runs.
        cases: leaves with a leading axis, all cases or 1.
        names: of `jaxmodel.robustness.MARGINS` and `PEAKS`.
        gain_margin: of each loop, below 1 where it is unstable, (n,).

    Returns:
        Each figure, (n,): of an unstable loop 0 for margins and infinite for peaks; NaN where the
        gain margin is.
    """
    if not names:
        return {}
    if structure.feedback != "sampled":
        return {name: np.full(len(gain_margin), np.nan) for name in names}
    found = _of_parts(structure, cases, names, len(gain_margin))
    for name, value in found.items():
        value[gain_margin < 1] = 0.0 if name in MARGINS else np.inf
        value[np.isnan(gain_margin)] = np.nan
    return found


def _of_parts(
    structure: Structure, cases: Case, names: tuple[str, ...], count: int
) -> dict[str, np.ndarray]:
    if not LAWS[structure.law].is_switching:
        return _figures_of(structure, cases, names, count)
    alone, parts = structure._replace(law=IMSC.name), []
    for j in range(structure.n_controlled):
        mask = cases.control.mode_mask * (np.arange(structure.n_controlled) == j)
        part = cases._replace(control=cases.control._replace(mode_mask=mask))
        parts.append(_figures_of(alone, part, names, count))
    worst = {True: np.min, False: np.max}
    return {name: worst[name in MARGINS]([part[name] for part in parts], axis=0) for name in names}


def _figures_of(
    structure: Structure, cases: Case, names: tuple[str, ...], count: int
) -> dict[str, np.ndarray]:
    structure, cases = with_margin_modes(structure, cases)
    whole = jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x)[1:])), cases)
    rows = padded_rows(count, BATCH)
    parts = np.split(rows, len(rows) // BATCH)

    def judge(part: np.ndarray) -> dict[str, np.ndarray]:
        response = _responses(structure, jax.tree.map(lambda x: x[part], whole))
        return jax.tree.map(np.asarray, _figures(names, response))

    with ThreadPoolExecutor(len(jax.local_devices())) as pool:
        judged = list(pool.map(judge, parts))
    return {name: np.concatenate([part[name] for part in judged])[:count] for name in names}


# compiled without optimisation: it takes a fraction of the time
@kept_jit(static_argnums=0, compiler_options={"xla_backend_optimization_level": 0})
def _responses(structure: Structure, cases: Case) -> SampledLoopResponse:
    def one(case: Case) -> SampledLoopResponse:
        loop = prepare(structure, case).loop
        return response_of_loop(structure, case, loop, case.path.waypoints[0])

    return jax.vmap(one)(cases)


@kept_jit(static_argnums=0)
def _figures(names: tuple[str, ...], responses: SampledLoopResponse) -> dict[str, Any]:
    return jax.lax.map(lambda response: robustness_figures(response, names), responses)
