"""`studies compare`: tune every candidate, judge all, rank them, write the page.

`tuning/` has the progress of each tuning and `runs/` the sweep that judges, so that an interrupted
comparison goes on where it was. `request.json` says what was asked for.
"""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event, Lock
from typing import TYPE_CHECKING

from studies.cluster.connect import TIMEOUT, Place, on_workers
from studies.cluster.runner import ClusterRunner, run_chunk
from studies.engine.runs import resolved_study
from studies.errors import field_error
from studies.job import Job
from studies.laws.candidates import drive_candidates, law_candidates
from studies.laws.document import laws_document
from studies.laws.findings import (
    GIVEN,
    WITHOUT,
    LawFindings,
    as_given,
    combinations,
    find,
)
from studies.laws.judging import judging_sweep, read_judged
from studies.laws.machines import machines_of, with_noise
from studies.laws.tuning import Budget, Tuned, descend, make_budget, tune_candidate, tune_on_workers
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.show.pages import write_report
from studies.study.spec import Study
from studies.study.template import study_template
from studies.study.window import with_window
from studies.sweeps.run import swept_into
from studies.threads import COMPILING

if TYPE_CHECKING:
    from studies.cluster.remote import Remote

DOCUMENT, TUNING, RUNS = "laws.json", "tuning", "runs"
#: Machines to judge on.
MACHINES = 16
#: Candidates tuned side by side: neither compilers nor runs keep all cores busy all the time.
TOGETHER = 2


def prepared(study: Study, voltage: float | None, margin: float) -> tuple[Study, Budget]:
    """The design to compare with, and the budget of all candidates.

    Args:
        study: the design.
        voltage, margin: as in `studies.compare`.

    Raises:
        StudyError: no sampled controller, a limit out of range, or a design that cannot run.
    """
    _check_design(study)
    study = with_noise(with_window(resolved_study(study)))
    return study, make_budget(study, voltage, margin)


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


#: What is done, with what it takes on two cores [s].
PHASES = {"tune": 900.0, "compile": 30.0, "run": 120.0, "join": 5.0, "rank": 5.0, "draw": 10.0}


def compared(
    study: Study, budget: Budget, job: Job, workers: Place = None, timeout: float = TIMEOUT
) -> LawFindings:
    """Tune every candidate, judge all, rank them, and write the page.

    Args:
        study, budget: from `prepared`.
        job: with `PHASES`.
        workers, timeout: as in `studies.compare`.

    Raises:
        StudyError: no candidate can be tuned.
    """
    with on_workers(workers, timeout, job.say, descend, run_chunk) as remote:
        tuned = _tune(study, budget, job, remote)
        entries = [
            as_given(WITHOUT, study.uncontrolled()),
            as_given(GIVEN, study),
            *combinations(study, tuned),
        ]
        machines = machines_of(study, MACHINES, budget.seed + 1)
        spec = judging_sweep(study, [entry.study for entry in entries], machines)
        with job.inside(RUNS) as judging:
            swept_into(spec, judging, runner=ClusterRunner(spec, remote) if remote else None)
    job.begin("rank")
    judged = read_judged(job.place / RUNS, len(entries), MACHINES)
    findings = find(study, budget, tuned, judged, entries)
    job.begin("draw")
    _write(findings, job.place)
    return in_folder(findings, job.place, job.place / REPORT)


def _tune(study: Study, budget: Budget, job: Job, remote: Remote | None) -> list[Tuned]:
    """Each candidate, tuned or not; some side by side."""
    job.begin("tune", "what each law and drive can be tuned by")
    candidates = [*law_candidates(study), *drive_candidates(study)]
    folder, lock, stop, done = job.place / TUNING, Lock(), Event(), list[Tuned]()
    folder.mkdir(exist_ok=True)
    files = [folder / f"{_slug(candidate.name)}.npz" for candidate in candidates]
    if remote is not None:
        job.say(f"workers: {remote.n_workers}; each tunes one candidate at a time")
        for count, k in enumerate(tune_on_workers(study, candidates, budget, files, remote), 1):
            job.advance(count, len(candidates), f"{candidates[k].name}: tuned")

    def tune(k: int) -> Tuned:
        candidate = candidates[k]

        def say(text: str) -> None:
            if stop.is_set():
                raise KeyboardInterrupt
            with lock:
                here = f"{candidate.name} ({k + 1} of {len(candidates)})"
                job.advance(len(done), len(candidates), f"{here}: {text}")

        one = tune_candidate(study, candidate, budget, files[k], say)
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
        write_report(findings.report(), staging)
