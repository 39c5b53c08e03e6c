"""Rerunning a few cases for a page: what their links do, and how the machine moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from studies.engine.front import pareto_front
from studies.engine.run_data import chord_deflection
from studies.engine.runs import Run, run_study, uncontrolled_twin
from studies.errors import StudyError
from studies.show.skeleton import skeleton
from studies.study.spec import Study

#: Cases rerun for a page at most.
MOST_REPLAYS = 24
#: Points of a response, and instants of a moving machine.
N_POINTS, N_FRAMES = 900, 90
#: Largest drawn deflection, as a share of the shortest link.
DRAWN = 0.08
#: Factor on bending at most: what it does not make visible, such as rounding, is not drawn [1].
MOST_EXAGGERATED = 1e6
#: Points drawn along a link, of those of a skeleton.
EVERY = 4
#: Of the time after the reference trajectory, what a moving machine shows [s].
AFTER = 0.05


class DrawnMotion(NamedTuple):
    """A run in pictures; lengths in mm."""

    deflection: np.ndarray  # of mid-spans [um], (T, n)
    carrier: np.ndarray  # ends of what carries the links, (K, n, 2, 2)
    near: np.ndarray  # joints of the links with it, (K, n, 2)
    joint: np.ndarray  # and with the platform, (K, n, 2)
    link: np.ndarray  # points along the links, bent as drawn, (K, n, points, 2)


class ReplayedCase(NamedTuple):
    """A case with full trajectories, and the same without control."""

    row: int  # of the table
    time: np.ndarray  # of the deflections, from the end of the reference trajectory [ms], (T,)
    frame_time: np.ndarray  # [ms], (K,)
    exaggeration: float  # of the bending drawn [1]; 0: none that could be seen
    frame: np.ndarray  # left, right, low, high of what is drawn [mm], (4,)
    motions: tuple[DrawnMotion, ...]  # as given and, if its links are controlled, without control


def replayed(
    rows: Sequence[int],
    study_of: Callable[[int], Study],
    on_progress: Callable[[int, int], None],
) -> tuple[ReplayedCase, ...]:
    """Rerun some cases; those whose study cannot run alone are left out.

    Args:
        rows: of the table.
        study_of: a row's study; StudyError: it has none.
        on_progress: called with the number of cases done, and of all.
    """
    done = []
    for count, row in enumerate(rows, 1):
        try:
            run = run_study(study_of(int(row)), has_loop=False)
            done.append(_in_pictures(int(row), run, uncontrolled_twin(run)))
        except StudyError:
            pass
        on_progress(count, len(rows))
    return tuple(done)


def _in_pictures(row: int, run: Run, twin: Run | None) -> ReplayedCase:
    record = run.result.record
    assert record is not None
    time, end = np.asarray(record.time), float(run.result.command_end)
    runs = [run] if twin is None else [run, twin]
    bent = [chord_deflection(x) for x in runs]
    peak = max(float(np.nanmax(np.abs(x), initial=0)) for x in bent)
    factor = exaggeration(peak, run.study.each_link(run.study.link.length).min())
    points = _spread(0, len(time), N_POINTS)
    last = min(end + AFTER, time[-1])
    frames = _spread(0, int(np.searchsorted(time, last)), N_FRAMES)
    motions = []
    for one, deflection in zip(runs, bent, strict=True):
        trajectory = one.result.record
        assert trajectory is not None
        pose, modal = (x[frames] for x in (trajectory.pose, trajectory.modal_coordinate))
        parts = skeleton(run.study, pose, modal, factor)
        motions.append(
            DrawnMotion(
                deflection=1e6 * deflection[points],
                carrier=1e3 * parts.carrier,
                near=1e3 * parts.near,
                joint=1e3 * parts.joint,
                link=1e3 * parts.link[:, :, ::EVERY],
            )
        )
    return ReplayedCase(
        row=row,
        time=1e3 * (time[points] - end),
        frame_time=1e3 * (time[frames] - end),
        exaggeration=factor,
        frame=_extent(motions),
        motions=tuple(motions),
    )


def _extent(motions: list[DrawnMotion]) -> np.ndarray:
    parts = [x.reshape(-1, 2) for one in motions for x in (one.carrier, one.joint)]
    points = np.concatenate(parts)
    return np.stack([points.min(axis=0), points.max(axis=0)], axis=1).ravel()


def exaggeration(peak: float, length: float) -> float:
    """By how much to exaggerate bending of some peak [m] on a link [m]; 0 if it is too small."""
    seen = DRAWN * length
    return float(f"{seen / peak:.1g}") if peak * MOST_EXAGGERATED > seen else 0.0


def _spread(first: int, last: int, most: int) -> np.ndarray:
    """Indices from `first` to before `last`, at most so many."""
    return np.unique(np.linspace(first, max(last - 1, first), most).astype(int))


def rows_to_replay(order: np.ndarray, figures: np.ndarray, most: int = MOST_REPLAYS) -> list[int]:
    """Rows whose motion says most: the best under any limits on some figures, and a spread.

    The best row that keeps limits on figures is never dominated in all of them, so that it is on
    their Pareto front, whatever the limits are.

    Args:
        order: rows, the best first, (n,).
        figures: of all rows, the smaller the better, of which the first orders them, (n, k).
        most: how many.
    """
    if not len(order):
        return []
    front = order[pareto_front(figures[order])]
    if len(front) > most - most // 4:
        front = front[_spread(0, len(front), most - most // 4)]
    others = order[_spread(0, len(order), most - len(front))]
    return list(dict.fromkeys([*front.tolist(), *others.tolist()]))[:most]
