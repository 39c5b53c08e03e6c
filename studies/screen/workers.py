"""Shards of a screen on the workers of a cluster; a worker returns no more than a tally."""

from __future__ import annotations

import json
import threading
from contextlib import closing
from functools import lru_cache

from studies.cluster.remote import Remote
from studies.screen.local import Answers, ShardWork
from studies.screen.shards import ScreenRequest, screen_of, shard_tally, table_of
from studies.screen.tally import Tally
from studies.space.spec import parse_sweep


def tallies_on(remote: Remote, work: ShardWork) -> Answers:
    """Run shards on a cluster."""
    screen, progress = work.screen, work.progress
    progress.say(f"workers: {remote.n_workers}; each compiles before its first shard")
    common = json.dumps(screen.spec.data), screen.shard_size
    jobs = ((shard, (*common, shard)) for shard in work.shards)
    with closing(remote.map(run_shard, jobs, work.stop)) as answered:
        for shard, answer in answered:
            if not isinstance(answer, str):
                progress.add(answer.endings)
            yield shard, answer


def run_shard(spec: str, shard_size: int, shard: int) -> Tally:
    """Run a shard on a worker.

    Args:
        spec: the sweep as JSON.
        shard_size: as in `screen_of`.
        shard: its number.
    """
    screen = _screen(spec, shard_size)
    table = table_of(screen, shard)
    tally = shard_tally(screen, shard, table, threading.Event())
    assert tally is not None  # nothing stops it
    return tally


@lru_cache(maxsize=1)
def _screen(spec: str, shard_size: int) -> ScreenRequest:
    return screen_of(parse_sweep(json.loads(spec)), shard_size)
