"""The command `studies spillover`."""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.options import Case, Design, Out, Pdf, Tolerance


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def spillover(
        design: Design,
        out: Out,
        case: Case = None,
        margin: Annotated[
            float, typer.Option(help="gain margin required on every plant [1]; 2 is 6 dB")
        ] = 2.0,
        prove: Annotated[
            bool,
            typer.Option(
                "--prove",
                help="also prove stability for every number of modes and a box of machines; an "
                "unstable machine of the box fails the design",
            ),
        ] = False,
        tolerance: Tolerance = None,
        pdf: Pdf = False,
    ) -> None:
        """Certify a controller on plants that differ from its model."""
        from studies.publish import check_folder

        check_folder(out)
        start()
        from studies.engine.breaking import parse_tolerances
        from studies.engine.design import load_design
        from studies.spillover.run import spillover_design

        made = spillover_design(
            load_design(design, case),
            out,
            margin,
            console,
            pdf,
            prove,
            parse_tolerances(tolerance or []),
        )
        if not made.is_passed:
            sys.exit(1)
