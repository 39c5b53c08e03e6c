"""Judge designs with the real converters, on machines they were not tuned on."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import qmc

from jaxmodel import status
from jaxmodel.case import Case, Structure
from jaxmodel.metrics import Metrics
from jaxmodel.simulate import Result
from studies.engine.executor import Executor
from studies.engine.plan import even_layout
from studies.engine.poles import PoleReport, pole_report, tracked_modes
from studies.engine.preflight import check_run
from studies.engine.runs import run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.study.cases import as_arrays, build_case, build_cases, in_working_precision
from studies.study.paths import set_values
from studies.study.spec import Study, parse_study
from studies.tuning.evaluate import first_residual, tuned_structure
from studies.tuning.free import PLACEMENT
from studies.tuning.linear_fidelity import LoopFigures, loop_figures
from studies.tuning.merit import (
    Merit,
    all_judged,
    allowed_limits,
    largest,
    merit_of,
    objectives,
    own_limits,
)
from studies.tuning.optimise import excess
from studies.tuning.scenarios import lane_columns, scenario_columns
from studies.tuning.spec import Family, TuneSpec

#: Random designs per chunk.
CHUNK = 256


class JudgedDesign(NamedTuple):
    """One design: on fresh scenarios, machine by machine within each move, and as in its file."""

    objective: np.ndarray  # nan if a run did not finish, (S,)
    metrics: dict[str, np.ndarray]  # largest entry of the links that count, (S,)
    status: np.ndarray  # (S,)
    watched: np.ndarray  # from the end of the command to that of the run [s], (S,)
    loop: LoopFigures | None  # None with other feedback than sampled
    own: OwnRun
    poles: PoleReport | None = None  # where the design's gains follow from poles


class OwnRun(NamedTuple):
    """A design on the machine and move of its own file, as in `studies simulate`."""

    objective: float
    metrics: dict[str, float]
    status: int
    watched: float  # [s]


class Searched(NamedTuple):
    """Random designs of the family with the most free parameters, on the tuning's scenarios."""

    objective: np.ndarray  # nan if a run did not finish, (n,)
    limits: np.ndarray  # largest value over limit - 1 of the metrics with a limit, (n, m)
    peaks: np.ndarray  # largest values, (n, m)
    beyond_loop: np.ndarray  # largest excess over limits of the loop (see `screen`); inf where
    #: other limits are not kept, (n,)
    linear: np.ndarray  # linear residual vibration, nan there [m], (n,)
    residual: np.ndarray  # that of the first scenario's run, nan where not judged by it [m], (n,)
    run_time: float  # of one run, among those of a whole chunk [s]
    runs: int


def tuned_study(spec: TuneSpec, family: Family, values: np.ndarray) -> Study:
    """The study with a family's settings and free parameters.

    Args:
        spec: of the tuning.
        family: what moves.
        values: of all free parameters, (p,).
    """
    study = family.study(spec.study)
    case = _placed(spec, family, study, values)
    names = list(np.array(spec.free.names)[family.is_free])
    whole: dict[str, Any] = {}
    if any(name.startswith(PLACEMENT) for name in names):
        whole["patches.centers"] = case.machine.patches.center
    whole |= {
        name: value
        for name, value in zip(spec.free.names, values, strict=True)
        if name in names and not name.startswith(PLACEMENT)
    }
    return parse_study(set_values(study, {k: np.asarray(x).tolist() for k, x in whole.items()}))


def patch_centers(spec: TuneSpec, family: Family, values: np.ndarray) -> np.ndarray:
    """Where the patches of a design are [m], (3, patches).

    Args:
        spec: of the tuning.
        family: of the design.
        values: of the free parameters, (p,).
    """
    placed = _placed(spec, family, family.study(spec.study), values)
    return np.asarray(placed.machine.patches.center)


def _placed(spec: TuneSpec, family: Family, study: Study, values: np.ndarray) -> Case:
    """A family's study with those of the free parameters (p,) that it moves."""
    case = as_arrays(build_case(study))
    return spec.free.place(case, np.where(family.is_free, values, np.nan))


def fresh_columns(spec: TuneSpec) -> dict[str, np.ndarray]:
    """Scenarios not used in the tuning."""
    scenarios = spec.tune.scenarios
    return scenario_columns(spec, scenarios.check, scenarios.seed + 1, is_fresh=True)


class PlainRuns:
    """Runs with the real converters, many at a time through one program."""

    def __init__(self, structure: Structure, count: int) -> None:
        """
        Args:
            structure: of all runs.
            count: of a batch, about.
        """
        self.structure = structure
        self._layout = even_layout(count)
        self._executor = Executor(structure, self._layout)

    def run(self, cases: Case, count: int) -> Result:
        """Run cases, leaves (count or 1, ...)."""
        cases = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape[1:])), cases)
        parts = []
        for first in range(0, count, self._layout.size):
            rows = np.minimum(first + np.arange(self._layout.size), count - 1)
            part = in_working_precision(jax.tree.map(lambda x, rows=rows: x[rows], cases))
            parts.append(self._executor.start(part).wait())
        return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


def judge(spec: TuneSpec, designs: list[Study], runs: PlainRuns) -> list[JudgedDesign]:
    """Run designs on scenarios not used in the tuning, and as in their own files.

    Args:
        spec: of the tuning.
        designs: studies that differ from the tuning's own only in numbers; its own comes first.
        runs: of `shown_structure`.
    """
    columns = fresh_columns(spec)
    count, merit, structure = len(columns["run.seed"]), merit_of(spec), runs.structure
    parts = [build_cases(study, columns, structure) for study in designs]

    def joined(*leaves: np.ndarray) -> np.ndarray:
        return np.concatenate([np.broadcast_to(x, (count, *x.shape[1:])) for x in leaves])

    result = runs.run(jax.tree.map(joined, *parts), count * len(designs))
    each = [_rows(result.metrics, k * count, count) for k in range(len(designs))]
    duration = structure.n_steps / spec.study.electronics.sample_rate_hz
    own, found = [_own_run(study) for study in designs], []
    for k, (study, metrics) in enumerate(zip(designs, each, strict=True)):
        rows = slice(k * count, (k + 1) * count)
        codes = result.status[rows]
        objective = np.asarray(objectives(merit, metrics, each[0]))
        objective = np.where(np.isin(codes, status.FINISHED), objective, np.nan)
        found.append(
            JudgedDesign(
                objective=objective,
                metrics={name: np.asarray(largest(merit, metrics, name)) for name in merit.shown},
                status=codes,
                watched=duration - result.command_end[rows],
                loop=loop_figures(study) if study.control.feedback == "sampled" else None,
                own=_seen(merit, own[k], own[0], duration),
                poles=_poles(study, own[k]),
            )
        )
    return found


def _poles(study: Study, run: Result | None) -> PoleReport | None:
    """Specified and obtained poles of a design's own file; None if it has none or cannot run."""
    if run is None or not study.control.has_poles or study.control.feedback != "sampled":
        return None
    if run.status == status.UNPLACEABLE:
        return None
    structure, case = check_run(study)
    home = np.array(study.motion.waypoints[0], float)
    loop = loop_report(structure, case, home, tracked_modes(structure))
    return pole_report(structure, case, loop)


def _own_run(study: Study) -> Result | None:
    """The run of a design's own file; None if it cannot run."""
    try:
        return run_study(study, has_record=False, has_loop=False).result
    except StudyError:
        return None


def _seen(merit: Merit, run: Result | None, first: Result | None, duration: float) -> OwnRun:
    """Figures of a run, relative to the baseline's run."""
    if run is None or first is None:
        nothing = dict.fromkeys(merit.shown, float("nan"))
        return OwnRun(float("nan"), nothing, status.NON_FINITE, float("nan"))
    metrics, own = (jax.tree.map(lambda x: np.asarray(x)[None], x.metrics) for x in (run, first))
    return OwnRun(
        float(objectives(merit, metrics, own)[0]),
        {name: float(largest(merit, metrics, name)[0]) for name in merit.shown},
        int(run.status),
        duration - float(run.command_end),
    )


def shown_structure(spec: TuneSpec) -> Structure:
    """Program of the runs shown in a report."""
    return tuned_structure(spec)._replace(metrics=merit_of(spec).shown_metrics)


def _rows(metrics: Metrics, first: int, count: int) -> Metrics:
    return jax.tree.map(lambda x: np.asarray(x)[first : first + count], metrics)


def search(spec: TuneSpec, screen: Any) -> Searched:
    """Run random designs (Sobol points between the bounds) on the scenarios of the tuning.

    Args:
        spec: of the tuning.
        screen: function of values (n, p) of the main family: see `LinearFidelity.screen`.
    """
    family = spec.families[spec.main]
    own_place = spec.free.places()
    n = spec.tune.samples
    points = qmc.Sobol(len(own_place), rng=spec.tune.seed + 1).random(1 << (n - 1).bit_length())
    points = np.where(family.is_free, points[:n], own_place)
    values = np.where(family.is_free, spec.free.values(points), np.nan)
    columns = scenario_columns(spec, spec.tune.scenarios.count, spec.tune.scenarios.seed)
    count, structure = len(columns["run.seed"]), shown_structure(spec)
    lanes = lane_columns(spec, columns, [None, *[family] * CHUNK])
    cases = build_cases(spec.study, lanes, structure)
    layout = even_layout(count * (1 + CHUNK))
    rows = layout.filled(count * (1 + CHUNK))
    cases = in_working_precision(jax.tree.map(lambda x: x if len(x) == 1 else x[rows], cases))
    executor = Executor(structure, layout)
    place, merit = jax.jit(jax.vmap(spec.free.place)), merit_of(spec)

    def split(x: np.ndarray) -> np.ndarray:
        return x[: count * (1 + CHUNK)].reshape((1 + CHUNK, count, *x.shape[1:]))

    found, spent = [], 0.0
    for first in range(0, n, CHUNK):
        part = values[np.minimum(np.arange(first, first + CHUNK), n - 1)]
        part = np.concatenate([np.full((1, part.shape[1]), np.nan), part])
        whole = jax.tree.map(lambda x: np.broadcast_to(x, (layout.size, *x.shape[1:])), cases)
        placed = jax.tree.map(np.asarray, place(whole, part[rows // count]))
        started = time.perf_counter()
        result = jax.tree.map(np.asarray, executor.start(placed).wait())
        spent += time.perf_counter() - started
        metrics = jax.tree.map(split, result.metrics)
        own, others = (jax.tree.map(lambda x, k=k: x[k], metrics) for k in (0, slice(1, None)))
        allowed = allowed_limits(merit, family, own_limits(merit, own))
        judgement = all_judged(merit, others, own, allowed)
        found.append((*map(np.asarray, judgement), first_residual(merit, metrics)[1:]))
    objective, limits, peaks, residual = (np.concatenate(x)[:n] for x in zip(*found, strict=True))
    spent -= executor.compile_time
    beyond, linear = np.full(n, np.inf), np.full(n, np.nan)
    kept = np.isfinite(objective) & (excess(limits) == 0)
    if kept.any():
        beyond[kept], linear[kept] = screen(values[kept])
    run_time = spent / (-(-n // CHUNK) * count * (1 + CHUNK))
    return Searched(
        objective=objective,
        limits=limits,
        peaks=peaks,
        beyond_loop=beyond,
        linear=linear,
        residual=residual,
        run_time=run_time,
        runs=n * count,
    )
