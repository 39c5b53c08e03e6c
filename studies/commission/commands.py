"""The command `studies commission`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.options import Out, Resume


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def commission(
        measured: Annotated[
            Path, typer.Argument(help="file with measurements, wishes and processor (TOML)")
        ],
        out: Out,
        resume: Resume = False,
    ) -> None:
        """Lead from measurements to verified firmware: fit, tune, certify, export.

        Ends with 1 and says why if the data do not support a controller.
        """
        from studies.engine.folder import COMMISSIONINGS, refuse_existing, resumable

        refuse_existing(out, COMMISSIONINGS, resume)
        start()
        from studies.commission.run import run_commission
        from studies.commission.spec import load_measured

        spec = load_measured(measured)
        with resumable(out):
            made = run_commission(spec, out, resume, console)
        if not made.is_good:
            sys.exit(1)
