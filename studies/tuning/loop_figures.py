"""Figures of the linearised sampled loops of designs on some machines, by eigenvalues on the host.

Without derivatives: for what a tuning is measured against, and for its results. The plant has at
least 12 modes, because uncontrolled modes limit the gains.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.kinematics import singularity_distance
from jaxmodel.loop_figures import MARGIN_MODES, MARGINS, PEAKS
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import LoopMatrices, closed_loop, spillover
from studies.engine.columns import ON_DEMAND
from studies.engine.eigenvalues import eigenvalues
from studies.engine.programs import kept_jit
from studies.engine.robustness import judge_robustness
from studies.engine.stability import gain_margin
from studies.study.cases import as_arrays, build_structure
from studies.study.fields import Columns
from studies.study.numbers import build_cases
from studies.study.paths import parts_of
from studies.study.spec import Study
from studies.threads import serial_blas
from studies.tuning.spec import BASELINE, LOWER, TuneSpec

#: Points of each straight move at which its distance from singularities is evaluated.
PATH_POINTS = 17
#: Units of all figures.
LOOP_UNITS = {
    "gain_margin": "1",
    "slowest_decay": "s-1",
    "spillover": "1",
    "singularity_distance": "rad",
    **{name: unit for name, (unit, _) in ON_DEMAND.items()},
}
#: Figures that every design has.
ALWAYS = ("gain_margin", "slowest_decay", "spillover", "singularity_distance")


class DesignFigures(NamedTuple):
    """Figures of a design, on the host."""

    gain_margin: float  # largest factor on all gains with every smaller one stable [1]
    slowest_decay: float  # [1/s]
    spillover: float  # see `jaxmodel.sampled_loop.spillover` [1]
    singularity_distance: float  # [rad]
    # of `jaxmodel.robustness`, nan where neither the objective nor a limit names them
    disk_margin: float = np.nan  # [1]
    phase_margin: float = np.nan  # [deg]
    delay_margin: float = np.nan  # [samples]
    sensitivity_peak: float = np.nan  # [1]
    control_effort_peak: float = np.nan  # [1]
    disturbance_deflection_peak: float = np.nan  # [m/N]


def with_margin_modes(study: Study) -> Study:
    """The study with the number of plant modes used to judge its loop."""
    return study.change(link__modes=max(MARGIN_MODES, study.link.modes))


def judged_structure(spec: TuneSpec, study: Study) -> Structure:
    """Program of the linearised loop of a study's law and drive."""
    structure = build_structure(with_margin_modes(study)).without_run()
    return structure._replace(has_position_gain=spec.has_position_gain(parts_of(study)))


def loop_figures(spec: TuneSpec, study: Study) -> DesignFigures:
    """Figures of a design's loop on the machine of its own file.

    Args:
        spec: of the tuning; its designs of one law and drive share a program.
        study: one of them, with sampled feedback.
    """
    names = tuple(dict.fromkeys((*ALWAYS, *spec.loop_names)))
    figures = machine_figures(spec, study, {"run.seed": np.array([study.run.seed])}, names)
    return DesignFigures(**{name: float(value[0]) for name, value in figures.items()})


def machine_figures(
    spec: TuneSpec, study: Study, columns: Columns, names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Figures of a design's loops on some machines.

    Args:
        spec: of the tuning.
        study: the design.
        columns: in what machines differ from it, (machines, ...) each.
        names: of `LOOP_LIMITS`; those of `OF_LOOP` need sampled feedback.

    Returns:
        Each figure, (machines,).
    """
    structure, count = judged_structure(spec, study), len(next(iter(columns.values())))
    return figures_of_cases(
        structure, build_cases(with_margin_modes(study), columns, structure), names, count
    )


def figures_of_cases(
    structure: Structure, cases: Case, names: tuple[str, ...], count: int
) -> dict[str, np.ndarray]:
    """Figures of loops, (count,) each.

    Args:
        structure: from `judged_structure`.
        cases: leaves with a leading axis, all cases or 1.
        names: of `LOOP_LIMITS`; margins of unstable loops are 0, their peaks infinite. Figures of
            loops whose controller does not exist are nan.
        count: number of cases.
    """
    of_response = tuple(name for name in names if name in (*MARGINS, *PEAKS))
    plain = {name for name in names if name not in of_response}
    plain |= {"slowest_decay"} if of_response else set()

    def judge(k: int) -> dict[str, float]:
        one = jax.tree.map(lambda x: x[k % len(x)], cases)
        return _figures_of_case(structure, as_arrays(one), plain)

    with serial_blas(), ThreadPoolExecutor(os.cpu_count()) as pool:
        each = list(pool.map(judge, range(count if plain else 0)))
    figures = {name: np.array([one[name] for one in each]) for name in plain}
    if of_response:
        decay = figures["slowest_decay"]
        is_stable = np.where(np.isnan(decay), np.nan, decay > 0)
        figures |= judge_robustness(structure, cases, of_response, is_stable)
    return {name: figures[name] for name in names}


def _figures_of_case(structure: Structure, case: Case, names: set[str]) -> dict[str, float]:
    figures: dict[str, float] = {}
    if "singularity_distance" in names:
        figures["singularity_distance"] = float(_distance(structure, case))
    if names == set(figures):
        return figures
    matrices = _closed_loop(structure, case)
    open_loop, feedback = np.asarray(matrices.open), np.asarray(matrices.feedback)
    if not (np.isfinite(open_loop).all() and np.isfinite(feedback).all()):
        return dict.fromkeys(names, np.nan)

    def poles(factor: float) -> np.ndarray:
        return eigenvalues(open_loop + factor * feedback)

    if "gain_margin" in names:
        figures["gain_margin"] = gain_margin(poles)
    if "slowest_decay" in names:
        radius = np.abs(poles(1.0)).max()
        figures["slowest_decay"] = float(-np.log(radius) / float(case.electronics.period))
    if "spillover" in names:
        figures["spillover"] = float(_spillover(structure, case, matrices))
    return figures


def distance_of_path(structure: Structure, case: Case) -> Array:
    """Distance of the straight lines between way-points from singularities [rad], ()."""
    points, share = case.path.waypoints, jnp.linspace(0.0, 1.0, PATH_POINTS)[:, None, None]
    line = points[:-1] + share * (points[1:] - points[:-1])
    pose = jnp.concatenate([points, jnp.reshape(line, (-1, points.shape[-1]))])
    return singularity_distance(prepare(structure, case).loop.plant, pose)


@kept_jit(static_argnums=0)
def _closed_loop(structure: Structure, case: Case) -> LoopMatrices:
    return closed_loop(structure, case, case.path.waypoints[0])


_spillover = kept_jit(static_argnums=0)(spillover)
_distance = kept_jit(static_argnums=0)(distance_of_path)


def term_values(
    names: tuple[str, ...], figures: Mapping[str, np.ndarray], of_scenario: np.ndarray
) -> np.ndarray:
    """Figures of loops as terms of an objective, nan where a loop is unstable, (S, t).

    Args:
        names: of `LOOP_TERMS`.
        figures: of each, (machines,), `slowest_decay` among them if there are any.
        of_scenario: machine of each scenario, (S,).
    """
    if not names:
        return np.zeros((len(of_scenario), 0))
    values = np.stack([figures[name] for name in names], axis=1)
    return np.where(figures["slowest_decay"][:, None] > 0, values, np.nan)[of_scenario]


def with_decay(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names with that of the figure which tells unstable loops, if there are any."""
    return tuple(dict.fromkeys((*names, "slowest_decay"))) if names else ()


def relative_margin(name: str, values: Array, allowed: Array) -> float:
    """How far a figure is from its limit on the worst machine, as a share of it.

    Args:
        name: of `LOOP_LIMITS`.
        values: on each machine, (machines,) or ().
        allowed: the limit, there or on all.

    Returns:
        Negative where the limit is violated.
    """
    share = np.asarray(values) / allowed - 1
    return float(np.min(share if name in LOWER else -share))


def worst_value(name: str, values: np.ndarray) -> float:
    """A figure (machines,) on the worst machine."""
    return float(np.min(values) if name in LOWER else np.max(values))


def unit_text(name: str) -> str:
    """Unit of a figure as a report shows it."""
    return LOOP_UNITS[name].replace("s-1", "1/s")


def allowed_on(limit: float | str, baseline: Array) -> Array:
    """A limit on each machine, where the baseline has these figures, (machines,)."""
    return baseline if limit == BASELINE else np.full(np.shape(baseline), float(limit))
