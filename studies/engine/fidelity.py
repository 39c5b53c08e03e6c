"""Whether the linear model ranks the designs of a space as the full model does.

Its accuracy is that of small motions: residual vibration agrees, peaks near a singular pose may
not. A few random designs of the user's own space, run by both models, tell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.chunks import Done, run_quietly
from studies.engine.columns import named
from studies.engine.plan import local_layout, plan_groups
from studies.engine.results import SweepData, direction, metric_values
from studies.engine.stored import chunk_arrays
from studies.errors import StudyError
from studies.space.spec import SweepSpec
from studies.space.table import CaseTable

#: Random designs that are run by both models, and the fewest of them that say something.
TRIED, FEWEST = 32, 8
#: Least rank correlation with which designs are ranked by the linear model [1].
LEAST = 0.8


class Agreement(NamedTuple):
    """How two models rank the same designs."""

    by: str  # metric, or an entry of it
    n: int  # designs that end well in both
    correlation: float  # of their ranks [1], NaN: nothing to compare
    recalled: int  # of the best quarter by the full model, those that the linear one has, too

    @property
    def is_poor(self) -> bool:
        """Whether the linear model ranks otherwise."""
        return self.correlation < LEAST

    @property
    def text(self) -> str:
        """In one sentence."""
        return self.told("random")

    def told(self, which: str) -> str:
        """The same of which designs."""
        if np.isnan(self.correlation):
            return f"{self.n} {which} designs end well in both models: too few to compare {self.by}"
        return (
            f"{self.n} {which} designs by the linear and the full model: rank correlation of "
            f"{self.by} {self.correlation:.2f}, {self.recalled} of the best {self.n // 4} in "
            "common"
        )

    def check(self, remedy: str) -> None:
        """Refuse to rank by a model that ranks otherwise.

        Raises:
            StudyError: with what helps.
        """
        if self.is_poor:
            raise StudyError(f"{self.text}; allowed: {LEAST:g} or more. {remedy}")


def agreement(spec: SweepSpec, table: CaseTable, by: str) -> Agreement | None:
    """Compare the models on random designs of a table; None: not by what runs find.

    Args:
        spec: the sweep.
        table: its designs, or some of them.
        by: what they are ranked by.
    """
    entry = by.removeprefix("-")
    if entry.partition("[")[0] not in METRICS:
        return None
    rows = np.sort(np.random.default_rng(spec.sweep.seed).permutation(len(table))[:TRIED])
    return alike(by, *(_values(spec, table, rows, entry, x) for x in (True, False)))


def alike(by: str, linear: np.ndarray, full: np.ndarray) -> Agreement:
    """How alike two models rank designs.

    Args:
        by: what they are ranked by.
        linear, full: its values by each model, NaN where the run is not ok, (n,).
    """
    entry = by.removeprefix("-")
    is_there = np.isfinite(linear) & np.isfinite(full)
    sign = -1 if direction(by) == "largest" else 1
    linear, full = sign * linear[is_there], sign * full[is_there]
    count = len(full)
    if count < FEWEST or np.ptp(full) == 0 or np.ptp(linear) == 0:
        return Agreement(entry, count, np.nan, 0)
    best = [set(np.argsort(x, kind="stable")[: count // 4].tolist()) for x in (linear, full)]
    return Agreement(entry, count, rank_correlation(linear, full), len(best[0] & best[1]))


def chunk_values(
    spec: SweepSpec, table: CaseTable, done: Done, entry: str
) -> tuple[np.ndarray, np.ndarray]:
    """Status of the cases of a chunk, and what they are ranked by, (n,) each.

    Args:
        spec: the sweep.
        table: all cases.
        done: the chunk.
        entry: a metric, or an entry of it.
    """
    arrays = chunk_arrays(table, done, [entry.partition("[")[0]])
    variables = {name: named(name, data, "case") for name, data in arrays.items()}
    value = metric_values(SweepData(variables, {}, spec, table), entry)
    return arrays["status"], np.asarray(value, float)


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's coefficient, equal values with equal ranks [1]."""
    from scipy.stats import rankdata  # takes a third of a second

    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def _values(
    spec: SweepSpec, table: CaseTable, rows: np.ndarray, entry: str, is_linear: bool
) -> np.ndarray:
    """What designs are ranked by, NaN where the run is not ok, (len(rows),)."""
    values, metric = np.full(len(table), np.nan), entry.partition("[")[0]
    groups = plan_groups(table, rows, local_layout, (metric,), is_linear, is_judged=False)
    for done in run_quietly(table, groups):
        code, found = chunk_values(spec, table, done, entry)
        values[done.chunk.rows] = np.where(code == status.OK, found, np.nan)
    return values[rows]
