"""The command `studies paper`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.errors import StudyError
from studies.options import MaybeOut, Pdf, Precision


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def paper(
        name: Annotated[str, typer.Argument(help="of a card; default: list them")] = "",
        out: MaybeOut = None,
        precision: Precision = "float64",
        pdf: Pdf = False,
    ) -> None:
        """Test what a paper claims: outcome of each claim, data, figures, open numbers."""
        start(precision)
        from studies.papers.catalogue import CARDS, NOTEBOOKS, find_card
        from studies.papers.run import run_card

        if name:
            card = find_card(name)
            if out is None:
                raise StudyError(f"--out: missing; name a folder for the results of {name!r}")
            run_card(card, out, console, pdf)
            return
        if out is not None:
            raise StudyError(f"NAME: missing; allowed: {', '.join(CARDS)}")
        for one in CARDS.values():
            console.print(f"{one.name}: {one.title}", soft_wrap=True)
        for paper, notebook in NOTEBOOKS.items():
            console.print(f"{paper}: {notebook}", soft_wrap=True)
