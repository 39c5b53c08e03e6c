"""Chunks of a sweep on the workers of a cluster: few in flight, none lost, none twice.

Dask reruns a chunk elsewhere when its worker dies. A chunk whose workers keep dying, or that fails
there, is tried once more with nothing else in flight, since a bad chunk can take good ones down
with it; then it is given up.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from jaxmodel.case import Structure
from studies import config
from studies.cluster.watch import Watch, wait_for_workers
from studies.cluster.worker import ChunkDone, ChunkJob, chunk_size, identity, run_chunk
from studies.engine.chunks import Done, Lost, has_own_ratio
from studies.engine.plan import Chunk, Group, Layout
from studies.engine.progress import Reporter
from studies.errors import StudyError
from studies.space.spec import SweepSpec
from studies.space.table import CaseTable

if TYPE_CHECKING:
    from distributed import Client, Future

T = TypeVar("T")

#: Jobs in flight per worker: one running, one waiting.
AHEAD = 2
#: Minimum number of chunks per worker, so that none waits long for the last ones.
LEAST_CHUNKS = 4


class InFlight(NamedTuple):
    """A job in flight."""

    job: Any
    is_alone: bool = False  # nothing else is in flight


def answers(
    client: Client,
    watch: Watch,
    jobs: Iterable[T],
    submit: Callable[[T], Future[Any]],
    stop: threading.Event,
) -> Generator[tuple[T, Any]]:
    """Jobs with their answers, or with a text that says why they were given up.

    Args:
        client: of the cluster.
        watch: over its workers.
        jobs: what is to be done.
        submit: sends a job to a worker.
        stop: once set, no further jobs are sent.
    """
    waiting = iter(jobs)
    suspects: deque[T] = deque()
    in_flight: dict[Future[Any], InFlight] = {}
    try:
        while True:
            while len(in_flight) < AHEAD * max(watch.n_workers, 1) and not stop.is_set():
                job = next(waiting, None)
                if job is None:
                    break
                in_flight[submit(job)] = InFlight(job)
            if not in_flight and suspects and not stop.is_set():
                job = suspects.popleft()
                in_flight[submit(job)] = InFlight(job, is_alone=True)
            if not in_flight or (stop.is_set() and not watch.n_workers):
                return
            for future in watch.finished(in_flight):
                entry = in_flight.pop(future)
                answer = watch.outcome(future)
                if isinstance(answer, str) and not entry.is_alone:
                    suspects.append(entry.job)
                else:
                    yield entry.job, answer
    finally:
        if in_flight:
            client.cancel(list(in_flight))


class ChunkOf(NamedTuple):
    """A chunk to be run."""

    group: Group
    chunk: Chunk
    has_own_ratio: bool  # of the group


class ClusterRunner:
    """Runs the chunks of one sweep on a cluster; a `studies.engine.chunks.Runner`."""

    def __init__(self, spec: SweepSpec, client: Client, timeout: float) -> None:
        """
        Args:
            spec: the sweep.
            client: from `connected`.
            timeout: a worker that stays busy for longer without answering is restarted [s].
        """
        self._client, self._timeout = client, timeout
        self._spec, self._identity = json.dumps(spec.data), identity()
        self._precision = config.origin()["precision"]

    def layout(self, n: int, structure: Structure) -> Layout:
        wait_for_workers(self._client)
        share = -(-n // (LEAST_CHUNKS * max(len(self._client.ncores()), 1)))
        job = self._identity, share, structure, self._precision
        future = self._client.submit(chunk_size, *job, pure=False)
        try:
            size: int = future.result(timeout=self._timeout)
        except StudyError:
            raise
        except Exception as error:  # too late, cancelled, the worker died
            reason = str(error) or type(error).__name__
            raise StudyError(f"no worker is ready: {reason.partition(chr(10))[0]}") from None
        return Layout(1, 1, size)

    def run(
        self, table: CaseTable, groups: list[Group], reporter: Reporter, stop: threading.Event
    ) -> Generator[Done | Lost]:
        watch = Watch(self._client, self._timeout, reporter.say)
        reporter.say(f"workers: {watch.n_workers}; each compiles before its first chunk")
        owns = [has_own_ratio(table, group) for group in groups]  # structures can be equal
        jobs = (
            ChunkOf(group, chunk, own)
            for group, own in zip(groups, owns, strict=True)
            for chunk in group.chunks()
        )
        compiled: set[Structure] = set()
        with closing(answers(self._client, watch, jobs, self._submit, stop)) as answered:
            for job, answer in answered:
                structure = job.group.structure
                if not isinstance(answer, ChunkDone):
                    yield Lost(job.chunk, answer)
                    continue
                if answer.compile_time and structure not in compiled:
                    compiled.add(structure)
                    reporter.compiled(answer.executor, answer.compile_time)
                yield Done(job.chunk, structure.substeps, answer.judged)

    def _submit(self, one: ChunkOf) -> Future[Any]:
        group = one.group
        job = ChunkJob(
            identity=self._identity,
            precision=self._precision,
            spec=self._spec,
            structure=group.structure,
            has_own_ratio=one.has_own_ratio,
            is_judged=group.is_judged,
            robustness=group.robustness,
            size=group.layout.size,
            rows=one.chunk.rows,
        )
        return self._client.submit(run_chunk, job, pure=False)
