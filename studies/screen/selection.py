"""Which candidates of a screen are kept: the best that have the gain margin asked for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel import status
from studies.engine.chunks import judge_cases
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.results import SweepData, controlled, uncontrolled_value
from studies.engine.run_data import metric_variables
from studies.engine.runs import run_uncontrolled
from studies.errors import StudyError
from studies.screen.shards import ScreenRequest, designs_table
from studies.screen.tally import Tally
from studies.space.table import CaseTable
from studies.study.fields import Fields

#: Candidates judged at once.
BLOCK = 2048


class Selection(NamedTuple):
    """The candidates that were judged, best first, and which of them are kept."""

    table: CaseTable  # their cases
    value: np.ndarray  # what they are ranked by, (n,)
    margin: np.ndarray  # gain margins: factors on all gains [1]; NaN: no sampled loop, (n,)
    is_kept: np.ndarray  # which are cases of `best.toml`, (n,)

    @property
    def kept(self) -> CaseTable:
        """Cases of `best.toml`, best first."""
        return self.table.rows(np.flatnonzero(self.is_kept))

    @property
    def kept_value(self) -> np.ndarray:
        """What they are ranked by."""
        return self.value[self.is_kept]


def select(
    screen: ScreenRequest,
    tally: Tally,
    stop: threading.Event,
    on_block: Callable[[int, int, int], object] = lambda n_judged, n_kept, total: None,
) -> Selection | None:
    """Judge candidates, best first, until as many as are to be kept have the margin.

    Args:
        screen: says how many, and which margin.
        tally: of all its designs.
        stop: once set, no further candidates are judged.
        on_block: called with how many are judged and kept so far, and how many there are.

    Returns:
        Selection; None if it was stopped.
    """
    table = designs_table(screen, tally.row)
    value = tally.value[np.isin(tally.row, table.row)]  # without those left out as duplicates
    if not screen.margin:
        table, value = table.rows(np.arange(min(screen.keep, len(table)))), value[: screen.keep]
    margin = np.zeros(0)
    has_loop = Fields(table.study, table.fields).raw("control.feedback") == "sampled"
    has_loop, is_kept = np.broadcast_to(has_loop, len(table)), np.zeros(0, bool)
    while len(margin) < len(table) and is_kept.sum() < screen.keep:
        if stop.is_set():
            return None
        rows = np.arange(len(margin), min(len(margin) + BLOCK, len(table)))
        margin = np.append(margin, _margins(screen, table.rows(rows)))
        is_kept = (margin >= screen.margin) | ~has_loop[: len(margin)] | (screen.margin == 0)
        on_block(len(margin), int(is_kept.sum()), len(table))
    judged = np.arange(len(margin))
    is_kept &= np.cumsum(is_kept) <= screen.keep
    return Selection(
        table=table.rows(judged),
        value=value[judged],
        margin=margin,
        is_kept=is_kept,
    )


def _margins(screen: ScreenRequest, table: CaseTable) -> np.ndarray:
    margin = np.zeros(len(table))
    groups = plan_groups(
        table, np.arange(len(table)), local_layout, (screen.metric,), is_linear=True
    )
    for group in groups:
        for chunk in group.chunks():
            cases = chunk_cases(table, chunk.rows, group.structure, group.layout.size)
            figures = judge_cases(group.structure, cases)
            margin[chunk.rows] = np.asarray(figures.gain_margin)[: len(chunk.rows)]
    return margin


def uncontrolled(screen: ScreenRequest, kept: CaseTable) -> float | None:
    """What the designs are ranked by, of the study's machine without control.

    Args:
        screen: of the designs.
        kept: these, best first.

    Returns:
        Value [unit of the metric]; None where there is nothing to compare, or no such run.
    """
    if not controlled(kept).any():
        return None
    try:
        run = run_uncontrolled(screen.spec.study, is_linear=screen.spec.sweep.fidelity == "linear")
    except StudyError:
        return None
    if run.status not in status.FINISHED:
        return None
    data = SweepData({}, {}, screen.spec, kept, metric_variables(run.result))
    return uncontrolled_value(data, screen.entry)
