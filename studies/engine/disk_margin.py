"""Disk margins of loops in a few milliseconds, in NumPy.

1/max over frequency of the least norm of D (S - I/2) D^-1, as in `jaxmodel.robustness`, where it is
explained and differentiated. Frequencies are ranked with D that balances rows against columns
(Osborne 1960), which overestimates the least norm by some percent; the maxima that can be the
largest are optimised in turn over D and frequency. Each value is an upper bound at its frequency,
so errors of D make the margin smaller, never larger.
"""

from __future__ import annotations

import numpy as np

from jaxmodel.robustness import MarginPlace
from studies.engine.diagonal_scaling import balanced, best_scaling, largest_singular
from studies.engine.loop_gain import LoopGains
from studies.engine.margin_grid import GridGain, excess

#: Rounds over D and frequency of a fine search.
FINE = 4
#: Where L vanishes.
LARGEST = 2.0
#: Local maxima that are followed, and points of a zoom.
FOLLOWED, POINTS = 5, 7


def disk_margins(loops: LoopGains, grid: GridGain, is_fine: bool = False) -> MarginPlace:
    """alpha [1], 0 to 2, of stable loops, and where, (n,) each.

    Args:
        loops: of the responses.
        grid: their gains.
        is_fine: to 1e-9 of the value at the frequency found, for derivatives; otherwise 1e-4.
    """
    n, m = len(grid.omega), grid.gain.shape[-1]
    value = np.full(grid.omega.shape, 0.5)
    for k, rows in enumerate(grid.matters):  # each in a processor's cache
        value[k, rows] = largest_singular(balanced(excess(grid.gain[k, rows])))
    # where L vanishes
    best, place = np.full(n, 0.5), grid.omega[:, 0].copy()
    owner = np.repeat(np.arange(n), FOLLOWED)
    wide = _local_maxima(grid.omega, value).reshape(-1, 3)
    bracket, top = _zoomed(loops.part(owner), wide, np.empty((0, m, m)))
    bracket, top = bracket.reshape(n, FOLLOWED, 3), top.reshape(n, FOLLOWED)
    order = np.argsort(-top, axis=1)
    for turn in range(FOLLOWED):
        rows = np.flatnonzero(top[np.arange(n), order[:, turn]] > best)
        if len(rows):
            found, where = _peaks(loops.part(rows), bracket[rows, order[rows, turn]], is_fine)
            is_more = found > best[rows]
            best[rows[is_more]], place[rows[is_more]] = found[is_more], where[is_more]
    return MarginPlace(np.minimum(1 / best, LARGEST), place, np.ones(n))


def _peaks(loops: LoopGains, bracket: np.ndarray, is_fine: bool) -> tuple[np.ndarray, np.ndarray]:
    """Largest least norm near a local maximum of each loop, and where, (n,) each.

    By turns over D and frequency.
    """
    log = best_scaling(excess(loops.exact(bracket[:, 1:2])[:, 0]))[1]
    for _ in range(FINE if is_fine else 1):
        scale = np.exp(log[:, :, None] - log[:, None])
        for _ in range(2):
            bracket, _ = _zoomed(loops, bracket, scale, is_fine)
        found, log = best_scaling(excess(loops.exact(bracket[:, 1:2])[:, 0]))
    return found, bracket[:, 1]


def _local_maxima(omega: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Frequencies of the largest local maxima with their neighbours, (n, `FOLLOWED`, 3)."""
    beyond = np.pad(value, ((0, 0), (1, 1)), constant_values=-np.inf)
    is_top = (value >= beyond[:, :-2]) & (value > beyond[:, 2:])
    places = np.argsort(np.where(is_top, -value, 0.0), axis=1)[:, :FOLLOWED, None]
    places = np.clip(places + np.array([-1, 0, 1]), 0, omega.shape[1] - 1)
    return np.take_along_axis(omega[:, None], places, axis=2)


def _zoomed(
    loops: LoopGains, bracket: np.ndarray, scale: np.ndarray, is_exact: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Narrower brackets of maxima, (k, 3), and the largest values seen, (k,).

    The middle is the vertex of a parabola through the three highest points.

    Args:
        loops: k of them.
        bracket: left, middle, right [rad/s], (k, 3).
        scale: D_i/D_j, (k, m, m); empty: balanced.
        is_exact: with all images.
    """
    share = np.linspace(0, 1, POINTS // 2 + 1)[:-1]
    low, middle, high = (bracket[:, k, None] for k in range(3))
    omega = np.concatenate(
        [low + share * (middle - low), middle, high - share[::-1] * (high - middle)], axis=1
    )
    matrix = excess(loops.exact(omega) if is_exact else loops.searched(omega))
    if len(scale):
        matrix = matrix * scale[:, None]
    matrix = matrix.reshape(-1, *matrix.shape[2:])
    if not len(scale):
        matrix = balanced(matrix)
    value = largest_singular(matrix).reshape(omega.shape)
    best = np.clip(value.argmax(axis=1), 1, omega.shape[1] - 2)[:, None] + np.array([-1, 0, 1])
    x, y = (np.take_along_axis(array, best, axis=1) for array in (omega, value))
    left, right = x[:, 1] - x[:, 0], x[:, 2] - x[:, 1]
    rise, fall = y[:, 1] - y[:, 0], y[:, 1] - y[:, 2]
    bend = rise * right + fall * left
    is_round = (rise >= 0) & (fall >= 0) & (bend > 0)
    shift = (rise * right**2 - fall * left**2) / np.where(is_round, 2 * bend, 1.0)
    top = x[np.arange(len(x)), y.argmax(axis=1)]
    x[:, 1] = np.where(is_round, x[:, 1] + shift, top)
    return x, value.max(axis=1)
