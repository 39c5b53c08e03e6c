"""`studies paper NAME`: run a card and write its folder, whole or not at all."""

from __future__ import annotations

import csv
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from studies import config
from studies.engine.batches import ProgressCallback
from studies.engine.run_data import run_attributes
from studies.papers.card import CardResult, PaperCard, PaperOutcome
from studies.papers.catalogue import find_card
from studies.publish import REPORT, announce, check_folder, publish
from studies.results.document import json_text
from studies.show.listing import Rows, print_rows
from studies.show.pages import write_report
from studies.store import write_store

#: File of the outcomes.
CLAIMS = "claims.json"
#: Share of the work that the figures take, in units of `PaperCard.work`.
DRAWING = 4.0


def run_paper(
    name: str, out: str | Path, console: Console | None = None, has_pdf: bool = False
) -> CardResult:
    """Run the card of a paper and write data, figures and report.

    Args:
        name: of the card, as `studies paper` lists them.
        out: folder, created if missing; files of an earlier run are replaced.
        console: where progress and the outcome go; default: standard output.
        has_pdf: also write the figures as PDF.

    Raises:
        StudyError: no such card; the folder cannot be made or written to.
    """
    config.require_configured()
    return run_card(
        find_card(name), Path(out), console or Console(highlight=False, markup=False), has_pdf
    )


def run_card(card: PaperCard, out: Path, console: Console, has_pdf: bool = False) -> CardResult:
    """`run_paper` for a given card; arguments and errors as there."""
    check_folder(out)
    columns = (TextColumn("{task.description:<44}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("starting", total=card.work)

        def on_progress(text: str, share: float) -> None:
            progress.update(task, description=text, advance=share)

        result = card.run(on_progress)
        progress.update(task, total=card.work + 1 + DRAWING)
        _write(card, result, out, on_progress, has_pdf)
        progress.update(task, description="done")
    _print_outcome(result, out, console)
    return result


def _write(
    card: PaperCard, result: CardResult, out: Path, on_progress: ProgressCallback, has_pdf: bool
) -> None:
    with publish(out) as staging:
        on_progress("writing data", 0.0)
        for name, (study, variables) in result.stores.items():
            write_store(staging / f"{name}.h5", variables, run_attributes(study))
        for name, rows in result.tables.items():
            _write_csv(staging / f"{name}.csv", rows)
        (staging / CLAIMS).write_text(json_text(_document(card, result)), "utf-8")
        on_progress("writing data", 1.0)
        on_progress("drawing", 0.0)
        write_report(result.report, staging, has_pdf)
        on_progress("drawing", DRAWING)


def _write_csv(path: Path, rows: Rows) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([rows.heads, *rows.rows])


def _document(card: PaperCard, result: CardResult) -> PaperOutcome:
    return PaperOutcome(
        card=card.name,
        title=card.title,
        source=card.source,
        read=card.read,
        claims=result.verdicts,
        left_open=card.left_open,
    )


def _print_outcome(result: CardResult, out: Path, console: Console) -> None:
    rows = [[one.claim.text, one.outcome, one.found] for one in result.verdicts]
    print_rows(Rows(["claim", "outcome", "found"], rows), console)
    data = [f"{name}.h5" for name in result.stores] + [f"{name}.csv" for name in result.tables]
    announce(console, out / REPORT, f"; data: {', '.join([*data, CLAIMS])} in the same folder")
