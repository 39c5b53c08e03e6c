"""Which controllers are better than others on machines they were not tuned on, and which are not.

A figure is compared machine by machine: the logarithm of its ratio to the best controller's, mean
over the moves. Machines are resampled (bootstrap, Efron and Tibshirani 1993), so that an interval
says what another set of machines could have shown. Two controllers whose interval includes 1 are
tied.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Resamples of the machines, and the two-sided interval that is reported.
RESAMPLES, CONFIDENCE = 2000, 0.95


def geometric_mean(figure: np.ndarray) -> float:
    """Of the finite values of a positive figure, nan if there are none."""
    finite = figure[np.isfinite(figure)]
    smallest = np.finfo(float).tiny
    return float(np.exp(np.log(np.maximum(finite, smallest)).mean())) if finite.size else np.nan


class Ranking(NamedTuple):
    """N controllers by one figure, of which less is better; NaN where a run did not finish."""

    ratio: np.ndarray  # geometric mean over machines and moves, over the best one's [1], (N,)
    low: np.ndarray  # its interval [1], (N,)
    high: np.ndarray  # (N,)
    share: np.ndarray  # of the resamples in which a controller is the best [1], (N,)

    @property
    def best(self) -> int:
        """The controller with the least figure; -1: none finished all runs."""
        return int(np.nanargmin(self.ratio)) if np.isfinite(self.ratio).any() else -1

    @property
    def is_tied(self) -> np.ndarray:
        """Controllers that another set of machines could have put first, (N,)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.low <= 1.0)

    @property
    def order(self) -> np.ndarray:
        """Best first; those that did not finish all runs last, (N,)."""
        return np.argsort(self.ratio, kind="stable")


def rank(figure: np.ndarray, seed: int = 0) -> Ranking:
    """Rank controllers by a positive figure.

    Args:
        figure: of each controller on each machine in each move; NaN: not finished,
            (N, machines, moves).
        seed: of the resamples.

    Returns:
        Ranking; NaN for controllers with a NaN anywhere.

    Example:
        >>> rank(np.array([[[1.0], [1.1]], [[2.0], [2.2]]])).ratio.round(3).tolist()
        [1.0, 2.0]
    """
    smallest = np.finfo(float).tiny
    with np.errstate(invalid="ignore"):
        size = np.log(np.maximum(figure, smallest)).mean(axis=2)  # (N, machines)
    is_whole = np.isfinite(size).all(axis=1)
    nothing = np.full(len(figure), np.nan)
    if not is_whole.any():
        return Ranking(nothing, nothing.copy(), nothing.copy(), np.zeros(len(figure)))
    best = int(np.argmin(np.where(is_whole, size.mean(axis=1), np.inf)))
    machines = size.shape[1]
    drawn = np.random.default_rng(seed).integers(machines, size=(RESAMPLES, machines))
    means = size[:, drawn].mean(axis=2)  # (N, RESAMPLES)
    first = np.argmin(np.where(is_whole[:, None], means, np.inf), axis=0)
    apart = means - means[best]
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(np.where(is_whole[:, None], apart, 0.0), [tail, 100 - tail], axis=1)

    def of_whole(x: np.ndarray) -> np.ndarray:
        return np.where(is_whole, np.exp(x), np.nan)

    return Ranking(
        of_whole(np.where(is_whole, size.mean(axis=1) - size[best].mean(), np.nan)),
        of_whole(low),
        of_whole(high),
        np.bincount(first, minlength=len(figure)) / RESAMPLES,
    )
