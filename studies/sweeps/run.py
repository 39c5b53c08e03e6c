"""`studies sweep`: runs what is not done yet, chunk by chunk, and joins the results."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console

from jaxmodel.case import Case
from studies import config
from studies.cases import powered
from studies.errors import StudyError
from studies.runs import with_ratio
from studies.sweeps.executor import make_executor, own_ratios
from studies.sweeps.folder import (
    SweepFolder,
    finished_cases,
    make_manifest,
    open_folder,
)  # fmt: skip
from studies.sweeps.plan import Group, chunk_cases, plan_groups
from studies.sweeps.program import Executor, Running
from studies.sweeps.progress import Reporter
from studies.sweeps.results import chunk_variables, kept_metrics, manifest_attributes, merge
from studies.sweeps.spec import SweepSpec
from studies.sweeps.table import Table, build_table


class Outcome(NamedTuple):
    """How a sweep ended."""

    table: Table
    n_done: int  # cases with results, those of earlier runs included
    n_run: int  # in this run
    compile_time: float  # [s]
    run_time: float  # [s]
    is_interrupted: bool  # by Ctrl-C
    executor: str  # that ran the last chunks; "" where there were none


class Plan(NamedTuple):
    """What a sweep would do."""

    table: Table
    groups: list[Group]
    n_before: int  # cases that are done already


def make_plan(spec: SweepSpec, out: Path | None = None) -> Plan:
    """Cases of a sweep that are still to run, grouped by program.

    Args:
        spec: the sweep.
        out: folder with a part of them, if it is to be resumed.

    Raises:
        StudyError: a fault of the sweep, or one that does not fit the folder.
    """
    config.require_configured()
    kept_metrics(spec)
    table = build_table(spec)
    rows = np.arange(len(table))
    if out is not None:
        rows = _rows_left(table, finished_cases(out).case_id, out)
    groups = plan_groups(table, rows, len(jax.local_devices()), spec.sweep.metrics)
    return Plan(table, groups, len(table) - len(rows))


def run_sweep(
    spec: SweepSpec,
    out: Path,
    is_resumed: bool = False,
    console: Console | None = None,
    is_quiet: bool = False,
) -> Outcome:
    """Run a sweep into a folder.

    Args:
        spec: the sweep.
        out: its folder.
        is_resumed: go on with, or extend, the sweep that is there.
        console: where progress goes; default: standard output.
        is_quiet: no progress.

    Returns:
        Outcome; `results.h5` is there unless the run was interrupted.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished chunks stay.
    """
    config.require_configured()
    kept = kept_metrics(spec)
    table = build_table(spec)
    console = console or Console(highlight=False, markup=False)
    manifest = make_manifest(spec.data)
    with open_folder(out, manifest, is_resumed) as folder:
        finished = finished_cases(out, lambda text: console.print(text, soft_wrap=True))
        rows = _rows_left(table, finished.case_id, out)
        folder.begin(manifest)
        groups = plan_groups(table, rows, len(jax.local_devices()), spec.sweep.metrics)
        n_before = len(table) - len(rows)
        with Reporter(console, len(table), n_before, is_quiet) as reporter, _interrupts() as stop:
            reporter.say(_headline(table, groups, n_before))
            is_interrupted = _run_groups(table, groups, kept, folder, reporter, stop)
            if not is_interrupted:
                finished = finished_cases(out)
                _check_whole(table, finished.case_id, out)
                attributes = {"title": spec.study.title, **manifest_attributes(manifest)}
                timings = {"compile_time": reporter.compile_time, "run_time": reporter.run_time}
                merge(out, table, finished, attributes | timings)
                folder.publish()
        return Outcome(
            table, reporter.done, reporter.n_run, reporter.compile_time, reporter.run_time,
            is_interrupted, reporter.executor,
        )  # fmt: skip


def _headline(table: Table, groups: list[Group], n_before: int) -> str:
    text = f"{len(table)} cases"
    if table.n_dropped:
        text += f" ({table.n_dropped} left out by where)"
    if table.n_double:
        text += f" ({table.n_double} doubles left out)"
    if n_before:
        text += f", {n_before} of them done before"
    chunks = sum(len(group.chunks()) for group in groups)
    return f"{text}; chunks: {chunks}, programs to compile: {len(groups)}"


def _rows_left(table: Table, done: np.ndarray, out: Path) -> np.ndarray:
    """Cases still to run. A resumed sweep may have more than the one that is there, but none less.

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


def _check_whole(table: Table, done: np.ndarray, out: Path) -> None:
    """Somebody may have removed chunks while the sweep ran."""
    lost = int(np.sum(~np.isin(table.case_id, done)))
    if lost:
        raise StudyError(
            f"{out}: chunks with {lost} of {len(table)} cases disappeared while the sweep ran; "
            "run them again with --resume"
        )


def _run_groups(
    table: Table,
    groups: list[Group],
    kept: list[str],
    folder: SweepFolder,
    reporter: Reporter,
    stop: threading.Event,
) -> bool:
    """Run all chunks; whether Ctrl-C ended it."""
    source = table.values("control.ratio_source")
    for group in groups:
        is_own = source[group.rows] == "own_run"
        executor = make_executor(group.structure, group.layout, bool(is_own.any()))
        substeps = group.structure.substeps
        pending: tuple[np.ndarray, np.ndarray, Running] | None = None
        position = 0
        for rows in group.chunks():
            cases = chunk_cases(table, rows, group.structure, group.layout.size)
            is_first = executor.compile_time == 0
            started = start_chunk(executor, table, rows, cases, bool(is_own.any()))
            if is_first:
                reporter.compiled(executor.name, executor.compile_time)
            stiff = group.is_too_stiff[position : position + len(rows)]
            position += len(rows)
            # the device computes this chunk while the one before is written
            if pending is not None:
                _finish(table, pending, substeps, kept, folder, reporter)
            pending = (rows, stiff, started)
            if stop.is_set():
                break
        if pending is not None:
            if stop.is_set() and reporter.n_run:  # the chunk before is safe, this one just begun
                pending[2].cancel()
                return True
            _finish(table, pending, substeps, kept, folder, reporter)
        if stop.is_set():
            return reporter.done < reporter.total
    return False


def start_chunk(
    executor: Executor, table: Table, rows: np.ndarray, cases: Case, has_own_ratio: bool
) -> Running:
    """Start a chunk, after its uncontrolled pass where gain ratios come from that.

    Args:
        executor: of the group.
        table: all cases.
        rows: those of the chunk.
        cases: from `chunk_cases`.
        has_own_ratio: whether such a pass is needed.

    Returns:
        Running.
    """
    if has_own_ratio:
        size = max(map(len, jax.tree.leaves(cases)))
        filled = np.concatenate([rows, np.full(size - len(rows), rows[-1])])
        is_own = table.values("control.ratio_source")[filled] == "own_run"
        exponent = table.values("control.ratio_exponent")[filled][:, None, None]
        own = powered(own_ratios(executor, cases), exponent)
        cases = with_ratio(cases, np.where(is_own[:, None, None], own, cases.control.ratio))
    return executor.start(cases)


def _finish(
    table: Table, pending: tuple[Any, Any, Running], substeps: int, kept: list[str],
    folder: SweepFolder, reporter: Reporter,
) -> None:  # fmt: skip
    rows, stiff, running = pending
    variables = chunk_variables(table, rows, running.wait(), stiff, substeps, kept)
    folder.write_chunk(variables)
    reporter.chunk(variables["status"].data)


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
        print("studies: stopping after this chunk; Ctrl-C again: at once", file=sys.stderr)

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


class Estimate(NamedTuple):
    """What a sweep would take."""

    compile_time: float  # of the first program [s]
    chunk_time: float  # of one of its chunks [s]
    total: float  # compiling and running everything [s]


def calibrate(plan: Plan) -> Estimate:
    """Compile the first program and time one chunk of it."""
    group = plan.groups[0]
    has_own = bool((plan.table.values("control.ratio_source")[group.rows] == "own_run").any())
    executor = make_executor(group.structure, group.layout, has_own)
    rows = group.chunks()[0]
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
