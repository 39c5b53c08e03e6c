"""Where control of one link begins to calm the others: on samples of machines, and on maps."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

#: Machines next to each other in coupling ratio from which a quantile is taken, as a share.
WINDOW = 0.05
#: Share of machines for which the ends of an interval speak [1].
CONFIDENCE = 0.95
QUANTILES = (CONFIDENCE, 0.5, 1 - CONFIDENCE)
#: Samples drawn from the sample for the standard error of a threshold.
RESAMPLED = 40


class Threshold(NamedTuple):
    """Coupling ratios at which a reduction is reached [1]; NaN: not within the sample."""

    reduction: float  # [1]
    low: float  # below it, CONFIDENCE of all machines stay below the reduction
    middle: float  # half of them
    high: float  # above it, CONFIDENCE of them exceed it
    error: float  # standard error of `middle`, by resampling; NaN: half of the samples lack it


def threshold(ratio: np.ndarray, reduction: np.ndarray, level: float) -> Threshold:
    """Coupling ratios at which `CONFIDENCE`, half and all but it of the machines reach a level.

    Args:
        ratio: coupling ratios [1], (n,).
        reduction: of the others' vibration [1], (n,); NaN is left out.
        level: of the reduction [1].
    """
    is_known = np.isfinite(reduction)
    ratio, reduction = ratio[is_known], reduction[is_known]
    low, middle, high = (_crossing(ratio, reduction, level, q) for q in QUANTILES)
    rng = np.random.default_rng(0)
    again = [
        _crossing(ratio[rows], reduction[rows], level, 0.5)
        for rows in rng.integers(len(ratio), size=(RESAMPLED, len(ratio)))
    ]
    known = np.array(again)[np.isfinite(again)]
    error = float(np.std(known)) if 2 * known.size >= RESAMPLED else np.nan
    return Threshold(reduction=level, low=low, middle=middle, high=high, error=error)


def moving_quantile(
    ratio: np.ndarray, reduction: np.ndarray, quantile: float
) -> tuple[np.ndarray, np.ndarray]:
    """Coupling ratios in ascending order, and a quantile of the reduction there, (m,) each."""
    order = np.argsort(ratio)
    size = max(int(WINDOW * len(ratio)), 9)
    windows = np.lib.stride_tricks.sliding_window_view(reduction[order], size)
    middle = np.lib.stride_tricks.sliding_window_view(ratio[order], size)
    return np.median(middle, axis=1), np.quantile(windows, quantile, axis=1)


def _crossing(ratio: np.ndarray, reduction: np.ndarray, level: float, quantile: float) -> float:
    """Where a moving quantile passes a level: the upper ones for the first time, others for good.

    So below the low end of an interval no machines of any ratio exceed the level more often.
    """
    at, curve = moving_quantile(ratio, reduction, quantile)
    is_below = curve < level
    if is_below.all() or not is_below.any():
        return np.nan
    if quantile > 0.5:
        return float(at[np.argmin(is_below)])
    last = int(np.flatnonzero(is_below)[-1])
    return float(at[last]) if last + 1 < len(at) else np.nan


#: Structural damping ratios between which `greatest_damping` looks, and its halvings.
DAMPING, HALVINGS = (3e-4, 0.3), 10


def greatest_damping(
    reduction: Callable[[np.ndarray], np.ndarray], level: float, count: int
) -> np.ndarray:
    """Structural damping ratio below which machines reach a level, by bisection [1], (n,).

    Args:
        reduction: of all machines at given damping ratios, (n,) to (n,).
        level: of the reduction [1].
        count: of machines, n.

    Returns:
        0 where the least damping of `DAMPING` does not do, the largest where any does, NaN where
        the machine has no reduction.
    """
    low, high = (np.full(count, np.log(x)) for x in DAMPING)
    at_low, at_high = (reduction(np.exp(x)) for x in (low, high))
    never, always = at_low < level, at_high >= level
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        is_reached = reduction(np.exp(middle)) >= level
        low, high = np.where(is_reached, middle, low), np.where(is_reached, high, middle)
    found = np.where(never, 0.0, np.where(always, DAMPING[1], np.exp((low + high) / 2)))
    return np.where(np.isfinite(at_low), found, np.nan)
