"""`studies paper NAME`: run a card and write its folder, whole or not at all."""

from __future__ import annotations

import csv
from pathlib import Path

from studies.engine.run_data import run_attributes
from studies.job import Job
from studies.papers.card import CardResult, PaperCard
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.show.listing import Rows
from studies.show.pages import write_report
from studies.store import write_store

#: File of the outcomes.
CLAIMS = "claims.json"
#: What is done, with what it takes on two cores [s].
PHASES = {"run": 60.0, "draw": 20.0}
#: Modules that determine the numbers, with everything they import.
DECISIVE = ("studies.papers.catalogue",)


def examined(card: PaperCard, job: Job, has_pdf: bool = False) -> CardResult:
    """Run the card of a paper and write data, figures and report.

    Args:
        card: the paper.
        job: with `PHASES`.
        has_pdf: also write the figures as PDF.
    """
    job.begin("run")
    result = card.run(job)
    job.begin("draw")
    with publish(job.place) as staging:
        for name, (study, variables) in result.stores.items():
            write_store(staging / f"{name}.h5", variables, run_attributes(study))
        for name, rows in result.tables.items():
            _write_csv(staging / f"{name}.csv", rows)
        (staging / CLAIMS).write_text(json_text(result.outcome), "utf-8")
        write_report(result.report(), staging, has_pdf)
    return in_folder(result, job.place, job.place / REPORT)


def _write_csv(path: Path, rows: Rows) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([rows.heads, *rows.rows])
