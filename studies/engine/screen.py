"""Screens: every case by the linear model, and only the best of them by the whole one.

The screen ranks all cases by a metric of the linear model and runs them in that order until the
wanted share has been run, or meets the screen's condition. Some random cases run too, to show what
the screen lost.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.case import Structure
from jaxmodel.metrics import METRICS
from studies.engine.chunks import Done
from studies.engine.columns import PER_CASE, SCREENED, named
from studies.engine.folder import SCREEN, Finished, finished_cases
from studies.engine.plan import Group, Layout, plan_groups
from studies.engine.results import SweepData, direction, meets, metric_values
from studies.engine.stored import chunk_arrays, gather, kept_metrics
from studies.errors import StudyError, nearest
from studies.space.condition import evaluate
from studies.space.spec import Screen, SweepSpec
from studies.space.table import CaseTable, metric_sizes
from studies.study.entries import parse_entries
from studies.study.paths import NAMED_INDEX

#: Most random cases that show what the screen lost.
AUDIT = 2000
#: Each round goes at most this many times as far down the ranking as the one before.
FURTHER = 4


class Round(NamedTuple):
    """Which cases are to be run."""

    first: np.ndarray  # the best ones by the screen, best first
    audit: np.ndarray  # random ones

    @property
    def rows(self) -> np.ndarray:
        """All of them, ascending."""
        return np.union1d(self.first, self.audit)


def check_names(spec: SweepSpec, table: CaseTable) -> None:
    """Reject a sweep or screen that ranks by or asks for what no case has, before anything runs.

    Raises:
        StudyError: so it does.
    """
    metrics, sizes = kept_metrics(spec), metric_sizes(table)
    parse_entries(spec.sweep.by, "sweep.by", sizes)
    if spec.screen is None:
        return
    parse_entries(spec.screen.entry, "sweep.screen.by", sizes)

    def lookup(name: str) -> np.ndarray:
        key = NAMED_INDEX.sub("", name).partition("[")[0]
        if key in metrics:
            parse_entries(name, sizes=sizes)
        elif key in METRICS:
            raise StudyError(f"{name!r}: sweep.metrics does not keep it")
        elif key not in PER_CASE:
            close = nearest(key, (*metrics, *PER_CASE))
            if close:
                raise StudyError(f"unknown {name!r}; did you mean {close!r}?")
            return table.values(name)[:1]
        return np.ones(1)

    if spec.screen.subject_to:
        evaluate(spec.screen.subject_to, lookup, "sweep.screen.subject_to")


def screen_groups(
    table: CaseTable,
    rows: np.ndarray,
    lay_out: Callable[[int, Structure], Layout],
    screen: Screen,
) -> list[Group]:
    """Groups of the linear model: one metric, no judgement; arguments as `plan_groups`."""
    return plan_groups(table, rows, lay_out, (screen.metric,), is_linear=True, is_judged=False)


def screen_arrays(spec: SweepSpec, table: CaseTable, done: Done) -> dict[str, np.ndarray]:
    """Contents of a file of the screen: ids, status and value of its cases.

    Args:
        spec: the sweep, with a screen.
        table: all cases.
        done: a chunk of the linear model.
    """
    assert spec.screen is not None
    code, value = chunk_values(spec, table, done, spec.screen.entry)
    return {
        "case_id": table.case_id[done.chunk.rows],
        "screen_status": code,
        "screen_value": value,
    }


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


def ranked(table: CaseTable, screened: Finished, screen: Screen) -> np.ndarray:
    """Rows of the cases that end well in the linear model, best first.

    Args:
        table: all cases.
        screened: from `screened_cases`.
        screen: of the sweep.
    """
    columns = gather(table, screened, SCREENED)
    if "screen_value" not in columns:
        return np.empty(0, int)
    code, value = columns["screen_status"].data, columns["screen_value"].data
    return in_order(code, value, table.case_id, screen)


def in_order(
    code: np.ndarray, value: np.ndarray, case_id: np.ndarray, screen: Screen
) -> np.ndarray:
    """Cases of status ok in the linear model, best first; ties by their ids.

    Args:
        code: how the linear runs ended, (n,).
        value: what they are ranked by, (n,).
        case_id: as bytes, (n,).
        screen: of the sweep.
    """
    is_fine = (code == status.OK) & np.isfinite(value)
    sign = -1 if direction(screen.by) == "largest" else 1
    order = np.lexsort((case_id, sign * np.where(is_fine, value, 0.0), ~is_fine))
    return order[: int(is_fine.sum())]


def audited(n_cases: int, order: np.ndarray, spec: SweepSpec) -> np.ndarray:
    """Random cases that run whatever their rank, no more than the screen keeps.

    Args:
        n_cases: of the sweep.
        order: from `in_order`.
        spec: the sweep.
    """
    assert spec.screen is not None
    count = min(AUDIT, full_runs(n_cases, spec.screen))
    return np.random.default_rng(spec.sweep.seed).permutation(np.sort(order))[:count]


def first_round(table: CaseTable, order: np.ndarray, spec: SweepSpec) -> Round:
    """The cases to run first.

    Args:
        table: all cases.
        order: from `ranked`.
        spec: the sweep.
    """
    assert spec.screen is not None
    count = full_runs(len(table), spec.screen)
    return Round(order[:count], audited(len(table), order, spec))


def full_runs(n_cases: int, screen: Screen) -> int:
    """How many of these cases a screen keeps."""
    return max(1, round(screen.keep * n_cases))


def next_round(
    table: CaseTable, order: np.ndarray, spec: SweepSpec, last: Round, folder: Path
) -> Round | None:
    """Further cases, if too few of those run meet the screen's condition; None: enough.

    Args:
        table, order, spec: as in `first_round`.
        last: round, all of it run.
        folder: of the sweep.
    """
    screen = spec.screen
    assert screen is not None
    so_far, count = len(last.first), full_runs(len(table), screen)
    if not screen.subject_to or so_far == len(order):
        return None
    rows = np.sort(last.first)
    part = table.rows(rows)
    data = SweepData(gather(part, finished_cases(folder)), {}, spec, part)
    is_fine = data["status"] == status.OK
    n_met = int(np.sum(meets(data, screen.subject_to, "sweep.screen.subject_to") & is_fine))
    if n_met >= count:
        return None
    needed = int(np.ceil(1.25 * count * so_far / max(n_met, 1)))
    return last._replace(first=order[: min(needed, FURTHER * so_far)])


def screened_cases(folder: Path) -> Finished:
    """Where the results of the linear model are."""
    return finished_cases(folder, SCREEN)
