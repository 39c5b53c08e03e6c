"""From the file to the folder: stage after stage, each done once, or a refusal with reasons.

`request.json` says what was asked for; a stage whose answer is in its folder is not done again,
but the answer must be as it was written (`answers.json`).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console

from studies import config
from studies.commission.findings import CommissionFindings
from studies.commission.machines import margins_on
from studies.commission.say import say
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
from studies.engine.folder import (
    COMMISSIONINGS,
    keep_request,
    locked_folder,
    make_manifest,
    refuse_existing,
)
from studies.errors import StudyError
from studies.export.firmware.build import check_tools
from studies.publish import REPORT, announce, publish, replacing
from studies.results.document import json_text
from studies.show.pages import write_report
from studies.show.report import print_result

DOCUMENT, MARGINS = "commission.json", "margins.npy"
#: Modules that determine the numbers, with everything they import.
DECISIVE = ("studies.commission.stages", "studies.commission.machines")


def run_commission(
    measured: MeasuredSpec,
    out: str | Path,
    is_resumed: bool = False,
    console: Console | None = None,
) -> CommissionFindings:
    """Lead from measurements to verified firmware, or refuse and say what is missing.

    Args:
        measured: from `load_measured`.
        out: folder; each stage has one of its own in it.
        is_resumed: go on with an interrupted commissioning.
        console: where messages go; default: standard output.

    Raises:
        StudyError: a fault of the file or the folder; a stage that cannot run.
    """
    config.require_configured()
    out, console = Path(out), console or Console(highlight=False, markup=False)
    if measured.commission.processor:
        check_tools()
    with locked_folder(out, "commissioning"):
        refuse_existing(out, COMMISSIONINGS, is_resumed)
        request = make_manifest(measured.data, DECISIVE) | {"files": measured.data_files()}
        checked = {"spec": "file", "code": "program", "files": "set of data"}
        keep_request(out / COMMISSIONINGS.mark, request, checked)
        outcome = _outcome(measured, out, console)
        with publish(out) as staging:
            (staging / DOCUMENT).write_text(json_text(outcome), encoding="utf-8")
            write_report(report := say(outcome), staging)
    print_result(report, console)
    announce(console, out / REPORT)
    return outcome


def _outcome(measured: MeasuredSpec, out: Path, console: Console) -> CommissionFindings:
    """All stages, up to the first one whose answer does not support the next."""
    outcome = CommissionFindings(out, measured, measured.study.title)
    for stage in STAGES:
        fault = _run(stage, measured, out, console)
        outcome = _judged(outcome, stage, fault, measured, console)
        keep_answer(stage, out)
        if outcome.refusals:
            break
    return outcome


def _run(stage: Stage, measured: MeasuredSpec, out: Path, console: Console) -> str:
    """Do a stage unless it is done; what it refuses, "" if nothing."""
    number = f"stage {STAGES.index(stage) + 1} of {len(STAGES)}, {stage.name}"
    if stage.is_done(out):
        check_answer(stage, out)
        console.print(f"{number}: already computed")
        return ""
    console.print(f"{number}: {stage.text}")
    try:
        stage.make(measured, out, console)
    except StudyError as error:
        if stage is STAGES[0]:  # nothing is known yet: the file is at fault
            raise
        return str(error)
    return ""


def _judged(
    outcome: CommissionFindings, stage: Stage, fault: str, measured: MeasuredSpec, console: Console
) -> CommissionFindings:
    """The outcome with a stage's answer, and with what speaks against going on."""
    outcome = outcome.replace(last_stage=stage.name)
    if fault:
        return outcome.replace(refusals=(f"{stage.name}: {fault}",))
    return _JUDGES[stage.name](outcome, measured.commission.gain_margin, console)


def _judge_fit(outcome: CommissionFindings, wanted: float, console: Console) -> CommissionFindings:
    """Its gravest messages, if it is no ground for a design."""
    fit = fit_document(outcome.out)
    is_ground = fit["is_explained"] and fit["is_converged"]
    texts = () if is_ground else tuple(str(text) for text in fit["messages"][:3])
    return outcome.replace(fit=fit, refusals=texts)


def _judge_tuned(
    outcome: CommissionFindings, wanted: float, console: Console
) -> CommissionFindings:
    """The gain margins of its controller on all possible machines."""
    margins = _margins(outcome.out, console)
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


def _judge_certificate(
    outcome: CommissionFindings, wanted: float, console: Console
) -> CommissionFindings:
    certificate = certificate_document(outcome.out)
    text = f"certificate {certificate['verdict']}"
    refusals = () if certificate["is_passed"] else (text,)
    return outcome.replace(certificate=certificate, refusals=refusals)


def _judge_firmware(
    outcome: CommissionFindings, wanted: float, console: Console
) -> CommissionFindings:
    text = "the exported code does not behave as the controller that was designed"
    return outcome.replace(refusals=() if is_verified(outcome.out) else (text,))


#: By name of the stage: its answer, of the outcome so far and the least gain margin.
_JUDGES: dict[str, Callable[[CommissionFindings, float, Console], CommissionFindings]] = {
    "fit": _judge_fit,
    "tune": _judge_tuned,
    "certificate": _judge_certificate,
    "firmware": _judge_firmware,
}


def _margins(out: Path, console: Console) -> np.ndarray:
    """Gain margins on all possible machines, kept in the folder."""
    file = out / "tune" / MARGINS
    if file.is_file():
        return np.load(file)
    machines = possible_machines(out)
    console.print(f"gain margins on {len(machines.values)} machines that the data leave possible")
    margins = margins_on(machines, tuned_design(out).study)
    with replacing(file) as temporary, open(temporary, "wb") as target:
        np.save(target, margins)
    return margins
