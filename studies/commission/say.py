"""What a commissioning tells: what was found and chosen, how sure that is, what is missing."""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.commission.findings import CommissionFindings
from studies.commission.stages import STAGES
from studies.fitting.spec import shown_unit
from studies.show.listing import Rows
from studies.show.report import Items, Report, chapter, machine
from studies.study.margin import margin_text


def say(outcome: CommissionFindings) -> Report:
    """What a commissioning tells."""
    measured = outcome.measured
    study = outcome.tuned or measured.study
    pages = [f"{name}/{stage.page}" for name, stage in STAGES.items()]
    numbers = list(map(_number_row, outcome.numbers))
    margins = [] if outcome.margins is None else [outcome.margins]
    return Report(
        title=f"{outcome.title or 'untitled study'}: "
        f"{'REFUSED' if outcome.refusals else 'commissioned'}",
        result=outcome.summary,
        question="""which controller is safe and good on the machine that was measured, and is the
        code that would run on it right?""",
        next_steps="mend what is said above, and start again in a new folder."
        if outcome.refusals
        else """keep the amplifiers off, check polarity channel by channel as
        `docs/reference/export.md` says, then begin with a small gain.""",
        top=[machine(study)],
        chapters=[
            chapter("What was found", Rows(["parameter", "unit", "value", "95 %"], numbers)),
            chapter(
                "How robust it is",
                f"""Gain margin of the chosen controller, as fixed numbers, on the machines that the
                data leave possible, each with 12 modes a link or more;
                {measured.commission.gain_margin:.3g} is required."""
                if margins
                else "",
                Rows(["least", "10 %", "median", "90 %", "most"], [_quantiles(x) for x in margins]),
            ),
            chapter(
                "The stages",
                "Each folder is as its own command would have made it:",
                Items([f"`{file}`" for file in pages if (outcome.out / file).is_file()]),
            ),
        ],
        files={"Study file": study},
    )


def _number_row(x: dict[str, Any]) -> list[str]:
    """Row of a fitted number."""
    factor, unit = shown_unit(x["name"])
    value, low, high = (f"{factor * y:.5g}" for y in (x["value"], *x["interval_95"]))
    return [x["name"], unit, value, f"{low} to {high}"]


def _quantiles(margins: np.ndarray) -> list[str]:
    return [margin_text(float(x), 3) for x in np.quantile(margins, [0.0, 0.1, 0.5, 0.9, 1.0])]
