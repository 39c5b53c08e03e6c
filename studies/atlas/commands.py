"""The command `studies atlas`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.options import Case, Explore, Out, Pdf, Quiet, Resume
from studies.publish import REPORT, announce


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the command to the command line."""

    @app.command()
    def atlas(
        out: Out,
        design: Annotated[
            Path | None,
            typer.Argument(
                help="study file, folder of a tuning or a sweep; default: the paper's design"
            ),
        ] = None,
        case: Case = None,
        resume: Resume = False,
        pdf: Pdf = False,
        explore: Explore = False,
        quiet: Quiet = False,
    ) -> None:
        """Map all subsets of controlled links and modes, workspace modes and platform error."""
        from studies.engine.folder import ATLASES, refuse_existing

        refuse_existing(out, ATLASES, resume)
        start()
        from studies.atlas.run import run_atlas
        from studies.engine.design import load_design
        from studies.errors import StudyError
        from studies.study.spec import paper_study

        if design is not None:
            study = load_design(design, case).study
        elif case is not None:
            raise StudyError(f"--case {case}: needs a DESIGN; name one, or leave --case out")
        else:  # as in the paper, every run's ratios come from its own uncontrolled counterpart
            study = paper_study().change(control__ratio_source="own_run")
        if not run_atlas(study, out, resume, console, quiet, pdf):
            print(
                f"studies: interrupted; finished runs are safe; continue with --resume --out {out}",
                file=sys.stderr,
            )
            sys.exit(130)
        announce(console, out / REPORT)
        if explore:
            from studies.atlas.explore import explore_atlas
            from studies.explorer.page import write_explorer

            write_explorer(out, explore_atlas, console, quiet)
