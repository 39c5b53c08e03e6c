"""Shards of a screen on the workers of a cluster; a worker returns no more than a tally."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from studies import config
from studies.cluster.runner import answers
from studies.cluster.watch import Watch, wait_for_workers
from studies.cluster.worker import identity, working
from studies.screen.local import ShardWork
from studies.screen.shards import ScreenRequest, screen_of, shard_tally, table_of
from studies.screen.tally import Tally
from studies.space.spec import parse_sweep

if TYPE_CHECKING:
    from distributed import Client, Future


class ShardJob(NamedTuple):
    """A shard, defined by everything that determines its tally."""

    identity: dict[str, str]  # of the client
    precision: str
    spec: str  # the sweep as JSON
    by: str
    fidelity: str
    shard_size: int
    shard: int


class ShardDone(NamedTuple):
    """A worker's result of a job."""

    tally: Tally
    worker: str  # address


class ClusterScreener:
    """Runs shards on a cluster; a `studies.screen.local.Screener`."""

    def __init__(self, client: Client, timeout: float) -> None:
        """
        Args:
            client: from `connected`.
            timeout: a worker that stays busy for longer without answering is restarted [s].
        """
        self._client, self._timeout = client, timeout

    def tallies(self, work: ShardWork) -> Iterator[tuple[int, Tally | str]]:
        """As the protocol says."""
        screen, progress = work.screen, work.progress
        wait_for_workers(self._client)
        watch = Watch(self._client, self._timeout, progress.say)
        progress.say(f"workers: {watch.n_workers}; each compiles before its first shard")
        spec, expected = json.dumps(screen.spec.data), identity()

        def submit(shard: int) -> Future[ShardDone]:
            job = ShardJob(
                identity=expected,
                precision=config.origin()["precision"],
                spec=spec,
                by=screen.by,
                fidelity=screen.spec.sweep.fidelity,
                shard_size=screen.shard_size,
                shard=shard,
            )
            return self._client.submit(run_shard, job, pure=False)

        with closing(answers(self._client, watch, work.shards, submit, work.stop)) as answered:
            for shard, answer in answered:
                if isinstance(answer, ShardDone):
                    progress.add(answer.tally.endings)
                    yield shard, answer.tally
                else:
                    yield shard, answer


def run_shard(job: ShardJob) -> ShardDone:
    """Run a shard.

    Raises:
        StudyError: the worker has other versions than the client.
    """
    with working(job.identity, job.precision) as worker:
        screen = _screen(job.spec, job.by, job.fidelity, job.shard_size)
        table = table_of(screen, job.shard)
        tally = shard_tally(screen, job.shard, table, threading.Event())
        assert tally is not None  # nothing stops it
        return ShardDone(tally, worker.address)


@lru_cache(maxsize=1)
def _screen(spec: str, by: str, fidelity: str, shard_size: int) -> ScreenRequest:
    return screen_of(parse_sweep(json.loads(spec)), by, fidelity=fidelity, shard_size=shard_size)
