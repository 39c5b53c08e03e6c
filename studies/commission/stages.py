"""The stages, each in its own folder and as its own command makes it.

A stage takes what is known so far, and returns it with its answer, or with reasons to stop. One
that is resumed finds again from its kept parts what it has found, and writes it again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from studies.commission.findings import CommissionFindings
from studies.commission.machines import Possible, margin_spread, margins_on, unknown_to_controller
from studies.commission.spec import RESERVE, MeasuredSpec, certified_margin, tuning_section
from studies.engine.design import load_design
from studies.engine.fast_motion import TellingMotion, find_motion, with_own_motion
from studies.engine.folder import TUNING
from studies.engine.runs import resolved_study
from studies.engine.stability import loop_report
from studies.export.run import REPORT as VERIFICATION
from studies.export.run import export_design
from studies.export.targets import TARGETS
from studies.fitting.estimate import fit_phases
from studies.fitting.run import fitted_into
from studies.job import Job, keep_request
from studies.publish import REPORT, replacing
from studies.results.labelled import document
from studies.spillover.certificate import certify
from studies.spillover.run import certified, phases
from studies.study.cases import build_case, build_structure
from studies.study.spec import Study
from studies.study.template import study_template
from studies.tuning.folder import CHECKED, fixed_part
from studies.tuning.run import tune_phases, tune_request, tuned_into
from studies.tuning.spec import TuneSpec, parse_tuning

#: The chosen controller as a study: the fitted machine, the motion of the file.
DESIGN = "design.toml"


class Stage(NamedTuple):
    """One stage of a commissioning."""

    text: str
    run: Callable[[CommissionFindings, Job], CommissionFindings]
    seconds: float  # on two cores
    page: str = REPORT


def _fit(known: CommissionFindings, job: Job) -> CommissionFindings:
    """The fit; refused with its gravest messages if it is no ground for a design."""
    spec = known.measured.fit
    with job.inside("fit", fit_phases(spec)) as stage:
        fitted = fitted_into(spec, stage)
    fit, possible = document(fitted.document()), Possible(fitted.names, fitted.machines)
    is_ground = fit["is_explained"] and fit["is_converged"]
    refusals = () if is_ground else tuple(fit["messages"][:3])
    return known.replace(fit=fit, fitted=fitted.study, possible=possible, refusals=refusals)


def _tune(known: CommissionFindings, job: Job) -> CommissionFindings:
    """The chosen controller, and its gain margins on all possible machines."""
    measured, possible, fitted = known.measured, known.possible, known.fitted
    assert possible is not None and fitted is not None
    spec = _tuning(measured, possible, fitted, job)
    with job.inside("tune", tune_phases(spec)) as stage:
        request = {"verb": "tune", **tune_request(spec)}
        keep_request(stage.place / TUNING, request, CHECKED, fixed_part)
        tuned_into(spec, stage)
    first = load_design(job.place / "tune").study
    own, of = with_own_motion(first, fitted), first.model_dump_json()
    lowered = job.part("lowered", lambda: _lowered(own, possible, measured), of)
    with replacing(job.place / DESIGN) as temporary:
        temporary.write_text(study_template(lowered), encoding="utf-8")
    tuned = load_design(job.place / DESIGN).study
    job.say(f"gain margins on {len(possible.values)} machines that the data leave possible")
    margins = job.part("margins", lambda: margins_on(possible, tuned), of)
    wanted = measured.commission.gain_margin
    low = int(np.sum(margins < wanted))
    text = (
        f"on {low} of {len(margins)} machines that the data leave possible the gain margin "
        f"is below {wanted:g}, down to {margins.min():.3g}"
    )
    return known.replace(
        tuned=tuned,
        is_fast=first.motion != tuned.motion,
        price=price_text(first.control.gain_factor, tuned),
        margins=margins,
        refusals=(text,) if low else (),
    )


def _tuning(measured: MeasuredSpec, possible: Possible, study: Study, job: Job) -> TuneSpec:
    """The tuning of a fitted study on possible machines."""
    columns, spread = job.part(
        "machines",
        lambda: (unknown_to_controller(possible, study), margin_spread(possible, study)),
        study.model_dump_json(),
    )
    indexed = [name for name in columns if name.startswith("link.stiffness_factor[")]
    if indexed:  # one number for all links so far
        whole = tuple(study.each_link(study.link.stiffness_factor).tolist())
        study = study.change(link__stiffness_factor=whole)
    motion = TellingMotion(study, "") if measured.keeps_motion else find_motion(study)
    if motion.text:
        job.say(motion.text)
    section = tuning_section(measured, motion.study, columns, spread)
    return parse_tuning(motion.study.model_dump() | {"tune": section})


def _lowered(study: Study, possible: Possible, measured: MeasuredSpec) -> Study:
    """The study with gains so low that later stages find their margins, where any gains do."""
    certificate = certify(study, certified_margin(measured), (study.link.basis,))
    share = min(
        certificate.smallest_margin / certificate.required_margin,
        margins_on(possible, study).min() / measured.commission.gain_margin,
    )
    if not 0 < share < 1:
        return study
    return study.change(control__gain_factor=float(study.control.gain_factor * share / RESERVE))


def price_text(first: float, tuned: Study) -> str:
    """What it cost to lower the gain factor from that of the tuning, "" if it was not lowered."""
    if tuned.control.gain_factor >= first:
        return ""
    home = np.array(tuned.motion.waypoints[0], float)
    before, after = (
        loop_report(build_structure(x), build_case(x), home).damping_ratio[0].min()
        for x in (tuned.change(control__gain_factor=first), tuned)
    )
    return (
        f"lowered from {first:.4g}, with which later stages would not have found their margins; "
        f"least damping of the controlled modes 1 is {after:.3g} instead of {before:.3g}"
    )


def _certify(known: CommissionFindings, job: Job) -> CommissionFindings:
    study, margin = resolved_study(known.chosen), certified_margin(known.measured)
    bases = (study.link.basis,)  # other loop gains would not have explained the data
    with job.inside("certificate", phases(has_proofs=False)) as stage:
        found = certified(study, stage, margin, bases=bases)
    refusals = () if found.is_passed else (f"certificate {found.verdict}",)
    return known.replace(verdict=found.verdict, refusals=refusals)


def _export(known: CommissionFindings, job: Job) -> CommissionFindings:
    wanted = known.measured.commission
    made = export_design(
        known.chosen,
        wanted.target,
        job.place / "firmware",
        console=job.phases.console,
        dac_bits=wanted.dac_bits if TARGETS[wanted.target].has_dac else None,
        pil=wanted.processor or None,
    )
    text = "the exported code does not behave as the controller that was designed"
    return known.replace(refusals=() if made.is_good else (text,))


#: In their order, by the name of their folder.
STAGES = {
    "fit": Stage("fit the model to the measurements", _fit, 60.0),
    "tune": Stage("tune on machines that the data leave possible", _tune, 240.0),
    "certificate": Stage("certify on plants that differ from the model", _certify, 30.0),
    "firmware": Stage("export, compare, emulate", _export, 60.0, page=VERIFICATION),
}
