"""The command `studies fit`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.options import Explore, Out, Pdf


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def fit(
        data: Annotated[
            Path, typer.Argument(help="file of a fit (TOML), or the name of a ready-made one")
        ],
        out: Out,
        pdf: Pdf = False,
        explore: Explore = False,
    ) -> None:
        """Fit parameters of a study to measurements, and say how well they are known."""
        from studies.publish import check_folder

        check_folder(out)
        start()
        from studies.fitting.run import run_fit
        from studies.fitting.spec import load_fit

        run_fit(load_fit(data), out, console, pdf)
        if explore:
            from studies.explorer.page import write_explorer
            from studies.fitting.explore import explore_fit

            write_explorer(out, explore_fit, console)
