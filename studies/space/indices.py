"""Sensitivity analysis: elementary effects (Morris) and Sobol indices.

Failed cases have no metric. What cannot be computed without them is left out and counted, never
taken as zero; if too much is missing, the analysis is refused.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.errors import StudyError

#: Refuse if less than this share of the design is left [1].
LEAST_LEFT = 0.5
#: Number of resamplings for the intervals.
N_BOOTSTRAP = 500
#: The intervals contain this share of the resampled values [1].
CONFIDENCE = 0.95


class Effects(NamedTuple):
    """Elementary effects on the unit cube, per factor, (d,)."""

    mean_size: np.ndarray  # mu*, mean |effect| [metric]
    mean: np.ndarray  # mu
    deviation: np.ndarray  # sigma: nonlinearity and interactions
    n_used: np.ndarray  # effects that could be computed
    n_left_out: int  # effects lost to failed cases


class Indices(NamedTuple):
    """Sobol indices with bootstrap intervals, per factor."""

    first: np.ndarray  # S_i [1], (d,)
    first_interval: np.ndarray  # (d, 2)
    total: np.ndarray  # S_Ti [1], (d,)
    total_interval: np.ndarray  # (d, 2)
    n_used: int  # base points
    n_left_out: int  # base points with a failed case


def elementary_effects(points: np.ndarray, value: np.ndarray) -> Effects:
    """Morris' elementary effects from trajectories; Morris 1991, Campolongo et al. 2007.

    Args:
        points: trajectories of d + 1 points each, on the unit cube, (r (d + 1), d).
        value: metric at the points, NaN where the case failed, (r (d + 1),).

    Raises:
        StudyError: less than half of the effects of a factor are left.
    """
    d = points.shape[1]
    x, y = points.reshape(-1, d + 1, d), value.reshape(-1, d + 1)
    step, change = np.diff(x, axis=1), np.diff(y, axis=1)
    moved = np.argmax(np.abs(step), axis=2)
    effect = change / np.take_along_axis(step, moved[..., None], axis=2)[..., 0]
    is_there = np.isfinite(effect)
    groups = [effect[(moved == i) & is_there] for i in range(d)]
    count = np.array([len(group) for group in groups])
    if np.any(count < max(LEAST_LEFT * len(x), 2)):
        worst = int(np.argmin(count))
        raise StudyError(
            f"sensitivity: only {count[worst]} of {len(x)} effects of factor {worst} are left "
            f"after failed cases; allowed: at least {max(LEAST_LEFT * len(x), 2):.0f}. Narrow the "
            "axes, or use more trajectories"
        )
    return Effects(
        mean_size=np.array([np.abs(group).mean() for group in groups]),
        mean=np.array([group.mean() for group in groups]),
        deviation=np.array([group.std(ddof=1) for group in groups]),
        n_used=count,
        n_left_out=int((~is_there).sum()),
    )


def sobol_indices(value: np.ndarray, dimensions: int, seed: int = 0) -> Indices:
    """First-order and total indices from a design of `saltelli_points`.

    First: Saltelli et al. 2010, mean f_B (f_ABi - f_A)/V; total: Jansen 1999,
    mean (f_A - f_ABi)^2/(2 V). V is the variance of f_A and f_B together. Intervals: bootstrap over
    base points.

    Args:
        value: metric at the design's rows, NaN where the case failed, (n (d + 2),).
        dimensions: d.
        seed: of the bootstrap.

    Raises:
        StudyError: less than half of the base points are left, or the metric does not vary.
    """
    rows = value.reshape(-1, dimensions + 2)
    is_whole = np.all(np.isfinite(rows), axis=1)
    used = rows[is_whole]
    if len(used) < max(LEAST_LEFT * len(rows), 4):
        raise StudyError(
            f"sensitivity: only {len(used)} of {len(rows)} base points have no failed case; "
            f"allowed: at least {max(LEAST_LEFT * len(rows), 4):.0f}. Narrow the axes"
        )
    if np.ptp(used) == 0:
        raise StudyError("sensitivity: the metric is the same in every case")
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(used), (N_BOOTSTRAP, len(used)))
    resampled = np.array([_indices(used[pick]) for pick in picks])
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.nanpercentile(resampled, (tail, 100 - tail), axis=0)
    first, total = _indices(used)
    return Indices(
        first=first,
        first_interval=np.stack([low[0], high[0]], axis=1),
        total=total,
        total_interval=np.stack([low[1], high[1]], axis=1),
        n_used=len(used),
        n_left_out=len(rows) - len(used),
    )


def _indices(rows: np.ndarray) -> np.ndarray:
    """First and total indices, (2, d)."""
    # subtracting the mean reduces noise in the first-order estimate
    rows = rows - rows[:, :2].mean()
    a, b, mixed = rows[:, :1], rows[:, 1:2], rows[:, 2:]
    variance = rows[:, :2].var()
    if variance == 0:
        return np.full((2, mixed.shape[1]), np.nan)
    first = np.mean(b * (mixed - a), axis=0) / variance
    total = np.mean((a - mixed) ** 2, axis=0) / (2 * variance)
    return np.array([first, total])
