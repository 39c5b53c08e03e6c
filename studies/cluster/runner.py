"""Chunks of a sweep on the workers of a cluster: few in flight, none lost, none twice.

Dask reruns a chunk elsewhere when its worker dies. A chunk whose workers keep dying, or that fails
there, is tried once more with nothing else in flight, since a bad chunk can take good ones down
with it; then it is given up.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Generator
from typing import TYPE_CHECKING, Any, NamedTuple

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

#: Chunks in flight per worker: one running, one waiting.
AHEAD = 2
#: Minimum number of chunks per worker, so that none waits long for the last ones.
LEAST_CHUNKS = 4


class InFlight(NamedTuple):
    """A chunk in flight."""

    group: Group
    chunk: Chunk
    has_own_ratio: bool  # of the group
    is_alone: bool = False  # nothing else is in flight


class ClusterRunner:
    """Runs the chunks of one sweep on a cluster; a `studies.engine.chunks.Runner`."""

    def __init__(self, client: Client, spec: SweepSpec, timeout: float) -> None:
        """
        Args:
            client: from `connected`.
            spec: the sweep.
            timeout: a worker that stays busy for longer without answering is restarted [s].
        """
        self._client, self._timeout = client, timeout
        self._spec, self._identity = json.dumps(spec.data), identity()
        self._precision = config.origin()["precision"]

    def layout(self, n: int, structure: Structure) -> Layout:
        wait_for_workers(self._client)
        share = -(-n // (LEAST_CHUNKS * max(len(self._client.ncores()), 1)))
        future = self._client.submit(chunk_size, share, structure, self._precision, pure=False)
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
        waiting = (
            InFlight(group, chunk, own)
            for group, own in zip(groups, owns, strict=True)
            for chunk in group.chunks()
        )
        suspects: deque[InFlight] = deque()
        in_flight: dict[Future[Any], InFlight] = {}
        compiled: set[Structure] = set()

        def begin(entry: InFlight | None) -> bool:
            if entry is None or stop.is_set():
                return False
            in_flight[self._submit(entry)] = entry
            return True

        try:
            while True:
                while len(in_flight) < AHEAD * max(watch.n_workers, 1) and begin(
                    next(waiting, None)
                ):
                    pass
                if not in_flight and suspects:
                    begin(suspects.popleft())
                if not in_flight or (stop.is_set() and not watch.n_workers):
                    return
                for future in watch.finished(in_flight):
                    entry = in_flight.pop(future)
                    structure = entry.group.structure
                    answer = watch.outcome(future)
                    if isinstance(answer, ChunkDone):
                        if answer.compile_time and structure not in compiled:
                            compiled.add(structure)
                            reporter.compiled(answer.executor, answer.compile_time)
                        yield Done(entry.chunk, structure.substeps, answer.judged)
                    elif entry.is_alone:
                        yield Lost(entry.chunk, answer)
                    else:
                        suspects.append(entry._replace(is_alone=True))
        finally:
            if in_flight:
                self._client.cancel(list(in_flight))

    def _submit(self, entry: InFlight) -> Future[Any]:
        group = entry.group
        job = ChunkJob(
            identity=self._identity,
            precision=self._precision,
            spec=self._spec,
            structure=group.structure,
            has_own_ratio=entry.has_own_ratio,
            is_judged=group.is_judged,
            robustness=group.robustness,
            size=group.layout.size,
            rows=entry.chunk.rows,
        )
        return self._client.submit(run_chunk, job, pure=False)
