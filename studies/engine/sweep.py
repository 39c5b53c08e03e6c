"""`studies sweep`: runs the remaining cases, chunk by chunk, and joins the results."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from studies import config
from studies.engine.chunks import Done, Here, Lost, Runner, has_own_ratio, start_chunk
from studies.engine.executor import make_executor
from studies.engine.folder import (
    SweepFolder,
    finished_cases,
    make_manifest,
    open_folder,
)
from studies.engine.plan import Group, chunk_cases, local_layout, plan_groups
from studies.engine.progress import Reporter
from studies.engine.stored import chunk_variables, kept_metrics, manifest_attributes, merge
from studies.errors import StudyError
from studies.space.spec import SweepSpec
from studies.space.table import CaseTable, build_table


class Outcome(NamedTuple):
    """How a sweep ended."""

    table: CaseTable
    n_done: int  # cases with results, those of earlier runs included
    n_run: int  # in this run
    compile_time: float  # [s]
    run_time: float  # [s]
    is_interrupted: bool  # by Ctrl-C
    executor: str  # that ran the last chunks; "" if there were none
    lost: np.ndarray  # numbers of cases that were given up, with the reason in the folder


class Plan(NamedTuple):
    """What a sweep would do."""

    table: CaseTable
    groups: list[Group]
    n_before: int  # cases already done


def make_plan(spec: SweepSpec, out: Path | None = None) -> Plan:
    """Remaining cases of a sweep, grouped by program.

    Args:
        spec: the sweep.
        out: folder with some of them done, if the sweep is to be resumed.

    Raises:
        StudyError: a fault of the sweep, or a folder with a different sweep.
    """
    config.require_configured()
    kept_metrics(spec)
    table = build_table(spec)
    rows = np.arange(len(table))
    if out is not None:
        rows = _rows_left(table, finished_cases(out).case_id, out)
    groups = plan_groups(table, rows, local_layout, spec.sweep.metrics)
    return Plan(table, groups, len(table) - len(rows))


def run_sweep(
    spec: SweepSpec,
    out: str | Path,
    is_resumed: bool = False,
    console: Console | None = None,
    is_quiet: bool = False,
    runner: Runner | None = None,
) -> Outcome:
    """Run a sweep into a folder.

    Args:
        spec: the sweep.
        out: its folder.
        is_resumed: continue or extend the existing sweep.
        console: where progress goes; default: standard output.
        is_quiet: hide progress.
        runner: where chunks are run; default: here.

    Returns:
        Outcome; `results.h5` exists unless the run was interrupted.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished chunks stay.
    """
    config.require_configured()
    runner, out = runner or Here(), Path(out)
    kept = kept_metrics(spec)
    table = build_table(spec)
    console = console or Console(highlight=False, markup=False)
    manifest = make_manifest(spec.data)
    with open_folder(out, manifest, is_resumed) as folder:
        finished = finished_cases(out, lambda text: console.print(text, soft_wrap=True))
        rows = _rows_left(table, finished.case_id, out)
        folder.begin(manifest)
        groups = plan_groups(table, rows, runner.layout, spec.sweep.metrics)
        n_before = len(table) - len(rows)
        with Reporter(console, len(table), n_before, is_quiet) as reporter, _interrupts() as stop:
            reporter.say(_headline(table, groups, n_before))
            with closing(runner.run(table, groups, reporter, stop)) as chunks:
                lost = _run_chunks(chunks, table, kept, folder, reporter)
            is_interrupted = stop.is_set() and reporter.done + len(lost) < reporter.total
            if not is_interrupted:
                finished = finished_cases(out)
                _check_whole(table, np.union1d(finished.case_id, table.case_id[lost]), out)
                attributes = {"title": spec.study.title, **manifest_attributes(manifest)}
                timings = {"compile_time": reporter.compile_time, "run_time": reporter.run_time}
                merge(out, table, finished, attributes | timings)
                folder.publish()
        return Outcome(
            table=table,
            n_done=reporter.done,
            n_run=reporter.n_run,
            compile_time=reporter.compile_time,
            run_time=reporter.run_time,
            is_interrupted=is_interrupted,
            executor=reporter.executor,
            lost=lost,
        )


def _headline(table: CaseTable, groups: list[Group], n_before: int) -> str:
    text = f"{len(table)} cases"
    if table.n_dropped:
        text += f" ({table.n_dropped} left out by where)"
    if table.n_double:
        text += f" ({table.n_double} doubles left out)"
    if n_before:
        text += f", {n_before} of them done before"
    chunks = sum(len(group.chunks()) for group in groups)
    return f"{text}; chunks: {chunks}, programs to compile: {len(groups)}"


def _rows_left(table: CaseTable, done: np.ndarray, out: Path) -> np.ndarray:
    """Remaining cases. A resumed sweep can have more cases than the existing one, but not fewer.

    Raises:
        StudyError: finished cases that are not part of it.
    """
    strange = int(np.sum(~np.isin(done, table.case_id)))
    if strange:
        raise StudyError(
            f"--resume: {strange} of {len(done)} finished cases in {out} are not part of this "
            "sweep; an extended sweep keeps all cases of the old one (same study, seed and axes; "
            "more values or points; for a Latin hypercube the same size). Name a new folder for "
            "another sweep"
        )
    return np.flatnonzero(~np.isin(table.case_id, done))


def _check_whole(table: CaseTable, done: np.ndarray, out: Path) -> None:
    """Check that no chunks were removed while the sweep ran."""
    lost = int(np.sum(~np.isin(table.case_id, done)))
    if lost:
        raise StudyError(
            f"{out}: chunks with {lost} of {len(table)} cases disappeared while the sweep ran; "
            "run them again with --resume"
        )


def _run_chunks(
    done: Iterator[Done | Lost],
    table: CaseTable,
    kept: list[str],
    folder: SweepFolder,
    reporter: Reporter,
) -> np.ndarray:
    """Save the results of chunks; returns the rows of the table that were given up."""
    lost = [np.empty(0, int)]
    for one in done:
        if isinstance(one, Lost):
            lost.append(one.chunk.rows)
            folder.give_up(one.chunk.rows, one.reason)
            reporter.lost(one.chunk.rows, one.reason)
            continue
        chunk = one.chunk
        variables = chunk_variables(
            table, chunk.rows, one.judged, chunk.is_too_stiff, one.substeps, kept
        )
        folder.write_chunk(variables)
        reporter.chunk(variables["status"].data)
    return np.concatenate(lost)


@contextmanager
def _interrupts() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets; a second Ctrl-C ends the process at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(*_: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)
        print("studies: stopping after what is under way; Ctrl-C again: at once", file=sys.stderr)

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


class Estimate(NamedTuple):
    """Estimated time of a sweep."""

    compile_time: float  # of the first program [s]
    chunk_time: float  # of one of its chunks [s]
    total: float  # compiling and running everything [s]


def calibrate(plan: Plan) -> Estimate:
    """Compile the first program and time one chunk of it."""
    group = plan.groups[0]
    has_own = has_own_ratio(plan.table, group)
    executor = make_executor(group.structure, group.layout, has_own)
    rows = group.chunks()[0].rows
    cases = chunk_cases(plan.table, rows, group.structure, group.layout.size)
    start_chunk(executor, plan.table, rows, cases, has_own).wait()
    began = time.perf_counter()
    start_chunk(executor, plan.table, rows, cases, has_own).wait()
    chunk_time = time.perf_counter() - began
    per_step = chunk_time / (group.layout.size * group.structure.n_steps * group.structure.substeps)
    running = sum(
        len(g.chunks()) * g.layout.size * g.structure.n_steps * g.structure.substeps * per_step
        for g in plan.groups
    )
    total = running + len(plan.groups) * executor.compile_time
    return Estimate(executor.compile_time, chunk_time, total)
