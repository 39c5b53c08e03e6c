"""From the file to the folder: stage after stage, or a refusal with reasons."""

from __future__ import annotations

from studies.commission.findings import CommissionFindings
from studies.commission.spec import MeasuredSpec
from studies.commission.stages import STAGES
from studies.errors import StudyError
from studies.job import Job
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.show.pages import write_report

DOCUMENT = "commission.json"
#: What is done, with what it takes on two cores [s].
PHASES = {name: stage.seconds for name, stage in STAGES.items()}
#: Modules that determine the numbers, with everything they import.
DECISIVE = ("studies.commission.stages",)


def commissioned(measured: MeasuredSpec, job: Job) -> CommissionFindings:
    """All stages, up to the first one whose answer does not support the next.

    Args:
        measured: what was asked for.
        job: with `PHASES`; each stage has a folder in its own.

    Raises:
        StudyError: a fault of the file.
    """
    out = job.place
    known = CommissionFindings(out, measured, measured.study.title)
    for name, stage in STAGES.items():
        job.begin(name, stage.text)
        known = known.replace(last_stage=name)
        try:
            known = stage.run(known, job)
        except StudyError as error:
            if known.fit is None:  # nothing is known yet: the file is at fault
                raise
            known = known.replace(refusals=(f"{name}: {error}",))
        if known.refusals:
            break
    with publish(out) as staging:
        (staging / DOCUMENT).write_text(json_text(known), encoding="utf-8")
        write_report(known.report(), staging)
    return in_folder(known, out, out / REPORT)
