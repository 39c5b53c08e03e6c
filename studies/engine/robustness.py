"""Disk, phase and delay margins and H-infinity norms of every loop of a chunk.

See `jaxmodel.robustness`. Loops have `MARGIN_MODES` plant modes or more, at rest at the first
way-point, like those of the gain margin, which tells the unstable ones. Margins are searched in
NumPy, several loops at once; norms by a compiled program.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.judge import with_margin_modes
from jaxmodel.laws import LAWS
from jaxmodel.loop import Loop
from jaxmodel.loop_figures import MARGINS, MOST_DELAY, MOST_PHASE, PEAKS
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import assembled_modes
from jaxmodel.robustness import MarginPlace, norm_peaks
from jaxmodel.sampled_loop import DelayedParts, delayed_parts
from jaxmodel.sampled_response import SampledLoopResponse, response_of_loop
from studies.config import hosts
from studies.engine.crossings import delay_margins, phase_margins
from studies.engine.delay_check import DelayedLoops, checked_delays
from studies.engine.disk_margin import LARGEST, disk_margins
from studies.engine.loop_gain import LoopGains, acting_commands, loop_gains
from studies.engine.margin_grid import GridGain, search_grid
from studies.engine.plan import in_parts
from studies.engine.programs import kept_jit
from studies.engine.stability import modes_alone

#: Loops per call; each core takes one call after another.
BATCH = 8
#: How each margin is searched, and what it is where no command acts.
SEARCHES: dict[str, tuple[Callable[[LoopGains, GridGain, bool], MarginPlace], float]] = {
    "disk_margin": (disk_margins, LARGEST),
    # always as exact as derivatives need
    "phase_margin": (lambda loops, grid, _: phase_margins(loops, grid), MOST_PHASE),
    "delay_margin": (lambda loops, grid, _: delay_margins(loops, grid), MOST_DELAY),
}


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
    count = len(gain_margin)
    found = {name: np.full(count, np.nan) for name in names}
    if not names or structure.feedback != "sampled":
        return found
    for name, value in found.items():
        value[gain_margin < 1] = 0.0 if name in MARGINS else np.inf
    rows = np.flatnonzero(gain_margin >= 1)
    if len(rows):
        stable = jax.tree.map(lambda x: x if len(x) == 1 else x[rows], cases)
        for name, value in _of_parts(structure, stable, names, len(rows)).items():
            found[name][rows] = value
    return found


def _of_parts(
    structure: Structure, cases: Case, names: tuple[str, ...], count: int
) -> dict[str, np.ndarray]:
    if not LAWS[structure.law].is_switching:
        return _figures_of(structure, cases, names, count)
    parts = [_figures_of(*alone, names, count) for alone in modes_alone(structure, cases)]
    worst = {True: np.min, False: np.max}
    return {name: worst[name in MARGINS]([part[name] for part in parts], axis=0) for name in names}


def _figures_of(
    structure: Structure, cases: Case, names: tuple[str, ...], count: int
) -> dict[str, np.ndarray]:
    structure, cases = with_margin_modes(structure, cases)
    whole = jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x)[1:])), cases)
    has_delay = "delay_margin" in names and not LAWS[structure.law].is_switching

    def judge(part: np.ndarray) -> dict[str, np.ndarray]:
        some = jax.tree.map(lambda x: x[part], whole)
        response, modes, parts = _responses(structure, has_delay, some)
        places = find_margins(response, modes, tuple(x for x in names if x in MARGINS))
        margins = {name: place.value for name, place in places.items()}
        if parts is not None:
            loops = DelayedLoops.of(parts, some.electronics)
            margins["delay_margin"] = checked_delays(loops, margins["delay_margin"])
        return margins | _peaks_of(response, tuple(x for x in names if x in PEAKS))

    judged: dict[str, np.ndarray] = in_parts(judge, count, BATCH, len(hosts()))
    return judged


def _peaks_of(response: SampledLoopResponse, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """H-infinity norms, NaN where a number of the response is not finite."""
    if not names:
        return {}
    is_finite = _are_finite(jax.tree.map(np.asarray, response))
    peaks = _figures(names, response)
    return {name: np.where(is_finite, np.asarray(peak), np.nan) for name, peak in peaks.items()}


def _are_finite(tree: Any) -> np.ndarray:
    """Which loops have finite numbers only, of leaves (n, ...), (n,)."""
    leaves = [x.reshape(len(x), -1) for x in jax.tree.leaves(tree)]
    return np.all([np.isfinite(x).all(axis=1) for x in leaves], axis=0)


def find_margins(
    response: SampledLoopResponse,
    modes: tuple[Array, Array],
    names: tuple[str, ...],
    is_fine: bool = False,
) -> dict[str, MarginPlace]:
    """Margins of stable loops and where they are, (n,) each; NaN where a number is not finite.

    Args:
        response: leaves (n, ...).
        modes: frequencies [rad/s] and decay [1/s] of the machines' modes, (n, k) each.
        names: of `MARGINS`.
        is_fine: places as exact as derivatives need.
    """
    # loops near the edge need more than single precision
    response, modes = jax.tree.map(lambda x: np.asarray(x, float), (response, modes))
    is_finite = _are_finite((response, modes))
    acting, count = np.asarray(acting_commands(response.controller)), len(is_finite)
    found = {
        name: MarginPlace(np.full(count, np.nan), np.ones(count), np.ones(count)) for name in names
    }
    for pattern in np.unique(acting[is_finite], axis=0) if names else ():
        rows = np.flatnonzero(is_finite & np.all(acting == pattern, axis=1))
        if not pattern.any():
            for name in names:
                found[name].value[rows] = SEARCHES[name][1]
            continue
        part, (omega, decay) = jax.tree.map(lambda x, rows=rows: x[rows], (response, modes))
        loops = loop_gains(part)
        grid = search_grid(loops, omega, decay)
        for name in names:
            places = SEARCHES[name][0](loops, grid, is_fine)
            for array, each in zip(found[name], places, strict=True):
                array[rows] = each
    return found


@kept_jit(static_argnums=(0, 1), is_quick=True)
def _responses(
    structure: Structure, has_delay: bool, cases: Case
) -> tuple[SampledLoopResponse, tuple[Array, Array], DelayedParts | None]:
    """What the searches read of each loop, and if wanted the check of its delay margin."""

    def one(case: Case) -> tuple[SampledLoopResponse, tuple[Array, Array], DelayedParts | None]:
        loop, pose = prepare(structure, case).loop, case.path.waypoints[0]
        parts = delayed_parts(structure, case, loop, pose) if has_delay else None
        return *response_and_modes(structure, case, loop, pose), parts

    return jax.vmap(one)(cases)


def response_and_modes(
    structure: Structure, case: Case, loop: Loop, pose: Array
) -> tuple[SampledLoopResponse, tuple[Array, Array]]:
    """What `find_margins` reads of a prepared loop about rest at a pose."""
    response = response_of_loop(structure, case, loop, pose)
    modes = assembled_modes(response.plant)
    return response, (modes.omega, modes.decay)


@kept_jit(static_argnums=0)
def _figures(names: tuple[str, ...], responses: SampledLoopResponse) -> dict[str, Any]:
    return jax.lax.map(lambda response: norm_peaks(response, names), responses)
