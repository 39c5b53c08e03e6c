"""Pareto fronts: what no other case beats in some figure without losing in another."""

from __future__ import annotations

import numpy as np


def pareto_front(figures: np.ndarray) -> np.ndarray:
    """Rows of a Pareto front, the best in the first figure first; of equal rows one.

    Args:
        figures: the smaller the better; NaN, what is not known, is worst, (n, k).
    """
    figures = np.where(np.isnan(figures), np.inf, figures)
    rest = np.lexsort(figures.T[::-1])
    front = []
    while len(rest):  # what comes first beats what it leaves no figure to be better in
        best, rest = rest[0], rest[1:]
        front.append(best)
        rest = rest[np.any(figures[rest] < figures[best], axis=1)]
    return np.array(front, int)
