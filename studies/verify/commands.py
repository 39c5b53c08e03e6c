"""The command `studies verify`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from studies.config import start
from studies.results.document import AsJson, print_document

if TYPE_CHECKING:
    from studies.verify.run import ModelVerification


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def verify(
        study: Annotated[
            str | None,
            typer.Argument(help="study file or ready-made design; default: the paper's machine"),
        ] = None,
        as_json: AsJson = False,
    ) -> None:
        """Check every assumption of the model on a study's machine, motion and controller."""
        start()
        from studies.study.spec import load_study
        from studies.verify.run import verify_study

        def notify(name: str) -> None:
            if not as_json:
                console.print(f"checking {name}")

        found = verify_study(None if study is None else load_study(study), notify)
        if as_json:
            print_document(found)
        else:
            _print(found, console)
        if not found.is_passed:
            sys.exit(1)


def _print(found: ModelVerification, console: Console) -> None:
    # what the document has, too, makes room for whole words
    wide = [
        name for name, least in (("checked against", 80), ("source", 110)) if console.width >= least
    ]
    table = Table()
    for name in ["assumption", *wide]:
        table.add_column(name, overflow="fold")
    for name in ["difference", "allowed", ""]:
        table.add_column(name, no_wrap=True)
    for row in found.table:
        numbers = ["-", "-"] if row.left_out else [f"{row.difference:.1e}", f"{row.allowed:.0e}"]
        style = None if row.is_passed else "bold red"
        texts = [row.assumption, row.against, row.source][: 1 + len(wide)]
        table.add_row(*texts, *numbers, row.outcome, style=style)
    console.print(table)
    for row in found.table:
        if row.left_out or not row.is_passed:
            why = row.left_out or row.note or "the difference is larger than allowed"
            console.print(f"{row.outcome}: {row.assumption}: {why}", soft_wrap=True)
    console.print(found.summary.text, soft_wrap=True)
