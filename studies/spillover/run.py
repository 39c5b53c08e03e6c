"""From a design to the folder with its certificate."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from jaxmodel.beam import BASES
from jaxmodel.changes import MachineChange
from studies.engine.breaking import TOLERANCES, smallest_change
from studies.engine.controller import fixed_controller
from studies.engine.design import Design, as_design
from studies.engine.progress import Phases
from studies.engine.run_data import run_attributes
from studies.engine.runs import resolved_study
from studies.errors import StudyError
from studies.publish import REPORT, announce, check_folder, publish
from studies.reading import read_json
from studies.results.document import json_text
from studies.results.labelled import variables
from studies.show.pages import write_report
from studies.show.report import print_result
from studies.spillover.certificate import Certificate, certify
from studies.spillover.fast_move import run_fast_move
from studies.spillover.proofs import prove
from studies.spillover.say import say
from studies.store import write_store
from studies.study.margin import GUESSED
from studies.study.spec import Study

DOCUMENT, DATA = "certificate.json", "spillover.h5"
PHASES = ("judge", "smallest change", "fast move", "draw")


def spillover_design(
    design: Design | Study | str | Path,
    out: str | Path,
    margin: float = 2.0,
    console: Console | None = None,
    has_pdf: bool = False,
    has_proofs: bool = False,
    tolerances: MachineChange = TOLERANCES,
    bases: tuple[str, ...] = tuple(BASES),
) -> Certificate:
    """Write the certificate of a design.

    Args:
        design: what to judge; or its study, or what `load_design` reads.
        out: folder for the files, created if missing.
        margin: gain margin required on every plant [1].
        console: where messages go; default: standard output.
        has_pdf: also write the figures as PDF.
        has_proofs: also prove stability for every number of modes and for a box of machines, where
            that is possible within a minute or two.
        tolerances: units of the smallest change that breaks it, see `smallest_change`.
        bases: modal bases of the plants.

    Returns:
        the certificate; `is_passed`: whether the design passes on every plant, and proofs found no
        unstable machine.

    Raises:
        StudyError: as `certify`, or a folder that cannot be written to.
    """
    design = as_design(design)
    out, console = Path(out), console or Console(highlight=False, markup=False)
    check_folder(out)
    study = resolved_study(design.study)
    _check_owner(out, study)
    names = (PHASES[0], "prove", *PHASES[1:]) if has_proofs else PHASES
    with Phases(console, names) as phases:
        phases.begin("judge", "the controller on plants that differ from its nominal model")
        certificate = certify(study, margin, bases=bases)
        if has_proofs:
            phases.begin("prove", "every number of modes, and a box of machines")
            certificate = certificate.replace(proofs=prove(fixed_controller(study)))
        phases.begin("smallest change", "of the machine that breaks the design")
        change = smallest_change(fixed_controller(certificate.study), tolerances)
        certificate = certificate.replace(smallest_change=change)
        phases.begin("fast move", "of the nominal machine, with and without control")
        certificate = _with_fast_move(certificate)
        phases.begin("draw")
        with publish(out) as staging:
            write_store(staging / DATA, variables(certificate), run_attributes(study))
            (staging / DOCUMENT).write_text(json_text(certificate), encoding="utf-8")
            write_report(report := say(certificate), staging, has_pdf)
    print_result(report, console)
    for note in (*certificate.notes, GUESSED):
        console.print(note, soft_wrap=True)
    announce(console, out / REPORT, ", data and figures in the same folder")
    return certificate


def _check_owner(out: Path, study: Study) -> None:
    """Leave another design's certificate alone.

    Raises:
        StudyError: there is one.
    """
    try:
        kept = read_json(out / DOCUMENT)["study"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if kept != study.model_dump(mode="json"):
        raise StudyError(
            f"--out {out}: has the certificate of another design; give another folder, or delete it"
        )


def _with_fast_move(certificate: Certificate) -> Certificate:
    """The same with its fast move, or with a note why it cannot run."""
    try:
        return certificate.replace(fast_move=run_fast_move(certificate.study))
    except StudyError as error:
        return certificate.replace(notes=(*certificate.notes, f"no fast move: {error}"))
