"""The command `studies laws`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.options import Case, Design, Out, Quiet, Resume
from studies.publish import REPORT, announce


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def laws(
        design: Design,
        out: Out,
        case: Case = None,
        voltage: Annotated[
            float | None,
            typer.Option(help="largest actuator voltage [V]; default: what the design needs"),
        ] = None,
        margin: Annotated[float, typer.Option(help="least disk margin [1]")] = 0.4,
        resume: Resume = False,
        quiet: Quiet = False,
    ) -> None:
        """Compare control laws and drives, each tuned to one budget, on machines they never saw.

        Takes about 20 minutes on two cores; --resume continues an interrupted comparison.
        """
        from studies.engine.folder import COMPARISONS, refuse_existing, resumable

        refuse_existing(out, COMPARISONS, resume)
        start()
        from studies.engine.design import load_design
        from studies.laws.run import run_laws

        study = load_design(design, case).study
        with resumable(out):
            run_laws(study, out, voltage, margin, resume, console, quiet)
        announce(console, out / REPORT)
