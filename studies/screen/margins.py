"""What the designs that a screen kept are judged by: gain margins, and no control at all."""

from __future__ import annotations

import numpy as np

from jaxmodel import status
from studies.engine.chunks import judge_cases
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.results import SweepData, controlled, uncontrolled_value
from studies.engine.run_data import metric_variables
from studies.engine.runs import run_uncontrolled
from studies.errors import StudyError
from studies.screen.shards import ScreenRequest
from studies.space.table import CaseTable

#: Designs that are judged, best first.
JUDGED = 10_000


def kept_margins(screen: ScreenRequest, kept: CaseTable) -> np.ndarray:
    """Gain margins of the designs kept, (n,): factors on all gains [1]; NaN after `JUDGED`.

    Args:
        screen: of the designs.
        kept: these, best first.
    """
    table = kept.rows(np.arange(min(JUDGED, len(kept))))
    margin = np.full(len(table), np.nan)
    groups = plan_groups(
        table, np.arange(len(table)), local_layout, (screen.metric,), is_linear=True
    )
    for group in groups:
        for chunk in group.chunks():
            cases = chunk_cases(table, chunk.rows, group.structure, group.layout.size)
            figures = judge_cases(group.structure, cases)
            margin[chunk.rows] = np.asarray(figures.gain_margin)[: len(chunk.rows)]
    return np.pad(margin, (0, len(kept) - len(table)), constant_values=np.nan)


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
