"""Which candidates of a screen are kept: the best that have the gain margin asked for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.engine.chunks import judge_cases
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.job import Job
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
    is_kept: np.ndarray  # which run by the full model, (n,)

    @property
    def kept(self) -> CaseTable:
        """Those that run by the full model, best first."""
        return self.table.rows(np.flatnonzero(self.is_kept))

    @property
    def kept_value(self) -> np.ndarray:
        """What they are ranked by."""
        return self.value[self.is_kept]


def select(screen: ScreenRequest, tally: Tally, count: int, job: Job) -> Selection:
    """Judge candidates, best first, until as many as are to be kept have the margin.

    Args:
        screen: says which margin.
        tally: of all its designs.
        count: how many to keep.
        job: in its phase of the margins.
    """
    table, least = designs_table(screen, tally.row), screen.spec.sweep.margin
    value = tally.value[np.isin(tally.row, table.row)]  # without those left out as duplicates
    if not least:
        table, value = table.rows(np.arange(min(count, len(table)))), value[:count]
    margin, total = np.zeros(0), len(table)
    has_loop = Fields(table.study, table.fields).raw("control.feedback") == "sampled"
    has_loop, is_kept = np.broadcast_to(has_loop, total), np.zeros(0, bool)
    while len(margin) < total and is_kept.sum() < count:
        rows = np.arange(len(margin), min(len(margin) + BLOCK, total))
        margin = np.append(margin, _margins(screen, table.rows(rows)))
        is_kept = (margin >= least) | ~has_loop[: len(margin)] | (least == 0)
        n_kept, n_judged = int(is_kept.sum()), len(margin)
        needed = min(total, n_judged * count / max(n_kept, 1))
        text = f"{n_judged:,} of {total:,} judged, {n_kept:,} with a margin of at least {least:g}"
        job.advance(n_judged, int(needed), text)
    judged = np.arange(len(margin))
    is_kept &= np.cumsum(is_kept) <= count
    return Selection(table.rows(judged), value[judged], margin, is_kept)


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
