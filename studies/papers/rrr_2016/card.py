"""The card."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from studies.engine.batches import ProgressCallback
from studies.papers.card import CardResult, PaperCard
from studies.papers.rrr_2016 import figures
from studies.papers.rrr_2016.claims import CLAIMS, LEFT_OPEN, judge
from studies.papers.rrr_2016.findings import Effort, find
from studies.papers.rrr_2016.report import report, tables

EFFORT = Effort()


def evaluate(effort: Effort, on_progress: ProgressCallback) -> CardResult:
    """Run the study with a given effort."""
    kinds = find(effort, on_progress)
    verdicts, written = judge(kinds), tables(kinds, effort)

    def page(folder: Path) -> str:
        return report(CARD, verdicts, kinds, written, folder)

    return CardResult(
        study=kinds["3-RRR"].study,
        verdicts=verdicts,
        tables=written,
        figures={
            "coupling": partial(figures.coupling, kinds),
            "maps": partial(figures.maps, kinds),
            "definitions": partial(figures.definitions, kinds),
        },
        page=page,
    )


CARD = PaperCard(
    name="rrr_2016",
    title="does control of one link of a 3-RRR calm the others, as on a 3-PRR, or not?",
    source=(
        "Active vibration control experiment of planar 3-RRR flexible parallel robots, Shock and "
        "Vibration, 2016, article 4780181, doi:10.1155/2016/4780181"
    ),
    read=(
        "Read: the abstract and the first lines of the introduction, in a copy without authors; "
        "the title is the subject that the abstract names. Not read: model, table of parameters, "
        "figures and numbers of the experiment."
    ),
    claims=CLAIMS,
    left_open=LEFT_OPEN,
    work=EFFORT.steps,
    run=partial(evaluate, EFFORT),
)
