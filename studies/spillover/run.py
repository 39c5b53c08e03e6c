"""From a design to the folder with its certificate."""

from __future__ import annotations

from jaxmodel.beam import BASES
from jaxmodel.changes import MachineChange
from studies.engine.breaking import smallest_change
from studies.engine.controller import fixed_controller
from studies.engine.run_data import run_attributes
from studies.errors import StudyError
from studies.job import Job
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.results.labelled import variables
from studies.show.pages import write_report
from studies.space.machines import TOLERANCES
from studies.spillover.certificate import Certificate, certify
from studies.spillover.fast_move import ControlEffect, run_fast_move
from studies.spillover.proofs import prove
from studies.store import write_store
from studies.study.spec import Study

DOCUMENT, DATA = "certificate.json", "spillover.h5"
#: Modules that determine the numbers, with everything they import.
DECISIVE = tuple(f"studies.spillover.{x}" for x in ("certificate", "fast_move", "proofs"))


def phases(has_proofs: bool) -> dict[str, float]:
    """What is done, with what it takes on two cores [s]."""
    proofs = {"prove": 60.0} if has_proofs else {}
    return {"judge": 12.0, **proofs, "smallest change": 4.0, "fast move": 6.0, "draw": 6.0}


def certified(
    study: Study,
    job: Job,
    margin: float,
    has_pdf: bool = False,
    has_proofs: bool = False,
    tolerances: MachineChange = TOLERANCES,
    bases: tuple[str, ...] = tuple(BASES),
) -> Certificate:
    """Judge a design, and write its certificate if the job has a folder.

    Args:
        study: what to judge, complete.
        job: with the phases of `phases`.
        margin, has_pdf, has_proofs, tolerances: as in `studies.certify`.
        bases: modal bases of the plants.

    Raises:
        StudyError: as `studies.spillover.certificate.certify`.
    """
    job.begin("judge", "the controller on plants that differ from its nominal model")
    certificate = job.part("plants", lambda: certify(study, margin, bases=bases))
    if has_proofs:
        job.begin("prove", "every number of modes, and a box of machines")
        proofs = job.part("proofs", lambda: prove(fixed_controller(study)))
        certificate = certificate.replace(proofs=proofs)
    job.begin("smallest change", "of the machine that breaks the design")
    change = job.part(
        "smallest change", lambda: smallest_change(fixed_controller(study), tolerances)
    )
    job.begin("fast move", "of the nominal machine, with and without control")
    move, faults = job.part("fast move", lambda: _fast_move(study))
    certificate = certificate.replace(
        smallest_change=change, fast_move=move, notes=(*certificate.notes, *faults)
    )
    if job.folder is None:
        return certificate
    job.begin("draw")
    with publish(job.folder) as staging:
        write_store(staging / DATA, variables(certificate), run_attributes(study))
        (staging / DOCUMENT).write_text(json_text(certificate), encoding="utf-8")
        write_report(certificate.report(), staging, has_pdf)
    return in_folder(certificate, job.folder, job.folder / REPORT)


def _fast_move(study: Study) -> tuple[ControlEffect | None, tuple[str, ...]]:
    """The fast move of a study, or a note why it cannot run."""
    try:
        return run_fast_move(study), ()
    except StudyError as error:
        return None, (f"no fast move: {error}",)
