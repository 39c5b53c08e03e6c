"""Runs the shards of a screen that are left, here or on workers, keeps the tally, and chooses."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel import status
from studies.engine.fidelity import Agreement, agreement
from studies.errors import StudyError
from studies.job import Job
from studies.phases import interrupts
from studies.screen.local import Answers, ScreenProgress, ShardWork
from studies.screen.selection import Selection, select
from studies.screen.shards import ScreenRequest
from studies.screen.stored import begin, write_tally
from studies.screen.tally import LEFT_OUT, Tally, merged
from studies.show.units import count_text
from studies.study.labels import remedy
from studies.study.margin import margin_text

PHASES = ("screen", "margins")


class ScreenOutcome(NamedTuple):
    """How a screen ended."""

    screen: ScreenRequest
    is_done: np.ndarray  # by shard
    tally: Tally
    lost: dict[int, str]  # shards that were given up, and why
    agreement: Agreement | None  # of linear and full model; None: not of the linear one
    selection: Selection | None = None  # of the candidates; None: not chosen, or there are none

    @property
    def n_kept(self) -> int:
        """Number of designs that are chosen."""
        return len(chosen(self).kept_value)


def chosen(done: ScreenOutcome) -> Selection:
    """The candidates that were judged, once that was not interrupted."""
    assert done.selection is not None
    return done.selection


def run_screen(
    screen: ScreenRequest, job: Job, tallies: Callable[[ShardWork], Answers]
) -> ScreenOutcome:
    """Run what is left of a screen.

    Args:
        screen: from `screen_of`.
        job: with `PHASES`.
        tallies: runs shards, here or on workers.

    Returns:
        ScreenOutcome; nothing is chosen yet.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished shards stay.
        KeyboardInterrupt: the same.
    """
    lost: dict[int, str] = {}
    is_done, tally = begin(job.place, screen)
    left = np.flatnonzero(~is_done).tolist()
    shards = count_text(screen.n_shards, "shard")
    job.begin("screen", f"{screen.n_designs:,} designs in {shards}", tally.n_designs)
    agreed = _agreement(screen)
    progress = ScreenProgress(job.phases, screen.n_designs, tally.n_designs)
    with interrupts() as stop:
        for shard, answer in tallies(ShardWork(screen, left, progress, stop)):
            if isinstance(answer, str):
                lost[shard] = answer
                job.say(f"shard {shard} is left out: {answer}")
                continue
            if not is_done.any() and (advice := all_failed(answer)):
                job.say(f"none of the first designs ended well: {advice}")
            tally = merged(tally, answer, *screen.ranking)
            is_done[shard] = True
            write_tally(job.place, screen, is_done, tally)
    if stop.is_set():
        raise KeyboardInterrupt(f"{tally.n_designs:,} of {screen.n_designs:,} designs are safe")
    return ScreenOutcome(screen=screen, is_done=is_done, tally=tally, lost=lost, agreement=agreed)


def _agreement(screen: ScreenRequest) -> Agreement | None:
    """Whether the linear model ranks designs of the screen as the full one does.

    Raises:
        StudyError: it does not.
    """
    if not screen.is_linear:
        return None
    found = agreement(screen.spec, screen.some, screen.spec.sweep.by)
    if found is not None:
        found.check('Rank by another metric, or find the best with fidelity = "full".')
    return found


def all_failed(tally: Tally) -> str:
    """Why designs failed, most frequent first, and what helps; "" if any ended well."""
    counts = tally.endings[:LEFT_OUT]
    if counts[status.OK] or not counts.any():
        return ""
    codes = [int(code) for code in np.argsort(-counts, kind="stable") if counts[code]]
    reasons = [f"{counts[code]:,} {status.REASONS[code]}" for code in codes]
    return "; ".join(reasons + [advice for advice in map(remedy, codes[:1]) if advice])


def choose(found: ScreenOutcome, count: int, job: Job) -> ScreenOutcome:
    """With the best `count` candidates that have the margin asked for, if so many have it.

    Raises:
        StudyError: none has it, or there are no candidates.
    """
    tally, screen, least = found.tally, found.screen, found.screen.spec.sweep.margin
    if not len(tally.row):
        n_ok = tally.endings[status.OK]
        why = all_failed(tally) or f"{n_ok:,} are ok, but have no finite {screen.entry}"
        raise StudyError(f"sweep.keep: none of {tally.n_designs:,} designs to keep: {why}")
    job.begin("margins", f"of {count_text(len(tally.row), 'candidate')}, best first")
    selection = select(screen, tally, count, job)
    if not selection.is_kept.any():
        largest = margin_text(np.nanmax(selection.margin, initial=0.0))
        raise StudyError(
            f"sweep.margin = {least:g}: none of {len(selection.margin):,} candidates has it "
            f"(largest: {largest}); ask for less with --resume: no design runs again; or narrow "
            "the axes"
        )
    return found._replace(selection=selection)
