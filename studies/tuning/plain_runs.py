"""Runs of a tuning's designs without derivatives."""

from __future__ import annotations

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.numbers import in_working_precision
from jaxmodel.simulate import RunResult
from studies.engine.executor import Executor
from studies.engine.plan import even_layout
from studies.study.numbers import build_cases
from studies.tuning.scenarios import lane_columns
from studies.tuning.spec import TuneSpec


def baseline_runs(
    spec: TuneSpec, structure: Structure, columns: dict[str, np.ndarray]
) -> RunResult:
    """Runs of a tuning's baseline in scenarios, by a program of its law and drive.

    Args:
        spec: of the tuning.
        structure: of the program.
        columns: from `scenario_columns`.
    """
    count, study = len(columns["run.seed"]), spec.study.change(run__smooth=structure.is_smooth)
    cases = build_cases(study, lane_columns(spec, columns, [None]), structure)
    return PlainRuns(structure, count).run(cases, count)


class PlainRuns:
    """Many runs at a time through one program."""

    def __init__(self, structure: Structure, count: int) -> None:
        """
        Args:
            structure: of all runs.
            count: of a batch, about.
        """
        self.structure = structure
        self._layout = even_layout(count)
        self._executor = Executor(structure, self._layout)

    def run(self, cases: Case, count: int) -> RunResult:
        """Run cases, leaves (count or 1, ...)."""
        cases = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape[1:])), cases)
        parts = []
        for first in range(0, count, self._layout.size):
            rows = np.minimum(first + np.arange(self._layout.size), count - 1)
            part = in_working_precision(jax.tree.map(lambda x, rows=rows: x[rows], cases))
            parts.append(self._executor.start(part).wait())
        return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)
