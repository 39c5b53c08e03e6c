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
from studies.config import processor
from studies.engine.executor import Differentiated, Executor
from studies.engine.plan import Layout, even_layout, lane_unit
from studies.engine.preflight import check_run
from studies.errors import StudyError
from studies.study.cases import build_structure, in_working_precision
from studies.study.numbers import study_numbers
from studies.tuning.linear_fidelity import LinearFidelity
from studies.tuning.objective import (
    Objective,
    allowed_limits,
    baseline_limits,
    judge_with_cotangents,
    largest,
    objective_of,
    size,
)
from studies.tuning.scenarios import lane_columns, nominal, scenario_columns
from studies.tuning.spec import BASELINE, Family, TuneSpec


class Evaluation(NamedTuple):
    """Designs and their derivatives; NumPy arrays."""

    objective: np.ndarray  # (designs,), nan if a scenario did not finish
    slope: np.ndarray  # by the free parameters, 0 for those that do not move, (designs, p)
    limits: np.ndarray  # value over limit - 1, positive where violated, (designs, m)
    limit_slope: np.ndarray  # (designs, m, p)
    peaks: np.ndarray  # largest values of the limited metrics, nan for the loop's, (designs, m)
    status: np.ndarray  # of each run, (designs, scenarios)
    residual: np.ndarray  # residual rms of the links that count, first scenario [m], (designs,)


class Evaluator:
    """Evaluates batches of one size and order of families."""

    def __init__(self, spec: TuneSpec, families: list[Family]) -> None:
        """
        Args:
            spec: of the tuning.
            families: of each design of a batch.

        Raises:
            StudyError: as `check_run`; the baseline does not finish a run.
        """
        self.spec, self.families = spec, families
        self.goal, self.linear = objective_of(spec), LinearFidelity(spec, families)
        self.is_free = np.stack([family.is_free for family in families])
        self._structure = tuned_structure(spec)._replace(is_smooth=True, has_noise=True)
        columns = scenario_columns(spec, spec.tune.scenarios.count, spec.tune.scenarios.seed)
        self.scenarios = len(columns["run.seed"])
        self.lanes = self.scenarios * (1 + len(families))  # runs of a batch
        self._layout = _layout(self.lanes)
        rows = self._layout.filled(self.lanes)
        whole = lane_columns(spec, columns, [None, *families])
        study = spec.study.change(run__smooth=True)
        padded = {name: column[rows] for name, column in whole.items()}
        numbers = study_numbers(study, self._structure, padded)
        self._numbers = in_working_precision(numbers)
        self._rows = rows // self.scenarios  # design of every lane, the baseline first
        self.run_time = float("nan")  # time per run of the last batch [s]
        self._executor = Executor(
            self._structure, self._layout, place=spec.free.build(self._structure)
        )

    def evaluate(self, values: np.ndarray, needs_gradient: np.ndarray | bool = True) -> Evaluation:
        """Objective and limits of designs.

        Args:
            values: of the free parameters in the study's units, (designs, p); those that a design's
                family does not move are ignored.
            needs_gradient: designs that need derivatives; others can have any, (designs,).
        """
        values = np.where(self.is_free, values, np.nan)
        unchanged = np.full((1, values.shape[1]), np.nan)
        is_compiled, started = self._executor.compile_time > 0, time.perf_counter()
        whole = np.concatenate([unchanged, values])[self._rows]
        is_differentiated = (np.isfinite(values) & np.reshape(needs_gradient, (-1, 1))).any(axis=1)
        runs = self._executor.differentiate(self._numbers, whole)
        shape = (1 + len(values), self.scenarios)

        def split(x: Any) -> np.ndarray:
            return np.asarray(x)[: self.lanes].reshape(shape + np.shape(x)[1:])

        metrics = jax.tree.map(split, runs.result.metrics)
        codes = split(runs.result.status)
        self._check_baseline(codes[0], jax.tree.map(lambda x: x[0], metrics))
        baseline = jax.tree.map(lambda x: x[0], metrics)
        reached = baseline_limits(self.goal, baseline)
        allowed = [allowed_limits(self.goal, family, reached) for family in self.families]
        designs = jax.tree.map(lambda x: x[1:], metrics)
        judged = judge_with_cotangents(self.goal, designs, baseline, np.stack(allowed))
        judged = jax.tree.map(np.asarray, judged)
        slopes = self._slopes(runs, judged.cotangents, is_differentiated)
        if is_compiled:
            self.run_time = (time.perf_counter() - started) / self.lanes
        beyond, change = self.linear.limits(values)
        limit_slope = np.concatenate([slopes[:, 1:], change], axis=1)
        return Evaluation(
            objective=judged.objective,
            slope=np.where(self.is_free, slopes[:, 0], 0.0),
            limits=np.concatenate([judged.limits, beyond], axis=1),
            limit_slope=np.where(self.is_free[:, None], limit_slope, 0.0),
            peaks=np.concatenate([judged.peaks, np.full(beyond.shape, np.nan)], axis=1),
            status=codes[1:],
            residual=first_residual(self.goal, metrics)[1:],
        )

    def _slopes(
        self, runs: Differentiated, cotangents: Any, needs_gradient: np.ndarray
    ) -> np.ndarray:
        """Derivatives of the designs' objectives and limits by the free parameters.

        Args:
            runs: all of a batch.
            cotangents: from `judge_with_cotangents`.
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


def tuned_structure(spec: TuneSpec) -> Structure:
    """Program of all families and scenarios, with everything that can be free."""
    structures = [check_run(nominal(spec, family))[0] for family in (None, *spec.families)]
    return build_structure(spec.study)._replace(
        metrics=objective_of(spec).metrics,
        substeps=max(x.substeps for x in structures),
        has_noise=any(x.has_noise for x in structures),
        has_poles=spec.has_poles,
        has_position_gain=spec.has_position_gain,
    )
