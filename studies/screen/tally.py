"""What a screen keeps of its designs: the best ones, endings, and quantiles of the metric.

Tallies merge by addition and by taking the best of both, so that the result depends neither on the
shards nor on their order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from studies.study.fields import Columns

#: Values between two bounds of a sketch count as one: bounds are apart by this factor, so that
#: quantiles are exact within 1 %.
GROWTH = 1.02
#: Values below count as 0, and those above `BUCKETS` factors more as that.
LEAST = 1e-15
#: Of a sketch: up to 1e9.
BUCKETS = 2800
#: Intervals of an axis, each with a sketch of its own.
INTERVALS = 20
#: Ways a design ends: by status code; one more for designs that `where` leaves out.
N_ENDINGS = max(status.REASONS) + 2
LEFT_OUT = N_ENDINGS - 1


class Tally(NamedTuple):
    """Some designs of a screen, reduced."""

    endings: np.ndarray  # number of designs by status code, (N_ENDINGS,)
    row: np.ndarray  # of the best designs, the candidates, best first, (k,)
    value: np.ndarray  # of the metric there, (k,)
    sketch: np.ndarray  # designs by value, in all and by interval of every axis, (s, BUCKETS)

    @property
    def n_designs(self) -> int:
        """All of them."""
        return int(self.endings.sum())


class Axes(NamedTuple):
    """Axes of a screen, and the intervals by which their influence is told."""

    names: tuple[str, ...]
    bounds: tuple[np.ndarray, ...]  # between the intervals, ascending, (intervals - 1,)
    centers: tuple[np.ndarray, ...]  # where the intervals are drawn, (intervals,)
    labels: tuple[np.ndarray, ...]  # of an axis of text, its values, an interval each; else (0,)

    @property
    def n_sketches(self) -> int:
        """One of all designs, and one for every interval of every axis."""
        return 1 + sum(len(bounds) + 1 for bounds in self.bounds)

    def part(self, axis: int) -> slice:
        """Rows of the sketch that belong to an axis."""
        first = 1 + sum(len(bounds) + 1 for bounds in self.bounds[:axis])
        return slice(first, first + len(self.bounds[axis]) + 1)

    def interval(self, axis: int, x: np.ndarray) -> np.ndarray:
        """Which interval values are in, (n,); beyond the last one: texts that are no label."""
        labels = self.labels[axis]
        if not len(labels):
            return np.searchsorted(self.bounds[axis], x, side="right")
        place = np.minimum(np.searchsorted(labels, x), len(labels) - 1)
        return np.where(labels[place] == x, place, len(labels))


def divided(columns: Columns) -> Axes:
    """Axes of some designs, divided into intervals with about as many of them each.

    Args:
        columns: of every axis, from `axis_columns`.
    """
    bounds, centers, labels = [], [], []
    for x in columns.values():
        distinct = np.unique(x)
        is_text = distinct.dtype.kind == "U"
        labels.append(distinct if is_text else np.zeros(0, str))
        if is_text:
            distinct = np.arange(len(distinct))
        elif len(distinct) > INTERVALS:
            edges = np.unique(np.quantile(x, np.linspace(0, 1, INTERVALS + 1)))
            bounds.append(edges[1:-1])
            centers.append(_between(edges))
            continue
        bounds.append(_between(distinct))
        centers.append(distinct)
    return Axes(tuple(columns), tuple(bounds), tuple(centers), tuple(labels))


def _between(x: np.ndarray) -> np.ndarray:
    return np.asarray((x[1:] + x[:-1]) / 2)


def nothing(axes: Axes, n_left_out: int = 0) -> Tally:
    """The tally of designs of which none has run: those that `where` leaves out."""
    endings = np.zeros(N_ENDINGS, np.int64)
    endings[LEFT_OUT] = n_left_out
    return Tally(
        endings=endings,
        row=np.zeros(0, np.int64),
        value=np.zeros(0),
        sketch=np.zeros((axes.n_sketches, BUCKETS), np.int64),
    )


def tally_of(
    row: np.ndarray,
    code: np.ndarray,
    value: np.ndarray,
    columns: Columns,
    axes: Axes,
    keep: int,
    is_largest: bool,
) -> Tally:
    """Reduce designs that have run.

    Args:
        row: their numbers, (n,).
        code: how they ended, (n,).
        value: what they are ranked by, (n,).
        columns: of every axis, (n,) each.
        axes: of the screen.
        keep: most designs kept.
        is_largest: large values are the best.
    """
    is_fine = (code == status.OK) & np.isfinite(value)
    row, value = row[is_fine], value[is_fine]
    with np.errstate(divide="ignore", invalid="ignore"):
        position = np.log(np.maximum(value, LEAST) / LEAST) / np.log(GROWTH)
    bucket = np.minimum(position.astype(np.int64), BUCKETS - 1)
    sketch = np.zeros((axes.n_sketches, BUCKETS), np.int64)
    sketch[0] = np.bincount(bucket, minlength=BUCKETS)
    for axis, (name, bounds) in enumerate(zip(axes.names, axes.bounds, strict=True)):
        interval = axes.interval(axis, columns[name][is_fine])
        size = (len(bounds) + 1) * BUCKETS
        counts = np.bincount(interval * BUCKETS + bucket, minlength=size)[:size]
        sketch[axes.part(axis)] = counts.reshape(-1, BUCKETS)
    order = _best(row, value, keep, is_largest)
    endings = np.bincount(code, minlength=N_ENDINGS)
    return Tally(endings, row[order], value[order], sketch)


def merged(first: Tally, second: Tally, keep: int, is_largest: bool) -> Tally:
    """The tally of the designs of both."""
    row = np.concatenate([first.row, second.row])
    value = np.concatenate([first.value, second.value])
    order = _best(row, value, keep, is_largest)
    endings, sketch = first.endings + second.endings, first.sketch + second.sketch
    return Tally(endings, row[order], value[order], sketch)


def _best(row: np.ndarray, value: np.ndarray, keep: int, is_largest: bool) -> np.ndarray:
    """Which designs are kept, best first; of equal ones, the earliest."""
    cost = -value if is_largest else value
    chosen = np.arange(len(row))
    if len(row) > keep:
        chosen = np.flatnonzero(cost <= np.partition(cost, keep - 1)[keep - 1])
    return np.asarray(chosen[np.lexsort((row[chosen], cost[chosen]))[:keep]])


def quantile(sketch: np.ndarray, share: float, is_smooth: bool = False) -> float:
    """A quantile of the values in a sketch, exact within 1 %, NaN without any.

    It is 0 below `LEAST` and infinite in the last bucket.

    Args:
        sketch: numbers of values, (BUCKETS,).
        share: of the values that are not above it.
        is_smooth: for curves: go through a bucket evenly, exact within 2 %, without steps.
    """
    total = sketch.sum()
    if not total:
        return float("nan")
    up_to = np.cumsum(sketch)
    bucket = int(np.searchsorted(up_to, share * total, side="left"))
    if bucket == 0:
        return 0.0
    if bucket >= BUCKETS - 1:
        return float("inf")
    part = 1 - (up_to[bucket] - share * total) / sketch[bucket] if is_smooth else 0.5
    return float(LEAST * GROWTH ** (bucket + part))
