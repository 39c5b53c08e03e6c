"""The command `studies screen`."""

from __future__ import annotations

import sys
from enum import StrEnum
from shlex import quote
from typing import Annotated

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
from studies.options import Out, Precision, Quiet, Resume, SweepFile
from studies.publish import REPORT, announce
from studies.study.margin import ENOUGH


class Fidelity(StrEnum):
    """Model of the runs."""

    LINEAR = "linear"
    FULL = "full"


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def screen(
        spec: SweepFile,
        out: Out,
        by: Annotated[
            str, typer.Option(help="metric; default: sweep.by. After - the largest come first")
        ] = "",
        keep: Annotated[int, typer.Option(help="number of designs to keep")] = 1000,
        margin: Annotated[
            float, typer.Option(help="least gain margin of the designs to keep; 0: any")
        ] = ENOUGH,
        fidelity: Annotated[
            Fidelity, typer.Option(help="model of the runs; full takes about twice as long")
        ] = Fidelity.LINEAR,
        resume: Resume = False,
        quiet: Quiet = False,
        precision: Precision = "float64",
        scheduler: Scheduler = None,
        local_workers: LocalWorkers = None,
        worker_timeout: WorkerTimeout = TIMEOUT,
    ) -> None:
        """Find the best of up to a billion designs: keeps these, not all cases as a sweep does.

        Writes best.toml, a sweep of the kept designs; run it to judge them by the full model.
        """
        from studies.engine.folder import SCREENS, refuse_existing, resumable

        workers = Workers(scheduler, local_workers, worker_timeout)
        refuse_existing(out, SCREENS, resume)
        start(precision, gpu=not workers.are_named)
        from studies.engine.progress import Phases
        from studies.extensions import options
        from studies.screen.run import PHASES, run_screen
        from studies.screen.say import say, write_screen_report
        from studies.screen.shards import screen_of
        from studies.screen.stored import BEST
        from studies.show.report import print_result
        from studies.show.units import count_text
        from studies.space.spec import load_sweep

        asked = screen_of(load_sweep(spec), by, keep, margin, fidelity.value)
        asks = (
            f"--by={quote(asked.by)} --keep {keep} --margin {margin} --fidelity {fidelity} "
            f"--precision {precision}"
        )
        again = (
            f"studies {options()}screen {quote(str(spec))} --out {quote(str(out))} {asks} --resume"
            f"{workers.options}"
        )

        with resumable(out, again), Phases(console, PHASES, quiet) as phases:
            done = run_screen(asked, out, workers=workers, phases=phases)
            if not done.is_interrupted:
                phases.begin("report")
                write_screen_report(out, done)
        if done.is_interrupted:
            print(
                f"studies: interrupted; {done.tally.n_designs:,} of {asked.n_designs:,} designs "
                f"are safe; continue with: {again}",
                file=sys.stderr,
            )
            sys.exit(130)
        if not quiet:
            report = say(done, out)
            print_result(report, console)
            best = f"studies {options()}sweep {quote(str(out / BEST))} --out DIR"
            text = f"the full model of the best: {best}" if done.n_kept else report.next_steps
            console.print(text, soft_wrap=True)
            announce(console, out / REPORT)
        if done.lost:
            print(
                f"studies: of {count_text(asked.n_shards, 'shard')}, {len(done.lost)} left out, "
                f"see above; retry: {again}",
                file=sys.stderr,
            )
            sys.exit(1)
