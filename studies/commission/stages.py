"""The stages, each in its own folder and as its own command makes it; they meet in their files."""

from __future__ import annotations

import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from studies.commission.machines import (
    Possible,
    margin_spread,
    margins_on,
    unknown_to_controller,
)
from studies.commission.spec import RESERVE, MeasuredSpec, certified_margin, tuning_section
from studies.engine.design import Design, load_design
from studies.engine.fast_motion import TellingMotion, find_motion, with_own_motion
from studies.engine.folder import TUNING
from studies.engine.runs import resolved_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.export.run import FAILED, export_design
from studies.export.run import REPORT as VERIFICATION
from studies.export.targets import TARGETS
from studies.fitting.estimate import fit_phases
from studies.fitting.run import DATA, DOCUMENT, STUDY, fitted_into
from studies.job import Job, keep_request
from studies.publish import REPORT, replacing
from studies.reading import open_hdf5, read_json
from studies.spillover.certificate import certify
from studies.spillover.run import DOCUMENT as CERTIFICATE
from studies.spillover.run import certified, phases
from studies.study.cases import build_case, build_structure
from studies.study.spec import Study, load_study
from studies.study.template import study_template
from studies.tuning.folder import CHECKED, fixed_part
from studies.tuning.run import tune_phases, tune_request, tuned_into
from studies.tuning.spec import parse_tuning

#: The chosen controller as a study: the fitted machine, the motion of the file.
DESIGN = "design.toml"


class Stage(NamedTuple):
    """One stage of a commissioning."""

    name: str  # of its folder
    text: str
    last: tuple[str, ...]  # files of the folder of all stages, of which one is written at its end
    make: Callable[[MeasuredSpec, Job], None]
    page: str = REPORT

    def is_done(self, out: Path) -> bool:
        """Whether the folder holds its answer."""
        return any((out / file).is_file() for file in self.last)


def _fit(measured: MeasuredSpec, job: Job) -> None:
    with job.inside("fit", fit_phases(measured.fit)) as stage:
        fitted_into(measured.fit, stage)


def _tune(measured: MeasuredSpec, job: Job) -> None:
    out = job.place
    study = fitted = fitted_study(out)
    possible = possible_machines(out)
    columns, spread = unknown_to_controller(possible, study), margin_spread(possible, study)
    indexed = [name for name in columns if name.startswith("link.stiffness_factor[")]
    if indexed:  # one number for all links so far
        whole = tuple(study.each_link(study.link.stiffness_factor).tolist())
        study = study.change(link__stiffness_factor=whole)
    motion = TellingMotion(study, "") if measured.keeps_motion else find_motion(study)
    if motion.text:
        job.say(motion.text)
    section = tuning_section(measured, motion.study, columns, spread)
    spec = parse_tuning(motion.study.model_dump() | {"tune": section})
    with job.inside("tune", tune_phases(spec)) as stage:
        request = {"verb": "tune", **tune_request(spec)}
        keep_request(stage.place / TUNING, request, CHECKED, fixed_part)
        tuned_into(spec, stage)
    chosen = _lowered(with_own_motion(load_design(out / "tune").study, fitted), possible, measured)
    with replacing(out / DESIGN) as temporary:
        temporary.write_text(study_template(chosen), encoding="utf-8")


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


def price_text(out: Path, tuned: Study) -> str:
    """What it cost to lower the gains of the tuning, "" if they were not lowered."""
    first = load_design(out / "tune").study.control.gain_factor
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


def _certify(measured: MeasuredSpec, job: Job) -> None:
    study, margin = resolved_study(tuned_design(job.place).study), certified_margin(measured)
    bases = (study.link.basis,)  # other loop gains would not have explained the data
    with job.inside("certificate", phases(has_proofs=False)) as stage:
        certified(study, stage, margin, bases=bases)


def _export(measured: MeasuredSpec, job: Job) -> None:
    wanted = measured.commission
    export_design(
        tuned_design(job.place),
        wanted.target,
        job.place / "firmware",
        console=job.phases.console,
        dac_bits=wanted.dac_bits if TARGETS[wanted.target].has_dac else None,
        pil=wanted.processor or None,
    )


CERTIFIED = f"certificate/{CERTIFICATE}"
#: In their order.
STAGES = (
    Stage("fit", "fit the model to the measurements", (f"fit/{DOCUMENT}",), _fit),
    Stage("tune", "tune on machines that the data leave possible", (DESIGN,), _tune),
    Stage("certificate", "certify on plants that differ from the model", (CERTIFIED,), _certify),
    Stage(
        "firmware",
        "export, compare, emulate",
        (f"firmware/{VERIFICATION}", f"firmware/{FAILED}"),
        _export,
        page=VERIFICATION,
    ),
)


#: What the stages have answered, as hashes of their files.
ANSWERS = "answers.json"
#: Endings of files that later stages read.
_READ = (".json", ".h5", ".toml", ".npy")


def keep_answer(stage: Stage, out: Path) -> None:
    """Record the files of a stage, so that a change of them is noticed."""
    kept = _kept_answers(out) | {stage.name: _hashes(stage, out)}
    with replacing(out / ANSWERS) as temporary:
        temporary.write_text(json.dumps(kept, indent=1), encoding="utf-8")


def check_answer(stage: Stage, out: Path) -> None:
    """Check that the files of a stage are those that were recorded.

    Raises:
        StudyError: one is not.
    """
    found = _hashes(stage, out)
    for name, wanted in _kept_answers(out).get(stage.name, {}).items():
        if found.get(name) != wanted:
            raise StudyError(
                f"{out / name}: damaged, or changed since it was written; put the right one back, "
                "or name a new folder"
            )


def _kept_answers(out: Path) -> dict[str, dict[str, str]]:
    path = out / ANSWERS
    if not path.exists():
        return {}
    try:
        kept = read_json(path)
        return {name: dict(kept[name]) for name in kept}
    except (OSError, ValueError, TypeError) as error:
        raise StudyError(f"{path}: damaged ({error}); name a new folder") from None


def _hashes(stage: Stage, out: Path) -> dict[str, str]:
    """Of the files of a stage, by their names in the folder."""
    files = {out / name for name in stage.last}
    if (out / stage.name).is_dir():
        files |= {x for x in (out / stage.name).iterdir() if x.suffix in _READ}
    return {
        str(file.relative_to(out)): sha256(file.read_bytes()).hexdigest()
        for file in sorted(files)
        if file.is_file()
    }


def fit_document(out: Path) -> dict[str, Any]:
    """`fit.json` of a commissioning."""
    return dict(read_json(out / "fit" / DOCUMENT))


def certificate_document(out: Path) -> dict[str, Any]:
    """`certificate.json` of a commissioning."""
    return dict(read_json(out / "certificate" / CERTIFICATE))


def fitted_study(out: Path) -> Study:
    """The study with the fitted numbers."""
    return load_study(out / "fit" / STUDY)


def tuned_design(out: Path) -> Design:
    """The chosen controller with the fitted machine and the motion of the file."""
    return load_design(out / DESIGN)


def has_fast_motion(out: Path, tuned: Study) -> bool:
    """Whether a controller was tuned on a faster motion than its own."""
    return load_design(out / "tune").study.motion != tuned.motion


def possible_machines(out: Path) -> Possible:
    """Machines that the data leave possible."""
    with open_hdf5(out / "fit" / DATA) as file:
        names = tuple(file["number"].asstr()[:].tolist())
        return Possible(names, np.asarray(file["machine"]))


def is_verified(out: Path) -> bool:
    """Whether the firmware's comparisons all agreed."""
    return (out / "firmware" / VERIFICATION).is_file()
