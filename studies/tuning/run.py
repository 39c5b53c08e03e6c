"""A tuning in its folder: `tune.json` (the request), `progress.npz` (the descent), `parts/`
(what followed it), `tune.h5` (every start), `study.toml` (the reference), `tuned.toml` (the study
with the best numbers, one file per family, from the first better design on), the report
(`report.html`) and its figures.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from studies.cluster.connect import TIMEOUT, Place, on_workers
from studies.engine.run_data import run_attributes
from studies.errors import StudyError
from studies.job import Job, make_request
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.show.pages import write_report
from studies.show.units import count_text
from studies.store import numbers_digest, write_store
from studies.study.files import signed
from studies.study.spec import Study
from studies.study.template import study_template
from studies.tuning.audit import Disagreement, audit
from studies.tuning.check import RandomSearch, search, tuned_study
from studies.tuning.evaluate import Evaluator
from studies.tuning.findings import TuneFindings, violated_limits
from studies.tuning.folder import (
    PROGRESS,
    RESULTS,
    load_progress,
    refuse_edited,
    save_progress,
    write_designs,
)
from studies.tuning.optimise import Progress, is_compatible, optimise, start_families
from studies.tuning.references import compare
from studies.tuning.results import variables
from studies.tuning.say import ended, file_name
from studies.tuning.spec import TuneSpec
from studies.tuning.workers import ClusterEvaluator, evaluate_part

#: Share of the evaluations of a descent that the comparison of its derivatives takes.
SHARE = 0.1
#: Modules that determine the numbers of a tuning, with everything they import.
DECISIVE = ("studies.tuning.check", "studies.tuning.evaluate", "studies.tuning.optimise")


def make_evaluator(spec: TuneSpec) -> Evaluator:
    """Evaluator of all starting points."""
    return Evaluator(spec, [spec.moving[k] for k in start_families(spec)])


def tune_request(spec: TuneSpec) -> dict[str, Any]:
    """What determines the numbers of a tuning."""
    return make_request(spec.data, DECISIVE)


def tuned_into(
    spec: TuneSpec,
    job: Job,
    workers: Place = None,
    timeout: float = TIMEOUT,
    evaluator: Evaluator | None = None,
) -> TuneFindings:
    """Tune, check the result on fresh scenarios, and write it.

    Args:
        spec: of the tuning.
        job: with `tune_phases`.
        workers: as in `studies.tune`.
        timeout: of the workers [s].
        evaluator: of all starting points, in place of workers.

    Raises:
        StudyError: a fault of the study or of the folder.
    """
    before = load_progress(job.place / PROGRESS)
    if before is not None and not is_compatible(spec, before):
        raise StudyError(f"{job.place / PROGRESS}: damaged; name a new folder")
    if before is not None:
        refuse_edited(job.place)
    with on_workers(workers, timeout, job.say, evaluate_part) as remote:
        evaluator = evaluator or (ClusterEvaluator(spec, remote) if remote else None)
        return _tune(spec, before, evaluator, job)


def refuse_violated(findings: TuneFindings, job: Job) -> TuneFindings:
    """The findings, if their limits can be satisfied together; job: that found them.

    Raises:
        StudyError: they cannot; what was found is said.
    """
    if faults := violated_limits(findings.spec, findings.at):
        for text in findings.lines():
            job.say(text)
        raise StudyError("tune.limits: not satisfied together; " + "; ".join(faults))
    return findings


def tune_phases(spec: TuneSpec) -> tuple[str, ...]:
    """Names of the phases of a tuning."""
    random = ("random designs",) if spec.tune.samples else ()
    return ("compile", "descend", "check", *random, "compare derivatives", "draw")


def _tune(
    spec: TuneSpec, before: Progress | None, evaluator: Evaluator | None, job: Job
) -> TuneFindings:
    """Tune, check and write; before: progress of an interrupted tuning."""
    out = job.place
    if before is not None:
        job.say(f"continuing after iteration {int(before.iteration)}")
    job.begin("compile", "starting points by the linear loop, and the first iteration")
    evaluator = evaluator or make_evaluator(spec)
    left = spec.tune.iterations - (0 if before is None else int(before.iteration))
    job.say(
        f"{count_text(len(evaluator.families), 'starting point')}: {evaluator.lanes} runs with "
        f"derivatives in each of at most {count_text(left, 'iteration')}; how long these take is "
        "known from the second one on"
    )

    written: dict[str, str] = {}

    def keep(at: Progress) -> None:
        save_progress(out / PROGRESS, at)
        written.update(write_designs(out, tuned_studies(spec, at, is_over=False), written))
        done = int(at.iteration)
        if job.phases.present == "compile":  # the first iteration compiles
            job.begin("descend", done=done)
        job.advance(done, spec.tune.iterations, _progress_text(spec, at))

    at = optimise(spec, evaluator, before, keep)
    lost = [f.name for k, f in enumerate(spec.moving) if not _has_finished(at, k)]
    if lost:
        raise StudyError(
            f"tune.starts: no starting point of {', '.join(lost)} finished a run; the study "
            "with the family's settings should be one that does (try studies simulate)"
        )
    job.say(ended(spec, at))
    findings = find(spec, evaluator, at, job)
    job.begin("draw")
    _write(in_folder(findings, out, out / REPORT), out)
    return findings


def _has_finished(at: Progress, family: int) -> bool:
    return bool(np.isfinite(at.best_objective[at.family == family]).any())


def _progress_text(spec: TuneSpec, at: Progress) -> str:
    parts = []
    for k, family in enumerate(spec.moving):
        best = at.winner(k)
        if not np.isfinite(at.best_objective[best]):
            parts.append(f"{family.name} -")
            continue
        beyond = at.beyond(best)
        mark = f" (limit {100 * beyond:+.1f} %)" if beyond > 0 else ""
        parts.append(f"{family.name} {at.best_objective[best]:.4f}{mark}")
    lost = f"; {at.is_frozen.sum()} starting points frozen" if at.is_frozen.any() else ""
    return (
        f"{int(at.iteration)}/{spec.tune.iterations} best (baseline: 1): {', '.join(parts)}{lost}"
    )


def find(spec: TuneSpec, evaluator: Evaluator, at: Progress, job: Job) -> TuneFindings:
    """Judge the result of a tuning.

    Args:
        spec: of the tuning.
        evaluator: of its starting points.
        at: where the tuning ended.
        job: with `tune_phases`.
    """
    main = int(np.flatnonzero(at.family == spec.main)[0])
    end = numbers_digest({"place": at.best_place, "iteration": at.iteration})

    def searched() -> RandomSearch:
        job.begin("random designs", f"{spec.tune.samples} for comparison")
        return search(spec, evaluator.linear, main)

    def audited() -> list[Disagreement]:
        job.begin("compare derivatives", "with differences")
        most = max(1, int(SHARE * at.iteration)) * len(at.family)
        return audit(spec, at.best_place[[at.winner(spec.main)]], most)

    return TuneFindings(
        spec=spec,
        at=at,
        **job.part("check", lambda: _checked(spec, evaluator, at, job), end),
        searched=job.part("random designs", searched, end) if spec.tune.samples else None,
        audited=job.part("compare derivatives", audited, end),
        runs=int(at.iteration) * evaluator.lanes,
    )


def _checked(spec: TuneSpec, evaluator: Evaluator, at: Progress, job: Job) -> dict[str, Any]:
    """The best designs on fresh machines, and by the linear loop."""
    values = spec.free.values(at.best_place)
    winners = [at.winner(k) for k in range(len(spec.moving))]
    designs = [spec.study] + [
        tuned_study(spec, family, values[winners[k]] if k < len(winners) else values[0])
        for k, family in enumerate(spec.families)
    ]
    baseline, judged, references = compare(spec, designs, partial(job.begin, "check"))
    linear = np.concatenate(
        [
            evaluator.linear.screen(
                int(np.flatnonzero(at.family == k)[0]),
                np.where(family.is_free, values[at.family == k], np.nan),
            )[1]
            for k, family in enumerate(spec.moving)
        ]
    )
    last = evaluator.evaluate(values)
    if np.isnan(evaluator.run_time):  # the last batch compiled
        evaluator.evaluate(values)
    return {
        "baseline": baseline,
        "judged": judged,
        "references": references,
        "linear": linear,
        "residual": last.residual,
        "run_time": evaluator.run_time,
    }


def tuned_studies(spec: TuneSpec, at: Progress, is_over: bool = True) -> dict[str, Study]:
    """The reference, and the best design of each family that has one, by the names of their files.

    Args:
        spec: of the tuning.
        at: its progress.
        is_over: whether the descent has ended, which the titles say.
    """
    studies = {"study.toml": spec.study}
    done = count_text(int(at.iteration), "iteration")
    state = "" if is_over else f" (best so far, of {done}, not checked)"
    for k, family in enumerate(spec.moving):
        if _has_finished(at, k):
            tuned = tuned_study(spec, family, spec.free.values(at.best_place[at.winner(k)]))
            title = f"{spec.study.title or 'study'}, tuned: {family.name}"[: 200 - len(state)]
            name = file_name(spec, family)
            studies[name] = tuned.model_copy(update={"title": f"{title}{state}"})
    return studies


def _write(findings: TuneFindings, out: Path) -> None:
    spec = findings.spec
    attributes = run_attributes(spec.study) | {"tuning": json.dumps(spec.data)}
    with publish(out) as staging:
        for name, study in tuned_studies(spec, findings.at).items():
            (staging / name).write_text(signed(study_template(study)), encoding="utf-8")
        write_store(staging / RESULTS, variables(spec, findings), attributes)
        write_report(findings.report(), staging)
