"""The command `studies tune`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from studies.cluster.connect import (
    TIMEOUT,
    LocalWorkers,
    Scheduler,
    Workers,
    WorkerTimeout,
)
from studies.config import start
from studies.errors import StudyError
from studies.options import Explore, MaybeOut, Quiet, Resume

if TYPE_CHECKING:
    from studies.tuning.spec import TuneSpec


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def tune(
        spec: Annotated[
            Path, typer.Argument(help="tuning file (TOML), or `tune`, a ready-made one")
        ],
        out: MaybeOut = None,
        resume: Resume = False,
        audit: Annotated[
            bool, typer.Option("--audit", help="only check derivatives against finite differences")
        ] = False,
        explore: Explore = False,
        quiet: Quiet = False,
        scheduler: Scheduler = None,
        local_workers: LocalWorkers = None,
        worker_timeout: WorkerTimeout = TIMEOUT,
    ) -> None:
        """Tune parameters of a study by gradients, within limits, for many machines at once."""
        from studies.engine.folder import TUNINGS, refuse_existing

        workers = Workers(scheduler, local_workers, worker_timeout)
        if out is not None and not audit:
            refuse_existing(out, TUNINGS, resume)
        start()
        from studies.publish import REPORT, announce
        from studies.tuning.run import run_tuning
        from studies.tuning.spec import load_tuning

        tuning = load_tuning(spec)
        if audit and (out or resume or quiet or explore or workers.are_named):
            raise StudyError(
                "--audit: writes no files; leave --out, --resume, --explore, --quiet and workers "
                "out"
            )
        if audit:
            _audit(tuning, console)
            return
        if out is None:
            raise StudyError("--out: name a folder for the results")

        run_tuning(tuning, out, resume, console, quiet, workers)
        announce(console, out / REPORT, "; tuned studies in the same folder")
        if explore:
            from studies.explorer.page import write_explorer
            from studies.tuning.explore import explore_tuning

            write_explorer(out, explore_tuning, console, quiet)


def _audit(spec: TuneSpec, console: Console) -> None:
    from studies.show.listing import Rows, print_rows
    from studies.tuning.audit import ALLOWED, DESIGNS, MEANING, audit

    console.print(f"comparing derivatives with finite differences at {DESIGNS} designs")
    heads = ["parameter", "family", "worst for", "at", "derivative", "difference", "disagreement"]
    rows, checks = [], audit(spec)
    for x in checks:
        numbers = f"{x.derivative:.6g}", f"{x.difference:.6g}", f"{x.share:.1e}"
        rows.append([x.name, x.family, x.figure, f"{x.place + 1}", *numbers])
    print_rows(Rows(heads, rows), console)
    console.print(f"Design 1 is close to the baseline. {MEANING}", soft_wrap=True)
    worst = max(check.share for check in checks)
    is_fine = worst <= ALLOWED
    console.print(f"worst: {worst:.1e}, {'below' if is_fine else 'above'} {ALLOWED:g}")
    if not is_fine:
        sys.exit(1)
