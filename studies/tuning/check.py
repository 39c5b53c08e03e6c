"""Judge designs with the real converters, on machines they were not tuned on."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy

from jaxmodel import status
from jaxmodel.case import Case, Structure
from jaxmodel.numbers import in_working_precision
from jaxmodel.simulate import RunResult
from studies.engine.executor import Executor
from studies.engine.plan import even_layout
from studies.engine.poles import PoleReport, pole_report, tracked_modes
from studies.engine.preflight import check_run
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.study.cases import build_structure
from studies.study.numbers import build_cases, one_study, study_numbers
from studies.study.paths import Parts, parts_of, set_values
from studies.study.spec import Study, parse_study
from studies.tuning.evaluate import first_residual, tuned_structure
from studies.tuning.free import PLACEMENT
from studies.tuning.linear_fidelity import LinearFidelity
from studies.tuning.loop_figures import (
    DesignFigures,
    loop_figures,
    machine_figures,
    term_values,
    with_decay,
)
from studies.tuning.objective import (
    ScenarioFigures,
    allowed_limits,
    baseline_limits,
    judge_designs,
    largest,
    objective_of,
    objectives,
)
from studies.tuning.optimise import KEPT, excess
from studies.tuning.plain_runs import PlainRuns, baseline_runs
from studies.tuning.scenarios import (
    LoopMachines,
    lane_columns,
    loop_machines,
    scenario_columns,
    tuned_machines,
)
from studies.tuning.spec import Family, TuneSpec

#: Random designs per chunk.
CHUNK = 256


class JudgedDesign(NamedTuple):
    """One design: on fresh scenarios, machine by machine within each move, and as in its file."""

    #: nan if a run did not finish or a loop in the objective is unstable, (S,)
    objective: np.ndarray
    metrics: dict[str, np.ndarray]  # largest entry of the links that count, (S,)
    status: np.ndarray  # (S,)
    watched: np.ndarray  # from the end of the command to that of the run [s], (S,)
    loop: DesignFigures | None  # None with other feedback than sampled
    own_run: OwnRun
    poles: PoleReport | None = None  # where the design's gains follow from poles
    #: `TuneSpec.loop_names` on the machines of the tuning and on fresh ones, (machines,) each
    tuned_loop: Mapping[str, np.ndarray] = MappingProxyType({})
    fresh_loop: Mapping[str, np.ndarray] = MappingProxyType({})


class OwnRun(NamedTuple):
    """A design on the machine and move of its own file, as in `studies simulate`."""

    objective: float
    metrics: dict[str, float]
    status: int
    watched: float  # [s]


class RandomSearch(NamedTuple):
    """Random designs of the family with the most free parameters, on the tuning's scenarios."""

    #: nan if a run did not finish or a loop in the objective is unstable, (n,)
    objective: np.ndarray
    limits: np.ndarray  # largest value over limit - 1 of the metrics with a limit, (n, m)
    peaks: np.ndarray  # largest values, (n, m)
    #: largest excess over limits of the loop on the machines of the tuning, as a share, or by
    #: `screen` where that is larger; inf where other limits are not kept, (n,)
    beyond_loop: np.ndarray
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
    case = _tuned_case(spec, family, study, values)
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
    case = _tuned_case(spec, family, family.study(spec.study), values)
    return np.asarray(case.machine.patches.center)


def _tuned_case(spec: TuneSpec, family: Family, study: Study, values: np.ndarray) -> Case:
    """A family's study with those of the free parameters (p,) that it moves."""
    structure = build_structure(study)
    values = np.where(family.is_free, values, np.nan)
    return spec.free.build(structure)(one_study(study, structure), values)


def fresh_columns(spec: TuneSpec) -> dict[str, np.ndarray]:
    """Scenarios not used in the tuning."""
    scenarios = spec.tune.scenarios
    return scenario_columns(spec, scenarios.check, scenarios.seed + 1, is_fresh=True)


class PartRuns:
    """`PlainRuns` of each law and drive, made when they are needed."""

    def __init__(self, spec: TuneSpec, count: int) -> None:
        """
        Args:
            spec: of the tuning.
            count: of a batch, about.
        """
        self._spec, self._count = spec, count
        self._programs: dict[Parts, PlainRuns] = {}

    def of(self, parts: Parts) -> PlainRuns:
        """Those of one law and drive."""
        if parts not in self._programs:
            self._programs[parts] = PlainRuns(shown_structure(self._spec, parts), self._count)
        return self._programs[parts]


def judge(spec: TuneSpec, designs: list[Study], runs: PartRuns) -> list[JudgedDesign]:
    """Run designs on scenarios not used in the tuning, and as in their own files.

    Args:
        spec: of the tuning.
        designs: studies that differ from the tuning's own only in numbers, law and drive; its own
            comes first.
        runs: of the tuning.
    """
    columns, goal = fresh_columns(spec), objective_of(spec)
    count = len(columns["run.seed"])
    by_design = _run_designs(designs, columns, runs)
    fresh = loop_machines(spec, columns)
    loops = [_loops(spec, study, fresh) for study in designs]
    terms = np.stack([_terms(spec, loop, fresh) for loop in loops])
    measured = ScenarioFigures(by_design.metrics, terms)
    baseline = jax.tree.map(lambda x: x[0], measured)
    end = runs.of(spec.parts()).structure.n_steps / spec.study.electronics.sample_rate_hz
    judged = []
    for k, loop in enumerate(loops):
        of_design = jax.tree.map(lambda x, k=k: x[k], measured)
        codes, watched = by_design.status[k], end - by_design.command_end[k]
        objective = np.asarray(objectives(goal, of_design, baseline))
        values = {name: np.asarray(largest(goal, of_design.metrics, name)) for name in goal.shown}
        judged.append(
            JudgedDesign(
                objective=np.where(np.isin(codes, status.FINISHED), objective, np.nan)[:count],
                metrics={name: x[:count] for name, x in values.items()},
                status=codes[:count],
                watched=watched[:count],
                loop=loop.file,
                own_run=OwnRun(
                    objective=float(objective[count]),
                    metrics={name: float(x[count]) for name, x in values.items()},
                    status=int(codes[count]),
                    watched=float(watched[count]),
                ),
                tuned_loop=loop.tuned,
                fresh_loop=loop.fresh,
            )
        )
    return [_with_poles(study, design) for study, design in zip(designs, judged, strict=True)]


class _DesignLoops(NamedTuple):
    """Figures of a design's loops."""

    file: DesignFigures | None  # as in its file; None with other feedback than sampled
    tuned: dict[str, np.ndarray]  # on the machines of the tuning, (machines,)
    fresh: dict[str, np.ndarray]  # on fresh ones, (machines,)


def _loops(spec: TuneSpec, study: Study, fresh: LoopMachines) -> _DesignLoops:
    names = spec.loop_names
    of_fresh = tuple(dict.fromkeys((*names, *with_decay(spec.loop_terms))))
    return _DesignLoops(
        file=loop_figures(spec, study) if study.control.feedback == "sampled" else None,
        tuned=machine_figures(spec, study, tuned_machines(spec).columns, names) if names else {},
        fresh=machine_figures(spec, study, fresh.columns, of_fresh) if names else {},
    )


def _terms(spec: TuneSpec, loop: _DesignLoops, fresh: LoopMachines) -> np.ndarray:
    """Terms of the objective in fresh scenarios, then as in the design's file, (S + 1, t)."""
    names, count = spec.loop_terms, len(fresh.of_scenario)
    if loop.file is None or not names:
        return np.zeros((count + 1, 0))
    file = {name: np.array([getattr(loop.file, name)]) for name in with_decay(names)}
    return np.concatenate(
        [
            term_values(names, loop.fresh, fresh.of_scenario),
            term_values(names, file, np.zeros(1, int)),
        ]
    )


def _run_designs(designs: list[Study], columns: dict[str, np.ndarray], runs: PartRuns) -> RunResult:
    """Runs of designs in scenarios, then as in their own files; (designs, scenarios + 1, ...)."""
    every, count = [parts_of(study) for study in designs], len(columns["run.seed"])
    order, results = [], []
    for parts in dict.fromkeys(every):
        program, chosen = runs.of(parts), [k for k, x in enumerate(every) if x == parts]
        lanes = []
        for k in chosen:
            fresh, file = (build_cases(designs[k], x, program.structure) for x in (columns, {}))
            lanes += [_repeat(fresh, count), _repeat(file, 1)]
        rows = len(chosen) * (count + 1)
        result = program.run(jax.tree.map(lambda *x: np.concatenate(x), *lanes), rows)
        shape = len(chosen), count + 1
        results.append(jax.tree.map(lambda x, n=shape: x.reshape(*n, *x.shape[1:]), result))
        order += chosen
    back = np.argsort(order)
    whole: RunResult = jax.tree.map(lambda *x: np.concatenate(x)[back], *results)
    return whole


def _repeat(cases: Case, count: int) -> Case:
    return jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape[1:])), cases)


def _with_poles(study: Study, judged: JudgedDesign) -> JudgedDesign:
    """With poles, where gains follow from them; without an own run that would be refused."""
    try:
        structure, case = check_run(study)
    except StudyError:
        nothing = dict.fromkeys(judged.own_run.metrics, np.nan)
        return judged._replace(own_run=OwnRun(np.nan, nothing, status.NON_FINITE, np.nan))
    has_loop = structure.feedback == "sampled" and judged.own_run.status != status.UNPLACEABLE
    if not study.control.has_poles or not has_loop:
        return judged
    home = np.array(study.motion.waypoints[0], float)
    loop = loop_report(structure, case, home, tracked_modes(structure))
    return judged._replace(poles=pole_report(structure, case, loop))


def shown_structure(spec: TuneSpec, parts: Parts) -> Structure:
    """Program of the runs of one law and drive shown in a report."""
    return tuned_structure(spec, parts)._replace(metrics=objective_of(spec).shown_metrics)


def search(spec: TuneSpec, linear: LinearFidelity, position: int) -> RandomSearch:
    """Run random designs (Sobol points between the bounds) on the scenarios of the tuning.

    Args:
        spec: of the tuning.
        linear: of its designs.
        position: index of a design of the main family among them.
    """
    family = spec.families[spec.main]
    own_place = spec.free.places()
    n = spec.tune.samples
    sobol = scipy.stats.qmc.Sobol(len(own_place), rng=spec.tune.seed + 1)
    points = sobol.random(1 << (n - 1).bit_length())
    points = np.where(family.is_free, points[:n], own_place)
    values = np.where(family.is_free, spec.free.values(points), np.nan)
    columns = scenario_columns(spec, spec.tune.scenarios.count, spec.tune.scenarios.seed)
    parts = spec.parts(family)
    count, structure = len(columns["run.seed"]), shown_structure(spec, parts)
    is_own = parts == spec.parts()
    measure = None
    if not is_own:
        measure = baseline_runs(spec, shown_structure(spec, spec.parts()), columns).metrics
    lanes = lane_columns(spec, columns, [None if is_own else family, *[family] * CHUNK])
    numbers = study_numbers(spec.study, structure, lanes)
    layout = even_layout(count * (1 + CHUNK))
    rows = layout.filled(count * (1 + CHUNK))
    numbers = in_working_precision(jax.tree.map(lambda x: x if len(x) == 1 else x[rows], numbers))
    executor = Executor(structure, layout)
    build, goal = jax.jit(jax.vmap(spec.free.build(structure))), objective_of(spec)

    def split(x: np.ndarray) -> np.ndarray:
        return x[: count * (1 + CHUNK)].reshape((1 + CHUNK, count, *x.shape[1:]))

    batches, spent = [], 0.0
    for first in range(0, n, CHUNK):
        part = values[np.minimum(np.arange(first, first + CHUNK), n - 1)]
        terms = linear.plain_terms(position, part)
        part = np.concatenate([np.full((1, part.shape[1]), np.nan), part])
        whole = jax.tree.map(lambda x: np.broadcast_to(x, (layout.size, *x.shape[1:])), numbers)
        cases = jax.tree.map(np.asarray, build(whole, part[rows // count]))
        started = time.perf_counter()
        result = jax.tree.map(np.asarray, executor.start(cases).wait())
        spent += time.perf_counter() - started
        metrics = jax.tree.map(split, result.metrics)
        baseline, others = (jax.tree.map(lambda x, k=k: x[k], metrics) for k in (0, slice(1, None)))
        baseline = baseline if measure is None else measure
        allowed = allowed_limits(goal, family, baseline_limits(goal, baseline))
        measured = ScenarioFigures(others, terms), ScenarioFigures(baseline, linear.baseline_terms)
        judgement = judge_designs(goal, *measured, allowed)
        batches.append((*map(np.asarray, judgement), first_residual(goal, metrics)[1:]))
    objective, limits, peaks, residual = (np.concatenate(x)[:n] for x in zip(*batches, strict=True))
    spent -= executor.compile_time
    beyond, residuals = np.full(n, np.inf), np.full(n, np.nan)
    kept = np.isfinite(objective) & (excess(limits) == 0)
    if kept.any():
        beyond[kept], residuals[kept] = linear.screen(position, values[kept])
        passed = kept & (beyond <= KEPT)
        beyond[passed] = np.maximum(beyond[passed], linear.beyond(position, values[passed]))
    run_time = spent / (-(-n // CHUNK) * count * (1 + CHUNK))
    return RandomSearch(
        objective=objective,
        limits=limits,
        peaks=peaks,
        beyond_loop=beyond,
        linear=residuals,
        residual=residual,
        run_time=run_time,
        runs=n * count,
    )
