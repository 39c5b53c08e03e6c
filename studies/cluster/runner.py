"""Chunks of a sweep on the workers of a cluster, each from just the sweep's file and row numbers.

A worker keeps its table and its programs for the next chunk.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Generator
from contextlib import closing
from functools import lru_cache

from jaxmodel.case import Structure
from studies import config
from studies.cluster.remote import Remote
from studies.engine.chunks import Done, JudgedChunk, Lost, has_own_ratio, start_chunk
from studies.engine.executor import Executor
from studies.engine.plan import MANY, Group, Layout, chunk_cases, even_layout, local_layout
from studies.engine.progress import Reporter
from studies.errors import StudyError
from studies.space.spec import SweepSpec, parse_sweep
from studies.space.table import CaseTable, build_table

#: Minimum number of chunks per worker, so that none waits long for the last ones.
LEAST_CHUNKS = 4


class ClusterRunner:
    """Runs the chunks of one sweep on a cluster; a `studies.engine.chunks.Runner`."""

    def __init__(self, spec: SweepSpec, remote: Remote) -> None:
        self._spec, self._remote = json.dumps(spec.data), remote

    def layout(self, n: int, structure: Structure) -> Layout:
        share = -(-n // (LEAST_CHUNKS * max(self._remote.n_workers, 1)))
        ((_, size),) = self._remote.map(chunk_size, [(None, (share, structure))])
        if isinstance(size, str):
            raise StudyError(f"no worker is ready: {size}")
        return Layout(1, 1, size)

    def run(
        self, table: CaseTable, groups: list[Group], reporter: Reporter, stop: threading.Event
    ) -> Generator[Done | Lost]:
        reporter.say(f"workers: {self._remote.n_workers}; each compiles before its first chunk")
        owns = [has_own_ratio(table, group) for group in groups]  # structures can be equal
        jobs = (
            ((chunk, group.structure), (self._spec, group._replace(**chunk._asdict()), own))
            for group, own in zip(groups, owns, strict=True)
            for chunk in group.chunks()
        )
        compiled: set[Structure] = set()
        with closing(self._remote.map(run_chunk, jobs, stop)) as answered:
            for (chunk, structure), answer in answered:
                if isinstance(answer, str):
                    yield Lost(chunk, answer)
                    continue
                judged, executor, compile_time = answer
                if compile_time and structure not in compiled:
                    compiled.add(structure)
                    reporter.compiled(executor, compile_time)
                yield Done(chunk, structure.substeps, judged)


def chunk_size(n: int, structure: Structure) -> int:
    """How many of n cases a worker prefers to run at once."""
    return local_layout(n, structure).size


def run_chunk(spec: str, group: Group, has_own_ratio: bool) -> tuple[JudgedChunk, str, float]:
    """Run a chunk on a worker.

    Args:
        spec: the sweep as JSON.
        group: its rows are those of the chunk; its size is that of full chunks, so that a shorter
            one runs the same program.
        has_own_ratio: EMC ratios come from an uncontrolled pass for some cases of the whole group.

    Returns:
        The chunk, padded, NumPy arrays; the executor; what compiling took [s], 0 if the program
        already existed.
    """
    precision, size = config.origin()["precision"], group.layout.size
    table = _table(spec)
    executor = _executor(precision, spec, group.structure, size, has_own_ratio)
    is_first = executor.compile_time == 0
    cases = chunk_cases(table, group.rows, group.structure, even_layout(size).size)
    started = start_chunk(executor, table, group.rows, cases, group.is_judged, group.robustness)
    judged = started.wait()
    return judged, executor.name, executor.compile_time if is_first else 0.0


@lru_cache(maxsize=1)
def _table(spec: str) -> CaseTable:
    return build_table(parse_sweep(json.loads(spec)))


@lru_cache(maxsize=8)
def _executor(
    precision: str, spec: str, structure: Structure, size: int, has_own_ratio: bool
) -> Executor:
    """The sweep's own executor: numbers shared by all its cases are compiled into its program."""
    is_many = len(_table(spec)) >= MANY
    return Executor(structure, even_layout(size), has_own_ratio, is_many=is_many)
