"""`studies screen`: runs the shards that are left, here or on workers, and keeps the tally."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from rich.console import Console

from jaxmodel import status
from studies import config
from studies.engine.folder import locked_folder
from studies.engine.progress import Phases, duration_text
from studies.engine.sweep import interrupts
from studies.screen.margins import kept_margins, uncontrolled
from studies.screen.shards import ScreenRequest, designs_table, shard_tally
from studies.screen.stored import begin, write_best, write_tally
from studies.screen.tally import LEFT_OUT, Tally, merged
from studies.show.units import count_text
from studies.space.table import CaseTable, build_table

T = TypeVar("T")

PHASES = ("screen", "report")


class ScreenProgress:
    """Counts designs and reports them.

    phases: of the command; total: designs; done: those of earlier runs.
    """

    def __init__(self, phases: Phases, total: int, done: int) -> None:
        self.say, self._phases = phases.say, phases
        self._total, self._done, self._before = total, done, done
        self._began, self._next, self._n_failed = time.perf_counter(), 0.0, 0

    def add(self, endings: np.ndarray) -> None:
        """Some designs are done; how many have each status code, or were left out."""
        self._done += int(endings.sum())
        self._n_failed += int(endings[:LEFT_OUT].sum() - endings[status.OK])
        elapsed = time.perf_counter() - self._began
        if elapsed < self._next and self._done < self._total:
            return
        self._next = max(elapsed + 1, 1.02 * elapsed)
        rate = (self._done - self._before) / max(elapsed, 1e-9)
        left = duration_text((self._total - self._done) / rate) if rate else ""
        text = (
            f"{self._done:,} of {self._total:,} designs, {rate:,.0f}/s, {self._n_failed:,} not ok"
        )
        self._phases.advance(self._done, self._total, text, left and f"about {left}")


class ShardWork(NamedTuple):
    """Shards to run."""

    screen: ScreenRequest
    shards: Iterable[int]  # their numbers
    progress: ScreenProgress  # told of designs that have run
    stop: threading.Event  # once set, no further shards are begun


class Screener(Protocol):
    """Where shards are run."""

    def tallies(self, work: ShardWork) -> Iterator[tuple[int, Tally | str]]:
        """Each shard with its tally, or with the reason why it was given up."""
        ...


class LocalScreener:
    """Runs shards in this process, and makes the designs of the next one meanwhile."""

    def tallies(self, work: ShardWork) -> Iterator[tuple[int, Tally | str]]:
        """As the protocol says."""
        screen = work.screen

        def make(shard: int) -> tuple[int, CaseTable]:
            return shard, build_table(screen.spec, screen.rows(shard))

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


class ScreenOutcome(NamedTuple):
    """How a screen ended."""

    screen: ScreenRequest
    is_done: np.ndarray  # by shard
    tally: Tally
    lost: dict[int, str]  # shards that were given up, and why
    is_interrupted: bool  # by Ctrl-C
    kept: CaseTable | None  # cases of `best.toml`, best first; None: interrupted, or none
    margin: np.ndarray  # gain margins of the designs kept, NaN: not judged, (k,)
    uncontrolled: float | None  # the metric without control; None: not known

    @property
    def place(self) -> np.ndarray:
        """Which of the designs kept each case of `best.toml` is, (n,)."""
        assert self.kept is not None
        return np.flatnonzero(np.isin(self.tally.row, self.kept.row))


def run_screen(
    screen: ScreenRequest,
    out: str | Path,
    is_quiet: bool = False,
    screener: Screener | None = None,
    phases: Phases | None = None,
) -> ScreenOutcome:
    """Run what is left of a screen into a folder.

    Args:
        screen: from `screen_of`.
        out: its folder; one that was begun is gone on with.
        is_quiet: hide progress.
        screener: where shards are run; default: here.
        phases: of a longer command, with those of `PHASES`, in place of is_quiet.

    Returns:
        ScreenOutcome; `best.toml` is there unless the run was interrupted or no design ended well.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished shards stay.
    """
    config.require_configured()
    screener, out = screener or LocalScreener(), Path(out)
    if phases is None:
        with Phases(Console(highlight=False, markup=False), PHASES, is_quiet) as phases:
            return run_screen(screen, out, screener=screener, phases=phases)
    lost: dict[int, str] = {}
    with locked_folder(out, "screen"), interrupts() as stop:
        is_done, tally = begin(out, screen)
        left = np.flatnonzero(~is_done).tolist()
        phases.begin(
            "screen", f"{screen.n_designs:,} designs in {count_text(screen.n_shards, 'shard')}"
        )
        progress = ScreenProgress(phases, screen.n_designs, tally.n_designs)
        for shard, answer in screener.tallies(ShardWork(screen, left, progress, stop)):
            if isinstance(answer, str):
                lost[shard] = answer
                phases.say(f"shard {shard} is left out: {answer}")
                continue
            tally = merged(tally, answer, *screen.ranking)
            is_done[shard] = True
            write_tally(out, screen, is_done, tally)
        is_interrupted = stop.is_set() and not is_done.all()
        kept = None if is_interrupted or not len(tally.row) else designs_table(screen, tally.row)
        if kept is not None:
            write_best(out, screen, kept)
    margin, without = np.full(len(tally.row), np.nan), None
    if kept is not None:
        margin[np.isin(tally.row, kept.row)] = kept_margins(screen, kept)
        without = uncontrolled(screen, kept)
    return ScreenOutcome(
        screen=screen,
        is_done=is_done,
        tally=tally,
        lost=lost,
        is_interrupted=is_interrupted,
        kept=kept,
        margin=margin,
        uncontrolled=without,
    )
