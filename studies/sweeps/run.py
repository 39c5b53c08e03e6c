"""`studies sweep`: runs the remaining cases, chunk by chunk, and joins the results."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmodel import status
from studies.cluster.connect import TIMEOUT, Place, on_workers
from studies.cluster.runner import ClusterRunner, run_chunk
from studies.engine.baseline import keep_baseline
from studies.engine.chunks import LocalRunner, Lost, Runner
from studies.engine.folder import (
    CONTENT,
    MANIFEST,
    Finished,
    SweepFolder,
    check_resumed,
    finished_cases,
    make_manifest,
    read_manifest,
)
from studies.engine.plan import Group, local_layout, plan_groups
from studies.engine.progress import Reporter
from studies.engine.results import meets
from studies.engine.stored import (
    check_names,
    chunk_arrays,
    kept_metrics,
    manifest_attributes,
    merge,
)
from studies.errors import StudyError
from studies.job import Job
from studies.phases import Phases, interrupts
from studies.result import in_folder
from studies.screen.local import Answers, ShardWork, tallies_here
from studies.screen.run import PHASES as SCREEN_PHASES
from studies.screen.run import choose, chosen, run_screen
from studies.screen.shards import ScreenRequest, screen_of, shard_groups
from studies.screen.stored import TALLY, best_sweep, read_tally
from studies.screen.workers import run_shard, tallies_on
from studies.space.designs import design_of
from studies.space.spec import READING, SPREADING, Sweep, SweepSpec, parse_sweep
from studies.space.table import CaseTable, build_table
from studies.study.fields import idle_axes
from studies.sweeps.result import SweepResult

#: From so many cases on, workers of this machine are worth their start.
LARGE = 50_000
#: The same of designs of which some are kept.
LARGE_SCREEN = 10**6
#: Each round of runs goes at most this many times as far down the ranking as the one before.
FURTHER = 4


def sweep_phases(spec: SweepSpec, has_report: bool = False) -> tuple[str, ...]:
    """What is done."""
    report = ("report",) if has_report else ()
    return (*(SCREEN_PHASES if spec.sweep.keep else ()), "compile", "run", "join", *report)


class Plan(NamedTuple):
    """What a sweep would do."""

    table: CaseTable  # all cases; of a sweep that keeps some, a few of its designs
    groups: list[Group]  # of these
    n_before: int  # cases, or designs, already done
    screen: ScreenRequest | None = None

    def n_cases(self, group: Group) -> int:
        """How many cases the program of a group runs."""
        if self.screen is None:
            return len(group.rows)
        tried, count = len(self.table), self.screen.n_designs - self.n_before
        if group.is_judged:
            count = min(self.screen.spec.sweep.keep, self.screen.n_designs)
        else:
            tried += self.table.n_dropped
        return round(count * len(group.rows) / tried)

    def n_chunks(self, group: Group) -> int:
        """And in how many chunks."""
        return -(-self.n_cases(group) // group.layout.size)


def make_plan(spec: SweepSpec, out: Path | None = None) -> Plan:
    """Remaining cases of a sweep, grouped by program.

    Args:
        spec: the sweep.
        out: folder with some of them done, if the sweep is to be resumed.

    Returns:
        Plan; of a sweep that keeps its best designs, one of a few of them.

    Raises:
        StudyError: a fault of the sweep, or a folder with a different sweep.
    """
    if spec.sweep.keep:
        return _kept_plan(screen_of(spec), out)
    table, sweep = build_table(spec), spec.sweep
    check_names(spec, table)
    rows = np.arange(len(table))
    if out is not None:
        before = _joined(out, spec, table, make_manifest(spec.data))
        rows = np.flatnonzero(~np.isin(table.case_id, before.case_id))
    is_linear = sweep.fidelity == "linear"
    groups = plan_groups(table, rows, local_layout, sweep.metrics, is_linear)
    return Plan(table, groups, len(table) - len(rows))


def _kept_plan(screen: ScreenRequest, out: Path | None) -> Plan:
    table, n_before = screen.some, 0
    if out is not None and (out / TALLY).is_file():
        n_before = read_tally(out, screen)[1].n_designs
    groups = shard_groups(screen, table) if n_before < screen.n_designs else []
    groups += plan_groups(table, np.arange(len(table)), local_layout, screen.spec.sweep.metrics)
    return Plan(table, groups, n_before, screen)


def swept_into(
    spec: SweepSpec,
    job: Job,
    workers: Place = None,
    timeout: float = TIMEOUT,
    runner: Runner | None = None,
) -> SweepResult:
    """Run what is left of a sweep.

    Args:
        spec: the sweep.
        job: with `sweep_phases`; its folder may hold the same sweep, or one that this extends.
        workers, timeout: as in `studies.sweep`.
        runner: of the chunks, in place of workers.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished chunks stay.
        KeyboardInterrupt: the same.
    """
    n_cases = design_of(spec.root, spec.study, spec.sweep.seed).size * spec.sweep.repeats
    is_large = runner is None and n_cases >= (LARGE_SCREEN if spec.sweep.keep else LARGE)
    calls = run_chunk, run_shard
    with on_workers(workers, timeout, job.say, *calls, is_large=is_large) as remote:

        def runner_of(spec: SweepSpec) -> Runner:
            return runner or (ClusterRunner(spec, remote) if remote else LocalRunner())

        if not spec.sweep.keep:
            return _run_rest(spec, job, runner_of(spec))
        tallies = partial(tallies_on, remote) if remote else tallies_here
        return _run_kept(spec, job, tallies, runner_of)


def _run_kept(
    spec: SweepSpec,
    job: Job,
    tallies: Callable[[ShardWork], Answers],
    runner_of: Callable[[SweepSpec], Runner],
) -> SweepResult:
    """Find the best designs and run them, further ones until enough meet the sweep's condition."""
    screen, count = screen_of(spec), spec.sweep.keep
    found, done = run_screen(screen, job, tallies), None
    while True:
        found = choose(found, count, job)
        kept = chosen(found).kept
        best = best_sweep(screen, kept, _earlier(job.place, kept))
        last = _run_rest(best, job, runner_of(best))
        done = last if done is None else last.after(done)
        done = in_folder(replace(done, screen=found), job.place)
        if len(kept) < count:
            return done
        count = _next_count(spec.sweep, done, count)
        if count == len(kept):
            return done


def _earlier(out: Path, kept: CaseTable) -> list[Any]:
    """Cases that the folder of a sweep has, beside those to keep, as its `sweep.cases` lists them.

    They were kept before another number or margin was asked for.
    """
    if not (out / MANIFEST).is_file():
        return []
    spec = parse_sweep(read_manifest(out)["spec"])
    table = build_table(spec)
    is_done = np.isin(table.case_id, finished_cases(out).case_id)
    rows = table.row[is_done & ~np.isin(table.case_id, kept.case_id)]
    return [spec.sweep.cases[row] for row in rows.tolist()]


def _next_count(sweep: Sweep, done: SweepResult, count: int) -> int:
    """How many designs to run for enough to meet the condition, if those so far are too few.

    Args:
        sweep: what is asked for.
        done: how the run of some designs ended.
        count: how many, best first in its table.
    """
    if not sweep.subject_to:
        return count
    data = done.found
    is_met = meets(data, sweep.subject_to, "sweep.subject_to") & (data["status"] == status.OK)
    n_met = int(is_met[:count].sum())
    if n_met >= sweep.keep:
        return count
    needed = int(np.ceil(1.25 * sweep.keep * count / max(n_met, 1)))
    return min(needed, FURTHER * count)


def _run_rest(spec: SweepSpec, job: Job, runner: Runner) -> SweepResult:
    manifest, folder, out = make_manifest(spec.data), SweepFolder(job.place), job.place
    check_resumed(out, manifest)
    table = build_table(spec)
    check_names(spec, table)
    before = _joined(out, spec, table, manifest)
    folder.begin(manifest, before.damaged, partial(job.phases.console.print, soft_wrap=True))
    with interrupts() as stop:
        reporter, lost = _run_chunks(spec, table, folder, runner, job.phases, stop)
    run_time = reporter.run_time
    if stop.is_set() and reporter.done + len(lost) < len(table):
        raise KeyboardInterrupt(f"{reporter.done} of {len(table)} cases are safe")
    job.begin("join")
    finished = finished_cases(out)
    keep_baseline(spec, table, out, job.say)
    _check_whole(table, np.union1d(finished.case_id, table.case_id[lost]), out)
    attributes = {"title": spec.study.title, **manifest_attributes(manifest)}
    timings = {"compile_time": reporter.compile_time, "run_time": run_time}
    merge(out, table, finished, attributes | timings)
    folder.publish()
    result = SweepResult(
        n_cases=len(table),
        n_run=reporter.n_run,
        compile_time=reporter.compile_time,
        run_time=run_time,
        executor=reporter.executor,
        lost=lost,
    )
    return in_folder(result, out)


def _run_chunks(
    spec: SweepSpec,
    table: CaseTable,
    folder: SweepFolder,
    runner: Runner,
    phases: Phases,
    stop: threading.Event,
) -> tuple[Reporter, np.ndarray]:
    """Run and save what is left; returns what was reported, and rows that were given up."""
    sweep, kept = spec.sweep, kept_metrics(spec)
    is_done = np.isin(table.case_id, finished_cases(folder.path).case_id)
    groups = plan_groups(
        table,
        np.flatnonzero(~is_done),
        runner.layout,
        sweep.metrics,
        sweep.fidelity == "linear",
        robustness=sweep.robustness,
    )
    n_before, lost = int(is_done.sum()), [np.empty(0, int)]
    reporter = Reporter(phases, "run", len(table), n_before, len(groups))
    reporter.say(_headline(table, groups, n_before))
    with closing(runner.run(table, groups, reporter, stop)) as chunks:
        for one in chunks:
            rows = one.chunk.rows
            if isinstance(one, Lost):
                lost.append(rows)
                folder.give_up(rows, one.reason)
                reporter.lost(rows, one.reason)
            else:
                arrays = chunk_arrays(table, one, kept)
                folder.write_chunk({"case_id": table.case_id[rows], **arrays})
                reporter.chunk(arrays["status"])
    return reporter, np.concatenate(lost)


def _headline(table: CaseTable, groups: list[Group], n_before: int) -> str:
    text = f"{len(table)} cases"
    if table.n_dropped:
        text += f" ({table.n_dropped} left out by where)"
    if table.n_double:
        reasons = idle_axes(table.study, table.columns)
        text += f" ({'; '.join([f'{table.n_double} duplicates left out', *reasons])})"
    if n_before:
        text += f", {n_before} of them already computed"
    chunks = sum(len(group.chunks()) for group in groups)
    return f"{text}; chunks: {chunks}, programs to compile: {len(groups)}"


def case_content(spec: SweepSpec) -> dict[str, Any]:
    """What of a request, beside its cases' parameters, decides what is stored for a case.

    Parameters are in the ids of cases. Of `[sweep]` everything decides, except what says which
    cases there are and what is looked at once they are finished.
    """
    content = spec.sweep.model_dump(mode="json", exclude={*SPREADING, *READING})
    return content | {
        "metrics": sorted(kept_metrics(spec)),
        "robustness": sorted(content["robustness"]),
    }


def _joined(out: Path, spec: SweepSpec, table: CaseTable, manifest: dict[str, Any]) -> Finished:
    """What a folder has already; completes the manifest.

    A resumed sweep can have more cases than the existing one, but not fewer.

    Raises:
        StudyError: what it has would not fit the other cases, or is not part of this sweep.
    """
    manifest[CONTENT] = case_content(spec)
    check_resumed(out, manifest)
    done = finished_cases(out)
    strange = int(np.sum(~np.isin(done.case_id, table.case_id)))
    if strange:
        raise StudyError(
            f"--resume: {strange} of {len(done.case_id)} finished cases in {out} are not part of "
            "this sweep; an extended sweep keeps all cases of the old one (same study, seed and "
            "axes; more values or points; for a Latin hypercube the same size). Name a new folder "
            "for another sweep"
        )
    return done


def _check_whole(table: CaseTable, done: np.ndarray, out: Path) -> None:
    """Check that no chunks were removed while the sweep ran."""
    lost = int(np.sum(~np.isin(table.case_id, done)))
    if lost:
        raise StudyError(
            f"{out}: chunks with {lost} of {len(table)} cases disappeared while the sweep ran; "
            "run them again with --resume"
        )
