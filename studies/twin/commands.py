"""The command `studies twin`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from studies.config import start
from studies.results.document import AsJson, print_document

if TYPE_CHECKING:
    from studies.twin.result import TwinResult


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def twin(
        design: Annotated[
            Path, typer.Argument(help="study file, ready-made design, folder of a tuning or sweep")
        ],
        out: Annotated[
            Path | None, typer.Option(help="folder for report, figure and numbers")
        ] = None,
        case: Annotated[
            str | None,
            typer.Option(help="case of a sweep (number or id:...) or family of a tuning"),
        ] = None,
        as_json: AsJson = False,
    ) -> None:
        """Repeat the loop with a machine in Exudyn and the exported controller, and compare."""
        from studies.twin.multibody import load_exudyn

        load_exudyn()  # before anything that takes long
        start()
        from studies.engine.design import load_design
        from studies.twin.run import twin_design

        loaded = load_design(design, case)
        quiet = Console(quiet=True) if as_json else console
        result = twin_design(loaded, out, quiet)
        if as_json:
            from studies.twin.report import twin_document

            print_document(twin_document(result))
            return
        _print_twin(result, console)


def _print_twin(result: TwinResult, console: Console) -> None:
    from studies.twin.report import (
        CAUSE_HEAD,
        GAP_HEAD,
        POLE_HEAD,
        cause_rows,
        gap_rows,
        pole_rows,
        verdict,
    )

    for head, rows in (
        (GAP_HEAD, gap_rows(result)),
        (CAUSE_HEAD, cause_rows(result.causes)),
        (POLE_HEAD, pole_rows(result)),
    ):
        table = Table(*head)
        for row in rows:
            table.add_row(*row)
        console.print(table)
    console.print(verdict(result), soft_wrap=True)
