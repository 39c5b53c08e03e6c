"""Designs under all scenarios: objective, limits, and their derivatives by the free parameters.

Runs are differentiated by kernels (`studies.engine.function`), all scenarios of all designs in one
batch, with limits and rounding made smooth (`Structure.is_smooth`). Every batch includes the study
itself as the reference.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel import status
from jaxmodel.case import Structure
from jaxmodel.numbers import in_working_precision
from studies.config import processor
from studies.engine.executor import Differentiated, Executor
from studies.engine.plan import Layout, even_layout, lane_unit
from studies.engine.preflight import check_run
from studies.errors import StudyError
from studies.study.cases import build_structure
from studies.study.numbers import study_numbers
from studies.study.paths import Parts
from studies.tuning.linear_fidelity import LinearFidelity, LoopEvaluation
from studies.tuning.objective import (
    Objective,
    ScenarioFigures,
    allowed_limits,
    baseline_limits,
    judge_with_cotangents,
    largest,
    objective_of,
    size,
)
from studies.tuning.plain_runs import baseline_runs
from studies.tuning.scenarios import lane_columns, nominal, scenario_columns
from studies.tuning.spec import BASELINE, Family, TuneSpec


class Evaluation(NamedTuple):
    """Designs and their derivatives; NumPy arrays."""

    #: (designs,), nan if a scenario did not finish or a loop in the objective is unstable
    objective: np.ndarray
    slope: np.ndarray  # by the free parameters, 0 for those that do not move, (designs, p)
    limits: np.ndarray  # value over limit - 1, positive where violated, (designs, m)
    limit_slope: np.ndarray  # (designs, m, p)
    peaks: np.ndarray  # largest values of the limited metrics, nan for the loop's, (designs, m)
    status: np.ndarray  # of each run, (designs, scenarios)
    residual: np.ndarray  # residual rms of the links that count, first scenario [m], (designs,)


class Evaluator:
    """Evaluates batches of one size and order of families; each law and drive has its program."""

    def __init__(self, spec: TuneSpec, families: list[Family]) -> None:
        """
        Args:
            spec: of the tuning.
            families: of each design of a batch.

        Raises:
            StudyError: as `check_run` and `LinearFidelity`; the baseline does not finish a run.
        """
        self.spec, self.families = spec, families
        self.goal, self.linear = objective_of(spec), LinearFidelity(spec, families)
        self.is_free = np.stack([family.is_free for family in families])
        every = [spec.parts(family) for family in families]
        # all designs are measured against the baseline: its program first, if designs have it too
        self._programs = [
            _PartRuns(spec, parts, families, np.flatnonzero([x == parts for x in every]))
            for parts in sorted(dict.fromkeys(every), key=lambda x: x != spec.parts())
        ]
        self._apart: ScenarioFigures | None = None  # the baseline, if no design has its program
        self.lanes = sum(program.lanes for program in self._programs)  # runs of a batch
        self.run_time = float("nan")  # time per run of the last batch [s]

    def evaluate(self, values: np.ndarray, needs_gradient: np.ndarray | bool = True) -> Evaluation:
        """Objective and limits of designs.

        Args:
            values: of the free parameters in the study's units, (designs, p); those that a design's
                family does not move are ignored.
            needs_gradient: designs that need derivatives; others can have any, (designs,).
        """
        values = np.where(self.is_free, values, np.nan)
        is_compiled = all(program.is_compiled for program in self._programs)
        started = time.perf_counter()
        is_differentiated = (np.isfinite(values) & np.reshape(needs_gradient, (-1, 1))).any(axis=1)
        loop = self.linear.evaluate(values)
        baseline, parts = self._baseline_apart(), []
        for program in self._programs:
            rows = program.rows
            runs = program.run(values[rows])
            if baseline is None:
                metrics = jax.tree.map(lambda x: x[0], runs.metrics)
                baseline = self._measured(runs.status[0], metrics)
            own = jax.tree.map(lambda x, rows=rows: x[rows], loop)
            parts.append(program.judge(self.goal, runs, own, baseline, is_differentiated[rows]))
        back = np.argsort(np.concatenate([program.rows for program in self._programs]))
        whole = _Judged(*(np.concatenate(x)[back] for x in zip(*parts, strict=True)))
        if is_compiled:
            self.run_time = (time.perf_counter() - started) / self.lanes
        limit_slope = np.concatenate([whole.slopes[:, 1:], loop.limit_slopes], axis=1)
        return Evaluation(
            objective=whole.objective,
            slope=np.where(self.is_free, whole.slopes[:, 0], 0.0),
            limits=np.concatenate([whole.limits, loop.limits], axis=1),
            limit_slope=np.where(self.is_free[:, None], limit_slope, 0.0),
            peaks=np.concatenate([whole.peaks, np.full(loop.limits.shape, np.nan)], axis=1),
            status=whole.status,
            residual=whole.residual,
        )

    def _baseline_apart(self) -> ScenarioFigures | None:
        """The baseline, run once without derivatives, if no design has its law and drive."""
        spec = self.spec
        if self._apart is None and spec.parts() not in map(spec.parts, self.families):
            columns = scenario_columns(spec, spec.tune.scenarios.count, spec.tune.scenarios.seed)
            structure = _smooth(tuned_structure(spec, spec.parts()))
            result = baseline_runs(spec, structure, columns)
            self._apart = self._measured(result.status, result.metrics)
        return self._apart

    def _measured(self, codes: np.ndarray, metrics: Any) -> ScenarioFigures:
        """What designs are measured against, from the baseline's runs."""
        self._check_baseline(codes, metrics)
        return ScenarioFigures(metrics, self.linear.baseline_terms)

    def _check_baseline(self, codes: np.ndarray, metrics: Any) -> None:
        is_bad = ~np.isin(codes, status.FINISHED)
        if is_bad.any():
            k = int(np.argmax(is_bad))
            raise StudyError(
                f"tune: the baseline does not finish a run in scenario {k}: "
                f"{status.REASONS[int(codes[k])]}; every design is measured against it"
            )
        for name, _ in self.goal.terms:
            if (np.asarray(size(self.goal, metrics, name)) == 0).any():
                raise StudyError(
                    f"tune.objective: {name} is 0 in a run of the baseline, so nothing can be "
                    "measured against it; limit it instead"
                )
        relative = {
            name for family in self.families for name, x in family.limits.items() if x == BASELINE
        }
        for name in relative & set(self.goal.limits):
            if (np.asarray(largest(self.goal, metrics, name)) <= 0).any():
                raise StudyError(
                    f"tune.limits.{name} = {BASELINE!r}: the baseline has 0 in a run, which "
                    "leaves no room; give a number"
                )


class _Runs(NamedTuple):
    """Runs of a program, the baseline first."""

    runs: Differentiated
    metrics: Any  # leaves (1 + designs, scenarios, ...)
    status: np.ndarray  # (1 + designs, scenarios)


class _Judged(NamedTuple):
    """Designs of a program, judged by their runs; NumPy arrays, designs first."""

    objective: np.ndarray
    limits: np.ndarray
    peaks: np.ndarray
    slopes: np.ndarray  # (designs, 1 + m, p)
    status: np.ndarray
    residual: np.ndarray


class _PartRuns:
    """The runs of designs of one law and drive."""

    def __init__(
        self, spec: TuneSpec, parts: Parts, families: list[Family], rows: np.ndarray
    ) -> None:
        """
        Args:
            spec: of the tuning.
            parts: of these designs.
            families: of all designs.
            rows: places of those designs among them.
        """
        self.rows, self._families = rows, [families[k] for k in rows]
        structure = _smooth(tuned_structure(spec, parts))
        columns = scenario_columns(spec, spec.tune.scenarios.count, spec.tune.scenarios.seed)
        self.scenarios = len(columns["run.seed"])
        self.lanes = self.scenarios * (1 + len(rows))
        self._layout = _layout(self.lanes)
        lanes = self._layout.filled(self.lanes)
        # with other parts than the baseline's, the first family stands in its place, unused
        first = None if parts == spec.parts() else self._families[0]
        whole = lane_columns(spec, columns, [first, *self._families])
        study = spec.study.change(run__smooth=True)
        padded = {name: column[lanes] for name, column in whole.items()}
        self._numbers = in_working_precision(study_numbers(study, structure, padded))
        self._rows = lanes // self.scenarios  # design of every lane, the baseline first
        self._executor = Executor(structure, self._layout, place=spec.free.build(structure))

    @property
    def is_compiled(self) -> bool:
        """Whether it has run before."""
        return self._executor.compile_time > 0

    def run(self, values: np.ndarray) -> _Runs:
        """Run designs, (designs, p) values with nan for what does not move."""
        whole = np.concatenate([np.full((1, values.shape[1]), np.nan), values])[self._rows]
        runs = self._executor.differentiate(self._numbers, whole)
        shape = (1 + len(values), self.scenarios)

        def split(x: Any) -> np.ndarray:
            return np.asarray(x)[: self.lanes].reshape(shape + np.shape(x)[1:])

        return _Runs(runs, jax.tree.map(split, runs.result.metrics), split(runs.result.status))

    def judge(
        self,
        goal: Objective,
        runs: _Runs,
        loop: LoopEvaluation,
        baseline: ScenarioFigures,
        is_differentiated: np.ndarray,
    ) -> _Judged:
        """Measure designs against the baseline, with derivatives of some.

        Args:
            goal: terms and limits.
            runs: of the designs.
            loop: theirs.
            baseline: (S, ...).
            is_differentiated: designs that need derivatives, (designs,).
        """
        reached = baseline_limits(goal, baseline.metrics)
        allowed = [allowed_limits(goal, family, reached) for family in self._families]
        designs = ScenarioFigures(jax.tree.map(lambda x: x[1:], runs.metrics), loop.terms)
        judged = judge_with_cotangents(goal, designs, baseline, np.stack(allowed))
        judged = jax.tree.map(np.asarray, judged)
        slopes = self._slopes(runs.runs, judged.cotangents.metrics, is_differentiated)
        by_loop = np.einsum("mdst,dstp->dmp", judged.cotangents.loop, loop.term_slopes)
        return _Judged(
            objective=judged.objective,
            limits=judged.limits,
            peaks=judged.peaks,
            slopes=slopes + by_loop,
            status=runs.status[1:],
            residual=first_residual(goal, runs.metrics)[1:],
        )

    def _slopes(
        self, runs: Differentiated, cotangents: Any, needs_gradient: np.ndarray
    ) -> np.ndarray:
        """Derivatives of the designs' objectives and limits by the free parameters.

        Args:
            runs: all of a batch.
            cotangents: by the metrics, from `judge_with_cotangents`.
            needs_gradient: designs that need derivatives, (designs,).

        Returns:
            (designs, 1 + m, p).
        """

        def pad_to_batch(x: np.ndarray) -> np.ndarray:
            """Zeros for the baseline, the designs' runs, zeros up to the batch's size."""
            count, designs = x.shape[:2]
            used = np.where(needs_gradient.reshape(-1, *[1] * (x.ndim - 2)), x, 0.0)
            padded = np.zeros((count, len(self._rows), *x.shape[3:]), x.dtype)
            begin = self.scenarios
            padded[:, begin : begin + designs * begin] = used.reshape(count, -1, *x.shape[3:])
            return padded

        slopes = runs.pull_back(jax.tree.map(pad_to_batch, cotangents))
        slopes = slopes[:, self.scenarios : self.lanes]
        by_design = slopes.reshape(len(slopes), -1, self.scenarios, slopes.shape[-1])
        return np.swapaxes(by_design.sum(axis=2), 0, 1)


def _layout(lanes: int) -> Layout:
    """Small blocks: each is differentiated only by what its own designs move."""
    if processor() != "cpu":
        return even_layout(lanes)
    whole = even_layout(lanes)
    block = min(2 * lane_unit(), whole.lanes)
    return Layout(whole.devices, -(-lanes // (whole.devices * block)), block)


def first_residual(goal: Objective, metrics: Any) -> np.ndarray:
    """Residual rms of the first scenario [m], (designs,); nan if missing.

    Root of the mean square of all stations of the links that count.
    """
    if metrics.residual_rms is None:
        return np.full(len(metrics.saturated_fraction), np.nan)
    return np.sqrt(np.mean(metrics.residual_rms[:, 0, list(goal.links)] ** 2, axis=(1, 2)))


def _smooth(structure: Structure) -> Structure:
    """With limits and rounding made smooth, noise in place of rounding."""
    return structure._replace(is_smooth=True, has_noise=True)


def tuned_structure(spec: TuneSpec, parts: Parts) -> Structure:
    """Program of the designs of a law and drive in all scenarios, with all that can be free."""
    families = [family for family in (None, *spec.families) if spec.parts(family) == parts]
    structures = [check_run(nominal(spec, family))[0] for family in families]
    return build_structure(spec.studies(parts)[0])._replace(
        metrics=objective_of(spec).metrics,
        substeps=max(x.substeps for x in structures),
        has_noise=any(x.has_noise for x in structures),
        has_poles=spec.has_poles(parts),
        has_position_gain=spec.has_position_gain(parts),
    )
