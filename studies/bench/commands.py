"""The command `studies bench`."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from studies.config import start
from studies.options import Precision
from studies.results.document import AsJson, print_document


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def bench(
        work: Annotated[str, typer.Option(help="W0, W1, W8, grad or sweep; default: W1")] = "",
        executor: Annotated[
            str, typer.Option(help="kernel, scan or gpu; default: the fastest")
        ] = "",
        batch: Annotated[
            int, typer.Option(min=0, max=2**20, help="cases per chunk; 0: automatic")
        ] = 0,
        cases: Annotated[int, typer.Option(min=0, help="cases in the sweep; 0: 100,000")] = 0,
        precision: Precision = "float64",
        as_json: AsJson = False,
    ) -> None:
        """Measure speed and memory on this machine."""
        start(precision, gpu=True)
        from studies.bench.run import run_bench

        found = run_bench(work, executor, batch, cases)
        if as_json:
            print_document(found)
        else:
            console.print(_figures(found.figures))


def _figures(figures: dict[str, Any]) -> Table:
    table = Table(show_header=False)
    for name, value in figures.items():
        parts = value if isinstance(value, dict) else {"": value}
        for part, number in parts.items():
            table.add_row(f"{name} {part}".strip(), str(number))
    return table
