"""Zero exclusion over a box: cells in which the return difference may vanish are halved.

Along the coordinate that moves it most, until none is left, cells are as small as they may be, or
the work is used up. What is left is undecided, and said to be so.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel.discs import Disc, excludes_zero
from jaxmodel.zero_exclusion import COORDINATES, Exclusion, return_difference

#: Cells evaluated at once: what fits a processor's cache is fastest.
CHUNK = 256


class Cells(NamedTuple):
    """Corners of cells, see `zero_exclusion.COORDINATES`, (cells, 5) each."""

    low: np.ndarray
    high: np.ndarray


class Search(NamedTuple):
    """What a branch and bound leaves."""

    undecided: Cells
    evaluated: int  # cells


def exclude_zeros(
    setup: Exclusion,
    cells: Cells,
    smallest: np.ndarray,
    most: int,
    is_over: Callable[[], bool] = lambda: False,
    stops_at_first: bool = False,
) -> Search:
    """Prove that F is singular nowhere on the cells, or say where it is undecided.

    Args:
        setup: from `prepare_exclusion`, whose box contains the cells.
        cells: the box, covered by cells.
        smallest: widths that are not halved, (5,).
        most: cells to evaluate at most.
        is_over: whether to stop, asked between chunks.
        stops_at_first: give up with the first cell that is as small as it may be.
    """
    stack: list[Cells] = [cells]
    left: list[Cells] = []
    evaluated = 0
    while stack:
        if evaluated >= most or is_over():
            return Search(_joined(stack + left, cells), evaluated)
        now = stack.pop()
        if len(now.low) > CHUNK:
            stack.append(Cells(now.low[CHUNK:], now.high[CHUNK:]))
            now = Cells(now.low[:CHUNK], now.high[:CHUNK])
        is_open, along = _judge(setup, now, smallest)
        evaluated += len(now.low)
        if not is_open.any():
            continue
        still = Cells(now.low[is_open], now.high[is_open])
        along = along[is_open]
        is_final = along < 0
        if is_final.any():
            left.append(Cells(still.low[is_final], still.high[is_final]))
            if stops_at_first:
                return Search(_joined(left, cells), evaluated)
        if not is_final.all():
            halves = _halved(Cells(still.low[~is_final], still.high[~is_final]), along[~is_final])
            # small leftovers are joined, so that chunks stay full
            if stack and len(stack[-1].low) < CHUNK:
                halves = _joined([stack.pop(), halves], cells)
            stack.append(halves)
    return Search(_joined(left, cells), evaluated)


def _judge(setup: Exclusion, cells: Cells, smallest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which cells are undecided, and along which coordinate to halve them; -1: none."""
    value = return_difference(setup, *cells)
    inverse = _inverse(value.mid)
    # half the sample rate is at another nu for every stiffness
    nyquist = np.pi / float(setup.loop.period)
    is_within = cells.low[:, 0] * np.sqrt(cells.low[:, 1]) <= nyquist
    is_open = ~(excludes_zero(value, inverse) < 1) & is_within
    along = np.full(len(is_open), -1)
    at = np.flatnonzero(is_open)
    if not len(at):
        return is_open, along
    low, high = cells.low[at], cells.high[at]
    middle, best = (low + high) / 2, np.full(len(at), -1.0)
    for k in range(len(COORDINATES)):
        can_halve = high[:, k] - low[:, k] > smallest[k]
        if not can_halve.any():
            continue
        thin = [middle.copy(), middle.copy()]
        thin[0][:, k], thin[1][:, k] = low[:, k], high[:, k]
        moved = return_difference(setup, *thin)
        score = excludes_zero(Disc(moved.mid, moved.rad), inverse[at])
        score = np.where(can_halve, np.where(np.isfinite(score), score, 1e300), -1.0)
        along[at] = np.where(score > best, k, along[at])
        best = np.maximum(best, score)
    return is_open, along


def _inverse(matrix: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.inv(matrix)
    except np.linalg.LinAlgError:  # one of them is exactly singular
        return np.linalg.inv(matrix + 1e-13 * np.eye(matrix.shape[-1]))


def _halved(cells: Cells, along: np.ndarray) -> Cells:
    rows = np.arange(len(along))
    middle = (cells.low[rows, along] + cells.high[rows, along]) / 2
    upper, lower = cells.low.copy(), cells.high.copy()
    upper[rows, along], lower[rows, along] = middle, middle
    return Cells(np.concatenate([cells.low, upper]), np.concatenate([lower, cells.high]))


def _joined(parts: list[Cells], like: Cells) -> Cells:
    none = like.low[:0]
    return Cells(
        np.concatenate([none, *(part.low for part in parts)]),
        np.concatenate([none, *(part.high for part in parts)]),
    )


def start_cells(setup: Exclusion, ranges: np.ndarray, count: int) -> Cells:
    """A box as cells: the whole circle in slices of nu, everything else whole.

    Args:
        setup: from `prepare_exclusion`.
        ranges: low and high of stiffness, delay, payload and gain, (4, 2).
        count: slices.
    """
    edge = np.linspace(0, np.pi / float(setup.loop.period) / np.sqrt(ranges[0, 0]), count + 1)
    low, high = (np.tile(ranges[:, k], (count, 1)) for k in (0, 1))
    return Cells(np.column_stack([edge[:-1], low]), np.column_stack([edge[1:], high]))
