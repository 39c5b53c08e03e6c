"""Shards of a screen in this process, one after the other, and how far they are."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np

from jaxmodel import status
from studies.phases import Phases
from studies.screen.shards import ScreenRequest, shard_tally, table_of
from studies.screen.tally import LEFT_OUT, Tally
from studies.space.table import CaseTable

T = TypeVar("T")


class ScreenProgress:
    """Counts designs and reports them.

    phases: of the command; total: designs; done: those of earlier runs.
    """

    def __init__(self, phases: Phases, total: int, done: int) -> None:
        self.say, self._phases = phases.say, phases
        self._total, self._done, self._next, self._n_failed = total, done, 0.0, 0

    def add(self, endings: np.ndarray) -> None:
        """Some designs are done; how many have each status code, or were left out."""
        self._done += int(endings.sum())
        self._n_failed += int(endings[:LEFT_OUT].sum() - endings[status.OK])
        elapsed, done, total = self._phases.elapsed, self._done, self._total
        if elapsed < self._next and done < total:
            return
        self._next = max(elapsed + 1, 1.02 * elapsed)
        text = f"{done:,} of {total:,} designs, {self._phases.rate(done):,.0f}/s"
        self._phases.advance(done, total, f"{text}, {self._n_failed:,} not ok")


class ShardWork(NamedTuple):
    """Shards to run."""

    screen: ScreenRequest
    shards: Iterable[int]  # their numbers
    progress: ScreenProgress  # told of designs that have run
    stop: threading.Event  # once set, no further shards are begun


#: Each shard with its tally, or with the reason why it was given up.
Answers = Iterator[tuple[int, Tally | str]]


def tallies_here(work: ShardWork) -> Answers:
    """Run shards in this process, and make the designs of the next one meanwhile."""
    screen = work.screen

    def make(shard: int) -> tuple[int, CaseTable]:
        return shard, table_of(screen, shard)

    with ThreadPoolExecutor(1) as pool:
        for shard, table in _one_ahead(pool, make, work.shards):
            tally = shard_tally(screen, shard, table, work.stop, work.progress.add)
            if tally is None:
                return
            yield shard, tally


def _one_ahead(
    pool: ThreadPoolExecutor, make: Callable[[int], T], numbers: Iterable[int]
) -> Iterator[T]:
    """What is made of numbers, the next one of which is being made meanwhile."""
    coming: Future[T] | None = None
    for number in numbers:
        ready, coming = coming, pool.submit(make, number)
        if ready is not None:
            yield ready.result()
    if coming is not None:
        yield coming.result()
