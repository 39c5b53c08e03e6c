"""The command `studies twin`."""

from __future__ import annotations

import typer
from rich.console import Console

from studies.config import start
from studies.options import Case, Design, MaybeOut
from studies.results.document import AsJson, print_document


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def twin(
        design: Design,
        out: MaybeOut = None,
        case: Case = None,
        as_json: AsJson = False,
    ) -> None:
        """Repeat the loop with a machine in Exudyn and the exported controller, and compare."""
        from studies.twin.multibody import load_exudyn

        load_exudyn()  # before anything that takes long
        start()
        from studies.engine.design import load_design
        from studies.twin.run import twin_design

        loaded = load_design(design, case)
        quiet = Console(quiet=True) if as_json else console
        result = twin_design(loaded, out, quiet)
        from studies.show.report import print_report
        from studies.twin.say import say, twin_document

        if as_json:
            print_document(twin_document(result))
        else:
            print_report(say(result), console)
