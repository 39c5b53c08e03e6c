"""What a tuned design has to beat: no control at all, and the best `control.gain_factor` alone.

The gain factor is scanned on the scenarios of the tuning, under its limits, by plain runs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.frame import frame_of
from studies.engine.preflight import check_run
from studies.show.units import number, readable
from studies.study.entries import parse_entries
from studies.study.numbers import build_cases
from studies.study.resolution import is_deflection, least_step, resolution_text
from studies.study.spec import Study
from studies.tuning.check import JudgedDesign, PartRuns, judge
from studies.tuning.loop_figures import (
    DesignFigures,
    allowed_on,
    machine_figures,
    relative_margin,
    term_values,
    unit_text,
    with_decay,
)
from studies.tuning.objective import (
    ScenarioFigures,
    allowed_limits,
    baseline_limits,
    judge_designs,
    objective_of,
)
from studies.tuning.optimise import KEPT, excess
from studies.tuning.plain_runs import PlainRuns
from studies.tuning.scenarios import fresh_machines, lane_columns, scenario_columns, tuned_machines
from studies.tuning.spec import BASELINE, Family, TuneSpec

FIELD = "control.gain_factor"
#: Values that are scanned: this many between these multiples of the baseline's, and that itself.
COUNT, LOWEST, HIGHEST = 23, 0.05, 8.0
#: Most that `control.gain_factor` may be [1].
MOST = 1e3
#: Headings of the reference designs.
WITHOUT, ALONE = "without control", "gain_factor alone"


class GainScan(NamedTuple):
    """The gain factor alone, on the scenarios of the tuning."""

    gain_factor: np.ndarray  # ascending [1], (n,)
    #: nan if a run did not finish or a loop in the objective is unstable, (n,)
    objective: np.ndarray
    excess: np.ndarray  # largest violation of the limits on metrics, 0 where kept, (n,)
    best: int  # the least objective that keeps all limits; -1 if none does


class References(NamedTuple):
    """What a tuned design has to beat; None where it does not apply."""

    uncontrolled: JudgedDesign | None
    scan: GainScan | None
    gain_alone: JudgedDesign | None  # the best of the scan
    adc_step: np.ndarray | None  # of the baseline, in the deflection of mode 1 [m], (3,)

    @property
    def designs(self) -> list[tuple[str, JudgedDesign]]:
        """Those there are, by their headings."""
        pairs = (WITHOUT, self.uncontrolled), (ALONE, self.gain_alone)
        return [(name, design) for name, design in pairs if design is not None]


def compare(
    spec: TuneSpec, designs: list[Study], say: Callable[[str], None]
) -> tuple[JudgedDesign, list[JudgedDesign], References]:
    """Judge designs, and what they have to beat.

    Args:
        spec: of the tuning.
        designs: the baseline, then the best design of every family.
        say: called before each stage.

    Returns:
        The baseline, the best designs, and what they have to beat.
    """
    fresh, is_on = spec.tune.scenarios.check * len(spec.moves), spec.study.is_controlled
    runs = PartRuns(spec, (fresh + 1) * (len(designs) + 2))
    if is_on:
        say(f"{FIELD} alone, for comparison")
    scan = scan_gain(spec, runs.of(spec.parts()))
    others = {}
    if is_on:
        others[WITHOUT] = spec.study.uncontrolled()
    if scan is not None and scan.best >= 0:
        others[ALONE] = gain_study(spec, scan.gain_factor[scan.best])
    say(f"the results on {fresh} fresh scenarios")
    baseline, *judged = judge(spec, [*designs, *others.values()], runs)
    count = len(designs) - 1
    compared = dict(zip(others, judged[count:], strict=True))
    if WITHOUT in compared:
        nothing: dict[str, np.ndarray] = {}
        compared[WITHOUT] = compared[WITHOUT]._replace(
            loop=None, poles=None, tuned_loop=nothing, fresh_loop=nothing
        )
    has_adc = is_on and spec.study.control.feedback == "sampled"
    step = frame_of(*check_run(spec.study)).adc_step if has_adc else None
    references = References(compared.get(WITHOUT), scan, compared.get(ALONE), step)
    return baseline, judged[:count], references


def scan_gain(spec: TuneSpec, runs: PlainRuns) -> GainScan | None:
    """Scan the gain factor alone.

    Args:
        spec: of the tuning.
        runs: of the baseline's law and drive.

    Returns:
        None where it is the only free parameter, or has no effect.
    """
    scenarios, start = spec.tune.scenarios, spec.study.control.gain_factor
    others = {*scenarios.spread, *scenarios.machines, *scenarios.each}
    is_tuned_alone = set(spec.free.names) == {FIELD}
    if not spec.study.is_controlled or start == 0 or is_tuned_alone or FIELD in others:
        return None
    values = start * np.append(np.geomspace(LOWEST, HIGHEST, COUNT), 1.0)
    values = np.unique(np.minimum(values, MOST))
    objective, beyond = _evaluate(spec, runs, values)
    is_known = np.isfinite(objective)
    if not is_known.any() or np.ptp(objective[is_known]) == 0:
        return None
    order = np.argsort(objective, kind="stable")  # nan last
    kept = (k for k in order if is_known[k] and beyond[k] == 0 and _keeps_loop(spec, values[k]))
    return GainScan(values, objective, beyond, int(next(kept, -1)))


def _evaluate(spec: TuneSpec, runs: PlainRuns, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Objective and largest violation of the limits on metrics for gain factors (n,)."""
    goal, nothing = objective_of(spec), np.zeros(len(spec.free.names), bool)
    designs = [
        Family(
            name=ALONE,
            is_free=nothing,
            columns={FIELD: float(value)},
            limits=dict(spec.tune.limits),
            front="",
        )
        for value in values
    ]
    columns = scenario_columns(spec, spec.tune.scenarios.count, spec.tune.scenarios.seed)
    count = len(columns["run.seed"])
    cases = build_cases(spec.study, lane_columns(spec, columns, [None, *designs]), runs.structure)
    result = runs.run(cases, count * (1 + len(values)))

    def split(x: np.ndarray) -> np.ndarray:
        return x.reshape(1 + len(values), count, *x.shape[1:])

    metrics = jax.tree.map(split, result.metrics)
    baseline, others = (jax.tree.map(lambda x, k=k: x[k], metrics) for k in (0, slice(1, None)))
    allowed = allowed_limits(goal, designs[0], baseline_limits(goal, baseline))
    terms = _terms(spec, values)
    measured = ScenarioFigures(others, terms[1:]), ScenarioFigures(baseline, terms[0])
    objective, limits, _ = map(np.asarray, judge_designs(goal, *measured, allowed))
    is_whole = np.isin(split(result.status)[1:], status.FINISHED).all(axis=1)
    return np.where(is_whole, objective, np.nan), excess(limits)


def _terms(spec: TuneSpec, values: np.ndarray) -> np.ndarray:
    """Terms of the objective of the loop, of the baseline and gain factors (n,); (1 + n, S, t)."""
    machines, names = tuned_machines(spec), with_decay(spec.loop_terms)
    if not names:
        return np.zeros((1 + len(values), len(machines.of_scenario), 0))
    factors = np.append(spec.study.control.gain_factor, values)
    columns = {name: np.concatenate([x] * len(factors)) for name, x in machines.columns.items()}
    columns[FIELD] = np.repeat(factors, machines.size)
    figures = machine_figures(spec, spec.study, columns, names)
    parts = {name: figures[name].reshape(len(factors), -1) for name in names}
    designs = ({name: x[k] for name, x in parts.items()} for k in range(len(factors)))
    return np.stack([term_values(spec.loop_terms, x, machines.of_scenario) for x in designs])


def gain_study(spec: TuneSpec, value: float) -> Study:
    """The baseline with another gain factor."""
    return spec.study.change(control__gain_factor=float(value))


def _keeps_loop(spec: TuneSpec, value: float) -> bool:
    """Whether a gain factor keeps the limits of the linearised loop on all machines."""
    limits = {name: spec.tune.limits[name] for name in spec.loop_limits}
    if not limits or spec.study.control.feedback != "sampled":
        return True
    columns = tuned_machines(spec).columns
    figures = machine_figures(spec, gain_study(spec, value), columns, tuple(limits))
    baseline = dict.fromkeys(limits, np.full(len(columns["run.seed"]), np.nan))
    relative = tuple(name for name, limit in limits.items() if limit == BASELINE)
    if relative:
        baseline |= machine_figures(spec, spec.study, columns, relative)
    left = [
        relative_margin(name, figures[name], allowed_on(limit, baseline[name]))
        for name, limit in limits.items()
    ]
    return bool(np.min(left) >= -KEPT)


def reference_lines(spec: TuneSpec, baseline: JudgedDesign, references: References) -> list[str]:
    """What no control and the gain factor alone achieve, one sentence each.

    Args:
        spec: of the tuning.
        baseline: the baseline, judged.
        references: what a tuned design has to beat.
    """
    machines, lines = fresh_machines(spec), []
    for name, design in references.designs:
        which = name
        if name == ALONE and references.scan is not None:
            value = references.scan.gain_factor[references.scan.best]
            which = (
                f"the best {name}, {value:.4g} instead of {spec.study.control.gain_factor:.4g} (of "
                f"{len(references.scan.gain_factor)} values on the scenarios of the tuning)"
            )
        terms = [_term(x, design, baseline) for x in spec.metric_terms]
        if design.loop is not None and baseline.loop is not None:
            terms += [_loop_term(x, design.loop, baseline.loop) for x in spec.loop_terms]
        own = f"; on its own machine {', '.join(terms)}" if terms else ""
        lines.append(
            f"{which}: {design.objective.mean():.4f} of the baseline's objective on {machines}{own}"
        )
    if references.scan is not None and references.scan.best < 0:
        values = references.scan.gain_factor
        lines.append(
            f"none of {len(values)} values of {ALONE}, from {values[0]:.3g} to {values[-1]:.3g}, "
            "keeps the limits"
        )
    return lines


def _term(metric: str, design: JudgedDesign, baseline: JudgedDesign) -> str:
    """A term of the objective, of a design and of the baseline."""
    unit = METRICS[parse_entries(metric).metric].unit
    before, after = (number(x.own_run.metrics[metric], unit) for x in (baseline, design))
    return f"{metric} {after} instead of {before} {readable(unit)[1]}"


def _loop_term(name: str, design: DesignFigures, baseline: DesignFigures) -> str:
    """A term of the objective that is a figure of the loop, of a design and of the baseline."""
    unit = unit_text(name)
    before, after = (f"{getattr(x, name):.4g}" for x in (baseline, design))
    return f"{name} {after} instead of {before}" + (f" {unit}" if unit != "1" else "")


def resolution_lines(
    spec: TuneSpec, designs: list[JudgedDesign], adc_step: np.ndarray | None
) -> list[str]:
    """Terms of the objective that the controller cannot measure, a warning each.

    Args:
        spec: of the tuning.
        designs: those that are compared.
        adc_step: of the baseline [m], (3,); None: there is no controller.
    """
    if adc_step is None:
        return []
    lines = []
    for name in filter(is_deflection, spec.metric_terms):
        step = least_step(name, adc_step, spec.counted_links)
        values = np.array([design.own_run.metrics[name] for design in designs])
        lines.append(resolution_text(name, values[np.isfinite(values)], step, "design"))
    return list(filter(None, lines))
