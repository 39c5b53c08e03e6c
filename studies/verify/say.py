"""What a verification tells."""

from __future__ import annotations

from studies.show.listing import Rows
from studies.show.report import Report, chapter
from studies.verify.result import ModelVerification

HEADS = ["assumption", "checked against", "source", "difference", "allowed", ""]


def say(found: ModelVerification) -> Report:
    """Row by row, and what was left out or failed."""
    rows = [
        [
            row.assumption,
            row.against,
            row.source,
            *(["-", "-"] if row.left_out else [f"{row.difference:.1e}", f"{row.allowed:.0e}"]),
            row.outcome,
        ]
        for row in found.rows
    ]
    reasons = [
        f"{row.outcome}: {row.assumption}: "
        f"{row.left_out or row.note or 'the difference is larger than allowed'}"
        for row in found.rows
        if row.left_out or not row.is_passed
    ]
    return Report(
        title=f"{found.study.title or 'untitled study'}: verification",
        result=[found.summary.text, *reasons],
        question="do the equations describe this machine, this motion and this controller?",
        next_steps="""`studies simulate` and all other commands compute by what is checked here.""",
        top=[],
        chapters=[chapter("Assumptions", Rows(HEADS, rows))],
        files={"Study file": found.study},
    )
