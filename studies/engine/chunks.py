"""Running the chunks of a sweep: in this process, or wherever another `Runner` sends them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, Protocol

import jax
import numpy as np
from rich.console import Console

from jaxmodel.case import Case, Structure, with_ratio
from jaxmodel.numbers import signed_power
from jaxmodel.simulate import RunResult
from studies.engine.executor import Executor, own_ratios
from studies.engine.margins import judge_loops, no_margins
from studies.engine.plan import MANY, Chunk, Group, Layout, chunk_cases, local_layout
from studies.engine.progress import Reporter
from studies.engine.robustness import judge_robustness
from studies.engine.stability import LoopFigures
from studies.kernels.compilation import compiler_time
from studies.phases import Phases
from studies.space.table import CaseTable
from studies.study.fields import row_keys
from studies.threads import COMPILING


class Done(NamedTuple):
    """A finished chunk."""

    chunk: Chunk
    substeps: int  # plant steps per sample of its program
    judged: JudgedChunk  # padded


class JudgedChunk(NamedTuple):
    """Runs of a chunk, and the judgement of its loops."""

    result: RunResult
    margins: LoopFigures
    has_verdict: bool  # on sampled loops: their margins are numbers, or could not be found


class Started(NamedTuple):
    """A running chunk; as `Running`, with the judgement of its loops."""

    wait: Callable[[], JudgedChunk]
    cancel: Callable[[], None]


class Lost(NamedTuple):
    """A chunk that was given up."""

    chunk: Chunk
    reason: str


class Runner(Protocol):
    """Where chunks are run."""

    def layout(self, n: int, structure: Structure) -> Layout:
        """Shape of the chunks of n cases of one structure."""
        ...

    def run(
        self, table: CaseTable, groups: list[Group], reporter: Reporter, stop: threading.Event
    ) -> Generator[Done | Lost]:
        """Run all chunks; if closed early, it leaves none running.

        Args:
            table: all cases.
            groups: those to run.
            reporter: told of compilations.
            stop: once set, no further chunks are started.
        """
        ...


#: Groups that are begun side by side: neither compilers nor runs keep all cores busy all the time.
BEGUN = 2


class LocalRunner:
    """Runs chunks in this process, on its own devices; compiles for the next group meanwhile."""

    def layout(self, n: int, structure: Structure) -> Layout:
        return local_layout(n, structure)

    def run(
        self, table: CaseTable, groups: list[Group], reporter: Reporter, stop: threading.Event
    ) -> Generator[Done | Lost]:
        waiting, begun = iter(groups), deque[Future[_BegunGroup]]()
        pool, is_hurried = ThreadPoolExecutor(BEGUN, COMPILING), False

        def begin_next() -> None:
            group = next(waiting, None)
            if group is not None and not stop.is_set():
                begun.append(pool.submit(_begin, table, group))

        try:
            for _ in range(BEGUN):
                begin_next()
            while begun:
                one = _waited_for(begun[0], reporter)
                begun.popleft()
                yield from _finish(table, one, reporter, stop)
                if stop.is_set():
                    return
                begin_next()
        except KeyboardInterrupt:
            is_hurried = True  # a compiler cannot be stopped, and is not waited for
            raise
        finally:
            pool.shutdown(wait=not is_hurried, cancel_futures=True)
            for future in begun:
                if future.done() and not future.cancelled() and future.exception() is None:
                    future.result().first.cancel()


def run_quietly(
    table: CaseTable, groups: list[Group], stop: threading.Event | None = None
) -> Iterator[Done]:
    """Chunks of groups, run here without a word, until `stop` is set."""
    count = sum(len(group.rows) for group in groups)
    with Phases(Console(quiet=True), ("compile", "run"), is_quiet=True) as phases:
        reporter = Reporter(phases, "run", count, 0, len(groups))
        for done in LocalRunner().run(table, groups, reporter, stop or threading.Event()):
            assert isinstance(done, Done)  # only workers of a cluster give chunks up
            yield done


class _BegunGroup(NamedTuple):
    """A group whose program is compiled, and whose first chunk runs."""

    group: Group
    executor: Executor
    first: Started


def _begin(table: CaseTable, group: Group) -> _BegunGroup:
    has_own, is_many = has_own_ratio(table, group), len(table) >= MANY
    executor = Executor(group.structure, group.layout, has_own, is_many=is_many)
    return _BegunGroup(group, executor, _start(table, group, executor, group.chunks()[0]))


def _start(table: CaseTable, group: Group, executor: Executor, chunk: Chunk) -> Started:
    cases = chunk_cases(table, chunk.rows, group.structure, group.layout.size)
    return start_chunk(executor, table, chunk.rows, cases, group.is_judged, group.robustness)


def _waited_for(begun: Future[_BegunGroup], reporter: Reporter) -> _BegunGroup:
    """A group, as soon as its first chunk runs; reports its compilation."""
    reporter.compiling()
    began = time.perf_counter()
    one = begun.result()
    waited = time.perf_counter() - began
    reporter.compiled(one.executor.name, min(one.executor.compile_time, waited))
    return one


def _finish(
    table: CaseTable, begun: _BegunGroup, reporter: Reporter, stop: threading.Event
) -> Generator[Done]:
    """Run the other chunks of a group; each is computed while the previous one is written."""
    group, executor, running = begun
    first, *others = group.chunks()
    pending = first, running
    try:
        for chunk in others:
            if stop.is_set():
                break
            previous, pending = pending, (chunk, _start(table, group, executor, chunk))
            yield _wait_for(group, *previous)
        if stop.is_set() and reporter.n_run:  # the previous is safe, this one just begun
            return
        yield _wait_for(group, *pending)
    finally:
        pending[1].cancel()


def _wait_for(group: Group, chunk: Chunk, running: Started) -> Done:
    return Done(chunk, group.structure.substeps, running.wait())


def has_own_ratio(table: CaseTable, group: Group) -> bool:
    """Whether EMC ratios come from an uncontrolled pass for some cases of a group."""
    return bool((table.values("control.ratio_source")[group.rows] == "own_run").any())


def start_chunk(
    executor: Executor,
    table: CaseTable,
    rows: np.ndarray,
    cases: Case,
    is_judged: bool = True,
    robustness: tuple[str, ...] = (),
) -> Started:
    """Judge the loops of a chunk and start its runs.

    If gain ratios come from an uncontrolled pass, that pass runs first.

    Args:
        executor: of the group.
        table: all cases.
        rows: those of the chunk.
        cases: from `chunk_cases`.
        is_judged: whether the loops are judged; otherwise their margins are NaN.
        robustness: figures of `jaxmodel.robustness` to judge them by as well.
    """
    is_first = executor.compile_time == 0
    if executor.has_own_ratio:
        size = max(map(len, jax.tree.leaves(cases)))
        filled = np.concatenate([rows, np.full(size - len(rows), rows[-1])])
        is_own = table.values("control.ratio_source")[filled] == "own_run"
        exponent = table.values("control.ratio_exponent")[filled][:, None, None]
        own = signed_power(own_ratios(executor, cases), exponent)
        cases = with_ratio(cases, np.where(is_own[:, None, None], own, cases.control.ratio))
    before = compiler_time()
    if is_judged:
        margins = judge_cases(executor.structure, cases, robustness)
    else:
        margins = no_margins(executor.structure, cases)._replace(robustness={})
    spent = compiler_time() - before
    running = executor.start(cases)
    if is_first:
        executor.compile_time += spent
    has_verdict = is_judged and executor.structure.feedback == "sampled"
    return Started(lambda: JudgedChunk(running.wait(), margins, has_verdict), running.cancel)


def judge_cases(structure: Structure, cases: Case, robustness: tuple[str, ...] = ()) -> LoopFigures:
    """Judge the sampled loops of cases.

    Args:
        structure: of their runs.
        cases: leaves with a leading axis, all cases or 1.
        robustness: figures of `jaxmodel.robustness` to judge them by as well.
    """
    first, own = distinct_loops(cases)
    each = jax.tree.map(lambda x: x if len(x) == 1 else x[first], cases)
    figures = judge_loops(structure, each)
    more = {}
    if robustness:
        more = judge_robustness(structure, each, robustness, figures.gain_margin)
    of_cases: LoopFigures = jax.tree.map(lambda x: x[own], figures._replace(robustness=more))
    return of_cases


def distinct_loops(cases: Case) -> tuple[np.ndarray, np.ndarray]:
    """First case of every loop about rest at the first way-point, and the loop of every case.

    Args:
        cases: leaves with a leading axis, all cases or 1.

    Returns:
        Numbers of cases, rising, (m,); positions among them, (n,).
    """
    count = max(map(len, jax.tree.leaves(cases)))
    pose = cases.path.waypoints[:, 0]
    loops = pose, cases.machine, cases.n_modes, cases.control, cases.electronics, cases.drive
    varying = [np.asarray(x) for x in jax.tree.leaves((*loops, cases.load)) if len(x) > 1]
    if not varying:
        return np.zeros(1, int), np.zeros(count, int)
    keys = row_keys(x for x in varying if x.size)
    _, first, own = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[np.ravel(own)]
