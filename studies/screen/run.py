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
from studies.engine.fidelity import TRIED, Agreement, agreement
from studies.engine.folder import locked_folder
from studies.engine.progress import Phases, duration_text
from studies.engine.sweep import interrupts
from studies.screen.selection import Selection, select, uncontrolled
from studies.screen.shards import ScreenRequest, designs_table, shard_tally, table_of
from studies.screen.stored import begin, write_best, write_tally
from studies.screen.tally import LEFT_OUT, Tally, merged
from studies.show.units import count_text
from studies.space.table import CaseTable
from studies.study.labels import remedy

T = TypeVar("T")

PHASES = ("screen", "margins", "report")


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


class ScreenOutcome(NamedTuple):
    """How a screen ended."""

    screen: ScreenRequest
    is_done: np.ndarray  # by shard
    tally: Tally
    lost: dict[int, str]  # shards that were given up, and why
    is_interrupted: bool  # by Ctrl-C
    selection: Selection | None  # of the candidates; None: interrupted, or there are none
    uncontrolled: float | None  # the metric without control; None: not known
    agreement: Agreement | None = None  # of linear and full model; None: not of the linear one

    @property
    def n_kept(self) -> int:
        """Number of cases of `best.toml`."""
        return 0 if self.selection is None else int(self.selection.is_kept.sum())


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
        ScreenOutcome; `best.toml` is there unless the run was interrupted or nothing is kept.

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
        agreed = _agreement(screen)
        progress = ScreenProgress(phases, screen.n_designs, tally.n_designs)
        for shard, answer in screener.tallies(ShardWork(screen, left, progress, stop)):
            if isinstance(answer, str):
                lost[shard] = answer
                phases.say(f"shard {shard} is left out: {answer}")
                continue
            if not is_done.any() and (advice := all_failed(answer)):
                phases.say(f"none of the first designs ended well: {advice}")
            tally = merged(tally, answer, *screen.ranking)
            is_done[shard] = True
            write_tally(out, screen, is_done, tally)
        selection, without = None, None
        if not stop.is_set() and len(tally.row):
            selection = _selected(screen, tally, stop, phases)
        is_interrupted = stop.is_set() and selection is None
        if selection is not None:
            without = uncontrolled(screen, selection.table)
            write_best(out, screen, selection.kept)
    return ScreenOutcome(
        screen=screen,
        is_done=is_done,
        tally=tally,
        lost=lost,
        is_interrupted=is_interrupted,
        selection=selection,
        uncontrolled=without,
        agreement=agreed,
    )


def _agreement(screen: ScreenRequest) -> Agreement | None:
    """Whether the linear model ranks designs of the screen as the full one does.

    Raises:
        StudyError: it does not.
    """
    if screen.spec.sweep.fidelity != "linear":
        return None
    rng, n = np.random.default_rng(screen.spec.sweep.seed), screen.n_designs
    rows = rng.permutation(n) if n < 100 * TRIED else np.unique(rng.integers(0, n, 2 * TRIED))
    table = designs_table(screen, np.sort(rows[: 2 * TRIED]))
    found = agreement(screen.spec, table, screen.by)
    if found is not None:
        found.check("Rank by another metric, or screen with --fidelity full.")
    return found


def all_failed(tally: Tally) -> str:
    """Why designs failed, most frequent first, and what helps; "" if any ended well."""
    counts = tally.endings[:LEFT_OUT]
    if counts[status.OK] or not counts.any():
        return ""
    codes = [int(code) for code in np.argsort(-counts, kind="stable") if counts[code]]
    reasons = [f"{counts[code]:,} {status.REASONS[code]}" for code in codes]
    return "; ".join(reasons + [advice for advice in map(remedy, codes[:1]) if advice])


def _selected(
    screen: ScreenRequest, tally: Tally, stop: threading.Event, phases: Phases
) -> Selection | None:
    phases.begin("margins", f"of {count_text(len(tally.row), 'candidate')}, best first")
    wanted = f", {{:,}} with a gain margin of at least {screen.margin:g}" if screen.margin else ""
    began = time.perf_counter()

    def tell(n_judged: int, n_kept: int, total: int) -> None:
        needed = min(total, n_judged * screen.keep / max(n_kept, 1))
        rest = (time.perf_counter() - began) * max(needed / n_judged - 1, 0)
        text = f"{n_judged:,} of {total:,} judged{wanted.format(n_kept)}"
        phases.advance(n_judged, total, text, f"about {duration_text(rest)}")

    return select(screen, tally, stop, tell)
