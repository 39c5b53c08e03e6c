"""Gain margins of the designs that a screen kept, which it ranked without them."""

from __future__ import annotations

import numpy as np

from studies.engine.chunks import judge_cases
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.screen.shards import ScreenRequest, designs_table

#: Designs that are judged, best first.
JUDGED = 10_000


def kept_margins(screen: ScreenRequest, row: np.ndarray) -> np.ndarray:
    """Gain margins of designs, (n,): factors on all gains [1].

    Args:
        screen: of the designs.
        row: their numbers, best first, (n,); NaN for those after `JUDGED`.
    """
    judged = row[:JUDGED]
    found = np.full(len(row), np.nan)
    if not len(row):
        return found
    table = designs_table(screen, judged)
    margin = np.full(len(table), np.nan)
    groups = plan_groups(
        table, np.arange(len(table)), local_layout, (screen.metric,), is_linear=True
    )
    for group in groups:
        for chunk in group.chunks():
            cases = chunk_cases(table, chunk.rows, group.structure, group.layout.size)
            figures = judge_cases(group.structure, cases)
            margin[chunk.rows] = np.asarray(figures.gain_margin)[: len(chunk.rows)]
    found[: len(judged)][np.isin(judged, table.row)] = margin
    return found
