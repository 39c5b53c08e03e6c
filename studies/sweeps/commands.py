"""The commands that read sweeps: show, plot, best, sensitivity."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from studies.commands import settings
from studies.config import start
from studies.errors import StudyError
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
    """Add the commands to the command line."""

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
        tolerance: Annotated[
            list[str] | None,
            typer.Option(help="NAME=VALUE, of --breaks, as in `studies certify`"),
        ] = None,
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

            changes = breaking_changes(folder, cases.tolist(), settings("--tolerance", tolerance))
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
