"""The command `studies paper`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from studies.config import start


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def paper(
        out: Annotated[Path, typer.Option(help="folder for data, figures and report")],
        precision: Annotated[str, typer.Option(help="float64 or float32")] = "float64",
        pdf: Annotated[bool, typer.Option("--pdf", help="also write the figures as PDF")] = False,
    ) -> None:
        """Run the paper's study: data, counterparts of its figures, comparison with its numbers."""
        start(precision)
        from studies.paper.run import run_paper

        run_paper(out, console, pdf)
