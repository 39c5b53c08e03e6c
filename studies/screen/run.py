"""`studies screen`: runs the shards that are left, here or on workers, and keeps the tally."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from jaxmodel import status
from studies import config
from studies.cluster.connect import Place, on_workers
from studies.engine.fidelity import TRIED, Agreement, agreement
from studies.engine.folder import locked_folder
from studies.engine.progress import Phases, duration_text, interrupts
from studies.screen.local import LocalScreener, Screener, ScreenProgress, ShardWork
from studies.screen.selection import Selection, select, uncontrolled
from studies.screen.shards import ScreenRequest, designs_table
from studies.screen.stored import begin, write_best, write_tally
from studies.screen.tally import LEFT_OUT, Tally, merged
from studies.screen.workers import ClusterScreener
from studies.show.units import count_text
from studies.study.labels import remedy

#: From so many designs on, workers of this machine are worth their start.
LARGE = 10**6

PHASES = ("screen", "margins", "report")


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
    workers: Place = None,
    phases: Phases | None = None,
    screener: Screener | None = None,
) -> ScreenOutcome:
    """Run what is left of a screen into a folder.

    Args:
        screen: from `screen_of`.
        out: its folder; one that was begun is gone on with.
        is_quiet: hide progress.
        workers: as in `run_sweep`.
        phases: of a longer command, with those of `PHASES`, in place of is_quiet.
        screener: of the shards, in place of workers.

    Returns:
        ScreenOutcome; `best.toml` is there unless the run was interrupted or nothing is kept.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished shards stay.
    """
    config.require_configured()
    if phases is None:
        with Phases(Console(highlight=False, markup=False), PHASES, is_quiet) as phases:
            return run_screen(screen, out, False, workers, phases, screener)
    is_large = screen.n_designs >= LARGE
    with on_workers(workers, is_large, phases.say, ClusterScreener, screener) as found:
        return _run_rest(screen, Path(out), found or LocalScreener(), phases)


def _run_rest(
    screen: ScreenRequest, out: Path, screener: Screener, phases: Phases
) -> ScreenOutcome:
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
