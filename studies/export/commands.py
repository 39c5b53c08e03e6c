"""The commands `studies export` and `studies import-gains`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.errors import StudyError
from studies.options import Case, Design, Out


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the commands to the command line."""

    @app.command()
    def export(
        design: Design,
        out: Out,
        target: Annotated[
            str | None, typer.Option(help="json, c, or c-fixed (32-bit fixed point)")
        ] = None,
        case: Case = None,
        verify: Annotated[
            bool | None,
            typer.Option(
                "--verify/--no-verify",
                help="compare with the JAX controller; default: if a C compiler is found",
            ),
        ] = None,
        name: Annotated[str, typer.Option(help="name of the files and C functions")] = "flexlink",
        dac_bits: Annotated[
            int | None, typer.Option(help="DAC resolution [bit], for c-fixed; default: 12")
        ] = None,
        pil: Annotated[
            str | None,
            typer.Option(
                help="emulated processor that runs the code, too: cortex-m3, cortex-m4, "
                "cortex-m4f or cortex-m7; with a project to build for it"
            ),
        ] = None,
        compare: Annotated[
            bool,
            typer.Option(
                "--compare",
                help="no code, but a table: single precision, 32 and 16 bits at 5, 10 and 20 kHz",
            ),
        ] = False,
    ) -> None:
        """Export the controller of a design to a real-time target, and verify it."""
        from studies.publish import check_folder

        if compare and (target is not None or verify is not None):
            other = "--target" if target is not None else "--verify"
            raise StudyError(f"--compare: not allowed with {other}; leave one of them out")
        if not compare and target is None:
            raise StudyError("--target: missing; allowed: json, c, c-fixed (or --compare)")
        check_folder(out)
        start()
        from studies.engine.design import load_design
        from studies.export.run import export_design

        chosen = load_design(design, case)
        if target is None:
            from studies.export.comparison import compare_variants

            has_failed = not compare_variants(chosen, out, dac_bits, pil, console).is_good
        else:
            made = export_design(chosen, target, out, verify, name, dac_bits, console, pil)
            has_failed = made.has_failed
        if has_failed:
            sys.exit(1)

    @app.command("import-gains")
    def import_gains(
        file: Annotated[Path, typer.Argument(help="JSON file written by studies export")],
        out: Annotated[Path, typer.Option(help="study file to write")],
    ) -> None:
        """Check the numbers of an exported JSON file and recover its study."""
        from studies.study.template import check_new, write_study

        check_new(out)
        start()
        from studies.export.document import import_study

        write_study(out, import_study(file))
        console.print(f"written: {out}", soft_wrap=True)
