"""The commands of sweeps: sweep, show, plot, best, sensitivity."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from shlex import quote
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
from studies.options import (
    Explore,
    HasReport,
    MaybeOut,
    Precision,
    Quiet,
    Resume,
    SweepFile,
    Tolerance,
)
from studies.publish import EXPLORER, REPORT, announce
from studies.results.document import AsJson, print_document

if TYPE_CHECKING:
    from studies.engine.results import SweepData

#: Replaced in names of files: the brackets of entries.
_NO_NAME = r"[^\w.-]+"
Folder = Annotated[Path, typer.Argument(help="folder of a sweep")]


def _read(folder: Path) -> SweepData:
    """A sweep; says what of its folder is not shown."""
    from studies.engine.results import read_sweep

    data = read_sweep(folder)
    for note in data.notes:
        print(f"studies: {note}", file=sys.stderr)
    return data


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the commands of sweeps to the command line."""

    @app.command()
    def sweep(
        spec: SweepFile,
        out: MaybeOut = None,
        resume: Resume = False,
        dry_run: Annotated[
            bool, typer.Option("--dry-run", help="show what would run, and how long it would take")
        ] = False,
        quiet: Quiet = False,
        report: HasReport = False,
        explore: Explore = False,
        precision: Precision = "float64",
        scheduler: Scheduler = None,
        local_workers: LocalWorkers = None,
        worker_timeout: WorkerTimeout = TIMEOUT,
        as_json: AsJson = False,
    ) -> None:
        """Run thousands of cases from one file; finished cases survive any interruption."""
        from studies.engine.folder import SWEEPS, refuse_existing

        workers = Workers(scheduler, local_workers, worker_timeout)
        if as_json and not dry_run:
            raise StudyError("--json: for --dry-run only; the results: studies show DIR --json")
        if out is not None and not dry_run:
            refuse_existing(out, SWEEPS, resume)
        start(precision, gpu=not workers.are_named)
        from studies.engine.progress import Phases, duration_text
        from studies.space.spec import load_sweep
        from studies.sweeps.dry_run import plan_document, print_plan
        from studies.sweeps.run import make_plan, run_sweep, sweep_phases

        sweep_spec = load_sweep(spec)
        if dry_run and workers.are_named:
            raise StudyError("--dry-run: plans for this process only; leave the workers out")
        for name, is_wanted in (("--report", report), ("--explore", explore)):
            if dry_run and is_wanted:
                raise StudyError(f"{name}: --dry-run produces no results; leave one of them out")
        if dry_run:
            plan = make_plan(sweep_spec, out if resume else None)
            if as_json:
                print_document(plan_document(plan))
            else:
                print_plan(plan, console)
            return
        if out is None:
            raise StudyError("--out: name a folder for the results")

        names = (*sweep_phases(sweep_spec), *(["report"] if report else []))
        with Phases(console, names, quiet) as phases:
            done = run_sweep(sweep_spec, out, resume, workers=workers, phases=phases)
            if report and not done.is_interrupted:
                from studies.sweeps.say import write_sweep_report

                phases.begin("report")
                write_sweep_report(out)
        if len(done.lost):
            print(
                f"studies: {len(done.lost)} of {len(done.table)} cases were left out, see above; "
                f"retry them with --resume --out {quote(str(out))}",
                file=sys.stderr,
            )
        if done.is_interrupted:
            from studies.extensions import options

            print(
                f"studies: interrupted; {done.n_done} of {len(done.table)} cases are safe; "
                f"continue with: studies {options()}sweep {quote(str(spec))} --out "
                f"{quote(str(out))} --resume{workers.options}",
                file=sys.stderr,
            )
            sys.exit(130)
        if not quiet:
            console.print(
                f"{done.n_run} cases in {done.run_time:.1f} s and {done.compile_time:.1f} s of "
                f"compiling, {duration_text(phases.elapsed)} with all else; results: "
                f"{out / 'results.h5'}",
                soft_wrap=True,
            )
        if sweep_spec.screen is not None and not quiet:
            from studies.engine.results import read_sweep
            from studies.sweeps.screening import check_screen

            checked = check_screen(read_sweep(out, done.table))
            console.print("" if checked is None else checked.text, soft_wrap=True)
        if report and not quiet:
            announce(console, out / REPORT)
        if done.n_run and not explore:  # a page of fewer cases
            (out / EXPLORER).unlink(missing_ok=True)
        if explore:
            from studies.explorer.page import write_explorer
            from studies.sweeps.explore import explore_sweep

            write_explorer(out, explore_sweep, console, quiet)
        if len(done.lost):
            sys.exit(1)

    @app.command()
    def show(
        folder: Folder,
        failed: Annotated[bool, typer.Option("--failed", help="list failed cases")] = False,
        as_json: AsJson = False,
    ) -> None:
        """Show statuses and best cases of a sweep, or its failed cases."""
        from studies.sweeps.show import show as show_sweep

        data = _read(folder)
        if as_json:
            from studies.sweeps.documents import show_document

            print_document(show_document(data, failed))
            return
        show_sweep(data, console, failed)

    @app.command()
    def best(
        folder: Folder,
        by: Annotated[str, typer.Option(help="metric; the best come first, after - the worst")],
        subject_to: Annotated[str, typer.Option(help="condition on metrics and axes")] = "",
        count: Annotated[int, typer.Option(min=1, help="number of cases")] = 10,
        breaks: Annotated[
            bool,
            typer.Option("--breaks", help="also name the smallest change that breaks each of them"),
        ] = False,
        tolerance: Tolerance = None,
        as_json: AsJson = False,
    ) -> None:
        """List the best cases of a sweep by a metric."""
        if tolerance and not breaks:
            raise StudyError("--tolerance: for --breaks only; give both")
        if breaks:
            start()
        from studies.sweeps.show import print_best, print_left_out, ranked_cases

        data, agreed = _read(folder), ""
        if data.spec.sweep.fidelity == "linear":
            start()
            from studies.engine.fidelity import agreement

            if found := agreement(data.spec, data.table, by):
                found.check('Rank by another metric, or run the sweep with fidelity = "full".')
                agreed = found.text
        cases, changes = ranked_cases(data, by, subject_to, count), None
        if breaks:
            from studies.sweeps.breaking import breaking_changes

            changes = breaking_changes(folder, cases.tolist(), tolerance or [])
        if as_json:
            from studies.sweeps.documents import best_document

            document = best_document(data, by, cases, subject_to)
            print_document(document.replace(smallest_changes=changes and list(changes)))
            return
        print_best(data, by, subject_to, cases, console, agreed)
        print_left_out(data, console)
        for entry in changes or ():
            console.print(f"case {entry.case}: {entry.text}", soft_wrap=True)

    @app.command()
    def plot(
        folder: Folder,
        y: Annotated[
            str | None, typer.Option(help="metric or axis; default: the ranking metric")
        ] = None,
        x: Annotated[str | None, typer.Option(help="axis or metric; default: all axes")] = None,
        hue: Annotated[str | None, typer.Option(help="axis or metric for the colour")] = None,
        out: Annotated[
            Path | None, typer.Option(help="PNG, PDF or SVG; default: in FOLDER")
        ] = None,
    ) -> None:
        """Plot a sweep; the axes determine the kind of figure."""
        from studies.sweeps.plots import plot as draw
        from studies.sweeps.plots import save_plot
        from studies.sweeps.show import print_left_out, ranking

        data = _read(folder)
        y = y or ranking(data)
        parts = (("", y), ("-over-", x), ("-by-", hue))
        name = "".join(f"{word}{part}" for word, part in parts if part)
        path = out or folder / f"{re.sub(_NO_NAME, '_', name).strip('_')}.png"
        save_plot(draw(data, x, y, hue), path)
        print_left_out(data, console)
        console.print(f"written: {path}", soft_wrap=True)

    @app.command()
    def sensitivity(
        folder: Folder,
        by: Annotated[str, typer.Option(help="metric")] = "residual_rms",
        as_json: AsJson = False,
    ) -> None:
        """Show which parameters matter, from a sweep with method morris or saltelli."""
        from studies.show.listing import Rows, print_rows
        from studies.sweeps.sensitivity import analyse
        from studies.sweeps.show import label

        data = _read(folder)
        analysis = analyse(data, by)
        if as_json:
            from studies.sweeps.documents import sensitivity_document

            print_document(sensitivity_document(data, by, analysis))
            return
        design = f"a {data.spec.sweep.method} design"
        console.print(f"{label(data, by)}, {len(data.table.origin)} rows of {design}")
        for note in analysis.notes:
            console.print(note)
        print_rows(Rows(list(analysis.heads), [list(row) for row in analysis.rows]), console)
        if analysis.n_left_out:
            console.print(
                f"left out because of failed cases: {analysis.n_left_out} {analysis.what}"
            )
