"""`studies laws`: tune every candidate, judge all, rank them, write the page.

`tuning/` has the progress of each tuning and `runs/` the sweep that judges, so that an interrupted
comparison goes on where it was. `request.json` says what was asked for.
"""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event, Lock

from rich.console import Console

from studies import config
from studies.engine.folder import (
    COMPARISONS,
    keep_request,
    locked_folder,
    make_manifest,
    refuse_existing,
)
from studies.engine.progress import Phases
from studies.engine.runs import resolved_study
from studies.errors import field_error
from studies.laws.candidates import drive_candidates, law_candidates
from studies.laws.document import laws_document
from studies.laws.findings import (
    GIVEN,
    WITHOUT,
    LawFindings,
    as_given,
    combinations,
    find,
    verdict,
)
from studies.laws.judging import judging_sweep, read_judged
from studies.laws.machines import machines_of, with_noise
from studies.laws.say import say
from studies.laws.tuning import Budget, Tuned, make_budget, tune_candidate
from studies.publish import publish
from studies.results.document import json_text
from studies.results.labelled import document
from studies.show.pages import write_report
from studies.space.spec import SweepSpec
from studies.study.spec import Study
from studies.study.template import study_template
from studies.study.window import with_window
from studies.sweeps.run import run_sweep, sweep_phases
from studies.threads import COMPILING

DOCUMENT, TUNING, RUNS = "laws.json", "tuning", "runs"
#: Machines to judge on.
MACHINES = 16
#: Candidates tuned side by side: neither compilers nor runs keep all cores busy all the time.
TOGETHER = 2


def run_laws(
    study: Study,
    out: str | Path,
    voltage: float | None = None,
    margin: float = 0.4,
    is_resumed: bool = False,
    console: Console | None = None,
    is_quiet: bool = False,
) -> LawFindings:
    """Compare all laws and drives on a design's machine.

    Args:
        study: the design, with sampled feedback.
        out: folder.
        voltage: largest of an actuator [V]; None: what the design itself needs in its motion.
        margin: least disk margin [1].
        is_resumed: continue an interrupted comparison.
        console: where progress goes; default: standard output.
        is_quiet: hide progress.

    Raises:
        StudyError: a fault of the design, a limit or the folder; no candidate can be tuned.
        KeyboardInterrupt: Ctrl-C; what is finished stays.
    """
    config.require_configured()
    out, console = Path(out), console or Console(highlight=False, markup=False)
    _check_design(study)
    study = with_noise(with_window(resolved_study(study)))
    budget = make_budget(study, voltage, margin)
    with locked_folder(out, "comparison"):
        refuse_existing(out, COMPARISONS, is_resumed)
        request = make_manifest(study.model_dump(mode="json"), DECISIVE) | document(budget)
        limits = dict.fromkeys(document(budget), "budget")
        checked = {"spec": "design", "code": "program"} | limits
        keep_request(out / COMPARISONS.mark, request, checked)
        names = ("tune", *sweep_phases(_empty_sweep(study)), "rank", "draw")
        with Phases(console, names, is_quiet) as phases:
            return _compare(study, out, budget, phases)


def _check_design(study: Study) -> None:
    """Check that there is a sampled controller to compare.

    Raises:
        StudyError: there is none.
    """
    control = study.control
    if control.feedback != "sampled":
        raise field_error("control.feedback", control.feedback, "'sampled' where laws are compared")
    if not any(control.links):
        raise field_error("control.links", control.links, "one or more controlled links")
    if control.gain_factor == 0:
        raise field_error("control.gain_factor", 0.0, "more than 0 where laws are compared")


#: Modules that determine the numbers, with everything they import.
DECISIVE = (
    "studies.laws.tuning",
    "studies.laws.judging",
    "studies.laws.candidates",
    "studies.laws.machines",
)


def _empty_sweep(study: Study) -> SweepSpec:
    return judging_sweep(study, [study], machines_of(study, 1, 0))


def _compare(study: Study, out: Path, budget: Budget, phases: Phases) -> LawFindings:
    tuned = _tune(study, out, budget, phases)
    entries = [
        as_given(WITHOUT, study.uncontrolled()),
        as_given(GIVEN, study),
        *combinations(study, tuned),
    ]
    machines = machines_of(study, MACHINES, budget.seed + 1)
    spec = judging_sweep(study, [entry.study for entry in entries], machines)
    is_begun = (out / RUNS).exists()
    if run_sweep(spec, out / RUNS, is_begun, phases=phases).is_interrupted:
        raise KeyboardInterrupt
    phases.begin("rank")
    judged = read_judged(out / RUNS, len(entries), MACHINES)
    findings = find(study, budget, tuned, judged, entries)
    phases.begin("draw")
    _write(findings, out)
    for line in verdict(findings):
        phases.say(line)
    return findings


def _tune(study: Study, out: Path, budget: Budget, phases: Phases) -> list[Tuned]:
    """Each candidate, tuned or not; some side by side."""
    phases.begin("tune", "what each law and drive can be tuned by")
    candidates = [*law_candidates(study), *drive_candidates(study)]
    folder, lock, stop, done = out / TUNING, Lock(), Event(), list[Tuned]()
    folder.mkdir(exist_ok=True)

    def tune(k: int) -> Tuned:
        candidate = candidates[k]

        def say(text: str) -> None:
            if stop.is_set():
                raise KeyboardInterrupt
            with lock:
                here = f"{candidate.name} ({k + 1} of {len(candidates)})"
                phases.advance(len(done), len(candidates), f"{here}: {text}")

        say("compile")
        file = folder / f"{_slug(candidate.name)}.npz"
        one = tune_candidate(study, candidate, budget, file, say)
        done.append(one)
        return one

    pool = ThreadPoolExecutor(TOGETHER, COMPILING)
    try:
        return list(pool.map(tune, range(len(candidates))))
    finally:
        stop.set()
        pool.shutdown(wait=False, cancel_futures=True)  # what an iteration kept is safe


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _write(findings: LawFindings, out: Path) -> None:
    with publish(out) as staging:
        for controller in findings.controllers[2:]:
            file = staging / f"{_slug(controller.name)}.toml"
            title = f"{findings.study.title or 'study'}: {controller.name}"[:200]
            named = controller.study.model_copy(update={"title": title})
            file.write_text(study_template(named), encoding="utf-8")
        (staging / DOCUMENT).write_text(json_text(laws_document(findings)), encoding="utf-8")
        write_report(say(findings), staging)
