"""What runs on a worker: a chunk, from just the sweep's file and row numbers.

A worker process runs one chunk at a time, on as many cores as it has threads or on the GPUs it
sees, and keeps its table and its programs for the next one.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from importlib.metadata import version
from threading import RLock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxmodel.case import Structure
from studies import config, sources
from studies.engine.chunks import JudgedChunk, start_chunk
from studies.engine.executor import Executor
from studies.engine.plan import MANY, chunk_cases, even_layout, local_layout
from studies.errors import StudyError
from studies.extensions import extend_from_environment
from studies.space.spec import parse_sweep
from studies.space.table import CaseTable, build_table

if TYPE_CHECKING:
    from distributed import Worker

#: One chunk at a time: it uses the whole worker.
alone = RLock()


class ChunkJob(NamedTuple):
    """A chunk, defined by everything that determines its numbers."""

    identity: dict[str, str]  # of the client, see `identity`
    precision: str
    spec: str  # the sweep as JSON
    structure: Structure  # of the chunk's group
    has_own_ratio: bool  # EMC ratios come from an uncontrolled pass
    is_judged: bool  # gain margins and damping of every loop
    robustness: tuple[str, ...]  # further figures of every loop
    size: int  # cases in a full chunk, so that a shorter last one runs the same program
    rows: np.ndarray  # of the sweep's table, (k,)


class ChunkDone(NamedTuple):
    """A worker's result of a job."""

    judged: JudgedChunk  # padded, NumPy arrays
    executor: str
    compile_time: float  # [s], 0 if the program already existed
    worker: str  # address


@cache
def identity() -> dict[str, str]:
    """What must be the same on client and workers."""
    extend_from_environment()
    return {
        "code": sources.digest(
            "studies.cluster.worker", "studies.screen.workers", "studies.tuning.workers"
        ),
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: version(name) for name in ("jax", "jaxlib", "numpy")},
    }


def difference(versions: dict[str, str], expected: dict[str, str]) -> str:
    """How a worker differs from the client, "" if it does not."""
    parts = [
        f"{name} {versions.get(name)} (client: {value})"
        for name, value in expected.items()
        if versions.get(name) != value
    ]
    return ", ".join(parts)


@contextmanager
def working(expected: dict[str, str], precision: str) -> Iterator[Worker]:
    """This worker, for one job that has all of it: JAX uses one core per thread.

    Args:
        expected: versions of the client, from `identity`.
        precision: of the job.

    Raises:
        StudyError: the worker, which may have joined late, has other versions than the client.
    """
    from distributed import get_worker  # an extra

    with alone:
        worker = get_worker()
        if fault := difference(identity(), expected):
            raise StudyError(f"worker {worker.address}: {fault}; install the same there")
        config.configure(precision, worker.state.nthreads)
        config.start(precision)
        yield worker


def chunk_size(expected: dict[str, str], n: int, structure: Structure, precision: str) -> int:
    """How many of n cases this worker prefers to run at once; expected: as in `working`."""
    with working(expected, precision):
        return local_layout(n, structure).size


def run_chunk(job: ChunkJob) -> ChunkDone:
    """Run a chunk.

    Raises:
        StudyError: the worker has other versions than the client.
    """
    with working(job.identity, job.precision) as worker:
        table = _table(job.spec)
        executor = _executor(job.precision, job.spec, job.structure, job.size, job.has_own_ratio)
        is_first = executor.compile_time == 0
        size = even_layout(job.size).size
        cases = chunk_cases(table, job.rows, job.structure, size)
        started = start_chunk(executor, table, job.rows, cases, job.is_judged, job.robustness)
        judged = started.wait()
        compile_time = executor.compile_time if is_first else 0.0
        return ChunkDone(judged, executor.name, compile_time, worker.address)


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
