"""From the file to the folder: stage after stage, each done once, or a refusal with reasons.

`request.json` says what was asked for; a stage whose answer is in its folder is not done again,
but the answer must be as it was written (`answers.json`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from studies.commission.findings import CommissionFindings
from studies.commission.machines import margins_on
from studies.commission.spec import MeasuredSpec
from studies.commission.stages import (
    STAGES,
    Stage,
    certificate_document,
    check_answer,
    fit_document,
    has_fast_motion,
    is_verified,
    keep_answer,
    possible_machines,
    price_text,
    tuned_design,
)
from studies.errors import StudyError
from studies.job import Job
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.show.pages import write_report

DOCUMENT = "commission.json"
#: What is done, with what it takes on two cores [s].
PHASES = {"fit": 60.0, "tune": 240.0, "certificate": 30.0, "firmware": 60.0}
#: Modules that determine the numbers, with everything they import.
DECISIVE = ("studies.commission.stages", "studies.commission.machines")


def commissioned(measured: MeasuredSpec, job: Job) -> CommissionFindings:
    """All stages, up to the first one whose answer does not support the next.

    Args:
        measured: what was asked for.
        job: with `PHASES`; each stage has a folder in its own.

    Raises:
        StudyError: a stage that cannot run.
    """
    out = job.place
    outcome = CommissionFindings(out, measured, measured.study.title)
    for stage in STAGES:
        job.begin(stage.name, stage.text)
        fault = _run(stage, measured, job)
        outcome = _judged(outcome, stage, fault, measured, job)
        keep_answer(stage, out)
        if outcome.refusals:
            break
    with publish(out) as staging:
        (staging / DOCUMENT).write_text(json_text(outcome), encoding="utf-8")
        write_report(outcome.report(), staging)
    return in_folder(outcome, out, out / REPORT)


def _run(stage: Stage, measured: MeasuredSpec, job: Job) -> str:
    """Do a stage unless it is done; what it refuses, "" if nothing."""
    if stage.is_done(job.place):
        check_answer(stage, job.place)
        job.say("already computed")
        return ""
    try:
        stage.make(measured, job)
    except StudyError as error:
        if stage is STAGES[0]:  # nothing is known yet: the file is at fault
            raise
        return str(error)
    return ""


def _judged(
    outcome: CommissionFindings, stage: Stage, fault: str, measured: MeasuredSpec, job: Job
) -> CommissionFindings:
    """The outcome with a stage's answer, and with what speaks against going on."""
    outcome = outcome.replace(last_stage=stage.name)
    if fault:
        return outcome.replace(refusals=(f"{stage.name}: {fault}",))
    return _JUDGES[stage.name](outcome, measured.commission.gain_margin, job)


def _judge_fit(outcome: CommissionFindings, wanted: float, job: Job) -> CommissionFindings:
    """Its gravest messages, if it is no ground for a design."""
    fit = fit_document(outcome.out)
    is_ground = fit["is_explained"] and fit["is_converged"]
    texts = () if is_ground else tuple(str(text) for text in fit["messages"][:3])
    return outcome.replace(fit=fit, refusals=texts)


def _judge_tuned(outcome: CommissionFindings, wanted: float, job: Job) -> CommissionFindings:
    """The gain margins of its controller on all possible machines."""
    margins = _margins(job)
    tuned = tuned_design(outcome.out).study
    is_fast = has_fast_motion(outcome.out, tuned)
    price = price_text(outcome.out, tuned)
    outcome = outcome.replace(tuned=tuned, is_fast=is_fast, margins=margins, price=price)
    low = int(np.sum(margins < wanted))
    text = (
        f"on {low} of {len(margins)} machines that the data leave possible the gain margin "
        f"is below {wanted:g}, down to {margins.min():.3g}"
    )
    return outcome.replace(refusals=(text,) if low else ())


def _judge_certificate(outcome: CommissionFindings, wanted: float, job: Job) -> CommissionFindings:
    certificate = certificate_document(outcome.out)
    text = f"certificate {certificate['verdict']}"
    refusals = () if certificate["is_passed"] else (text,)
    return outcome.replace(certificate=certificate, refusals=refusals)


def _judge_firmware(outcome: CommissionFindings, wanted: float, job: Job) -> CommissionFindings:
    text = "the exported code does not behave as the controller that was designed"
    return outcome.replace(refusals=() if is_verified(outcome.out) else (text,))


#: By name of the stage: its answer, of the outcome so far and the least gain margin.
_JUDGES: dict[str, Callable[[CommissionFindings, float, Job], CommissionFindings]] = {
    "fit": _judge_fit,
    "tune": _judge_tuned,
    "certificate": _judge_certificate,
    "firmware": _judge_firmware,
}


def _margins(job: Job) -> np.ndarray:
    """Gain margins on all possible machines, kept in the folder."""
    machines, study = possible_machines(job.place), tuned_design(job.place).study
    job.say(f"gain margins on {len(machines.values)} machines that the data leave possible")
    return job.part("margins", lambda: margins_on(machines, study), study.model_dump_json())
