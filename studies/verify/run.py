"""All checks of a study, in order, and their outcome kept for later reports."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from studies import passport
from studies.errors import StudyError
from studies.job import Job
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.show.pages import write_report
from studies.study.spec import Study
from studies.verify.links import check_links
from studies.verify.loops import check_loops
from studies.verify.machine import check_machine
from studies.verify.outside import check_outside
from studies.verify.result import ModelVerification
from studies.verify.rows import Assumption
from studies.verify.stepping import check_stepping
from studies.verify.trajectories import check_trajectories

DOCUMENT = "verification.json"
#: What is checked, in this order, by names for progress.
CHECKS: dict[str, Callable[[Study], list[Assumption]]] = {
    "links and patches": check_links,
    "trajectories and shapers": check_trajectories,
    "mechanics": check_machine,
    "time steps, kernels, metrics": check_stepping,
    "digital loop": check_loops,
    "figures of others": check_outside,
}

#: What each takes on two cores [s].
PHASES = dict(zip(CHECKS, (10.0, 2.0, 16.0, 50.0, 70.0, 20.0), strict=True))
#: Modules that determine the numbers, with everything they import.
DECISIVE = tuple(check.__module__ for check in CHECKS.values())


def verified(study: Study, job: Job) -> ModelVerification:
    """Check every assumption of the model; the outcome is kept for later reports.

    Args:
        study: that can run.
        job: with `PHASES`.
    """
    rows: list[Assumption] = []
    for name, check in CHECKS.items():
        job.begin(name)
        rows += job.part(name, partial(_rows, name, check, study))
    found = ModelVerification(study, tuple(rows))
    passport.keep(study, found.summary)
    if job.folder is None:
        return found
    with publish(job.folder) as staging:
        (staging / DOCUMENT).write_text(json_text(found), encoding="utf-8")
        write_report(found.report(), staging)
    return in_folder(found, job.folder, job.folder / REPORT)


def _rows(name: str, check: Callable[[Study], list[Assumption]], study: Study) -> list[Assumption]:
    """Rows of a check, or the row that says why it could not be made."""
    try:
        return check(study)
    except (StudyError, FloatingPointError, np.linalg.LinAlgError, ValueError) as error:
        note = f"it could not be checked: {error}"
        return [
            Assumption(
                assumption=name,
                against="-",
                source="-",
                difference=np.inf,
                allowed=0.0,
                note=note,
            )
        ]
