"""The page of a commissioning: what was found and chosen, how sure that is, what is missing."""

from __future__ import annotations

import numpy as np

from studies.commission.findings import CommissionFindings
from studies.commission.spec import MeasuredSpec
from studies.commission.stages import STAGES
from studies.fitting.spec import number_unit
from studies.show.pages import old_page as page
from studies.study.margin import margin_text


def report(measured: MeasuredSpec, outcome: CommissionFindings) -> str:
    """The page.

    Args:
        measured: what was asked for.
        outcome: how far it went.
    """
    pages = [f"{stage.name}/{stage.page}" for stage in STAGES]
    return page(
        "commission/report.html",
        None,
        outcome.tuned or measured.study,
        outcome=outcome,
        measured=measured,
        wanted=measured.commission,
        lines=outcome.summary,
        pages=[file for file in pages if (outcome.out / file).is_file()],
        rows=_numbers(outcome),
        margins=_margins(outcome),
    )


def _numbers(outcome: CommissionFindings) -> list[list[str]]:
    """Row of each fitted number."""
    rows = []
    for x in outcome.numbers:
        low, high = x["interval_95"]
        span = f"{low:.5g} to {high:.5g}"
        rows.append([x["name"], number_unit(x["name"]), f"{x['value']:.5g}", span])
    return rows


def _margins(outcome: CommissionFindings) -> list[list[str]]:
    """Row of quantiles of the gain margin."""
    if outcome.margins is None:
        return []
    quantiles = np.quantile(outcome.margins, [0.0, 0.1, 0.5, 0.9, 1.0])
    return [[margin_text(float(x), 3) for x in quantiles]]
