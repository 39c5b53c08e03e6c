"""Which parameters matter: elementary effects (Morris), Sobol indices, and causes of failures.

Failed cases have no metric. What cannot be computed without them is left out and counted, never
taken as zero; where too much is missing the analysis refuses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2_contingency, ks_2samp

from jaxmodel import status
from studies.errors import StudyError
from studies.sweeps.axes import build_axis
from studies.sweeps.results import NOT_RUN, SweepData, metric_values, swept_names

#: Refuse where less than this share of the design is left [1].
LEAST_LEFT = 0.5
#: Resamplings of the intervals.
N_BOOTSTRAP = 500
#: The intervals hold this share of the resampled values [1].
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
            f"beside failed cases; allowed at least {max(LEAST_LEFT * len(x), 2):.0f}. Narrow the "
            "axes, or ask for more trajectories"
        )
    return Effects(
        np.array([np.abs(group).mean() for group in groups]),
        np.array([group.mean() for group in groups]),
        np.array([group.std(ddof=1) for group in groups]),
        count,
        int((~is_there).sum()),
    )


def sobol_indices(value: np.ndarray, dimensions: int, seed: int = 0) -> Indices:
    """First and total indices from a design of `saltelli_points`.

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
            f"allowed at least {max(LEAST_LEFT * len(rows), 4):.0f}. Narrow the axes"
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
        first, np.stack([low[0], high[0]], axis=1), total, np.stack([low[1], high[1]], axis=1),
        len(used), len(rows) - len(used),
    )  # fmt: skip


def _indices(rows: np.ndarray) -> np.ndarray:
    """First and total indices, (2, d)."""
    # without its mean the estimate of the first index has less noise
    rows = rows - rows[:, :2].mean()
    a, b, mixed = rows[:, :1], rows[:, 1:2], rows[:, 2:]
    variance = rows[:, :2].var()
    if variance == 0:
        return np.full((2, mixed.shape[1]), np.nan)
    first = np.mean(b * (mixed - a), axis=0) / variance
    total = np.mean((a - mixed) ** 2, axis=0) / (2 * variance)
    return np.array([first, total])


class Cause(NamedTuple):
    """How failures depend on one parameter."""

    name: str
    distance: float  # between its distributions in failed and in ok cases (Kolmogorov-Smirnov)
    p_value: float
    low: tuple[float, str]  # share of failures in its lowest quarter, a choice: at best; where
    high: tuple[float, str]  # in its highest quarter, a choice: at worst; where


def failure_causes(data: SweepData) -> list[Cause]:
    """Which parameters cause the failures, strongest first; [] where none or all failed.

    Args:
        data: the sweep.
    """
    codes = data["status"]
    is_run = codes != NOT_RUN
    is_failed = (codes != status.OK)[is_run]
    if not is_failed.any() or is_failed.all():
        return []
    causes = []
    for name, column in _scalar_columns(data):
        value = column[is_run]
        if len(np.unique(value)) < 2:
            continue
        if value.dtype.kind in "UO":
            causes.append(_cause_of_choice(name, value.astype(str), is_failed))
            continue
        test = ks_2samp(value[is_failed], value[~is_failed])
        ends = np.quantile(value, (0.25, 0.75))
        rates = is_failed[value <= ends[0]].mean(), is_failed[value >= ends[1]].mean()
        low, high = (
            (float(rate), f"{sign} {end:.4g}")
            for rate, end, sign in zip(rates, ends, ("<=", ">="), strict=True)
        )
        causes.append(Cause(name, float(test.statistic), float(test.pvalue), low, high))
    return sorted(causes, key=lambda cause: -cause.distance)


def _cause_of_choice(name: str, value: np.ndarray, is_failed: np.ndarray) -> Cause:
    """The same for texts: total variation instead of the Kolmogorov distance, chi-squared test."""
    names, which = np.unique(value, return_inverse=True)
    bad = np.bincount(which, is_failed, len(names))
    good = np.bincount(which, ~is_failed, len(names))
    rate = bad / (bad + good)
    distance = np.abs(bad / bad.sum() - good / good.sum()).sum() / 2
    best, worst = int(np.argmin(rate)), int(np.argmax(rate))
    return Cause(
        name,
        float(distance),
        float(chi2_contingency(np.stack([bad, good])).pvalue),
        (float(rate[best]), str(names[best])),
        (float(rate[worst]), str(names[worst])),
    )


def _scalar_columns(data: SweepData) -> list[tuple[str, np.ndarray]]:
    """Axes one number, or one text, at a time."""
    found = []
    for name in swept_names(data):
        array = data[name]
        if array.dtype.kind in "UO":
            found.append((name, array))
            continue
        flat = array.reshape(len(array), -1).astype(float)
        for k in range(flat.shape[1]):
            index = np.unravel_index(k, array.shape[1:])
            entry = "".join(f"[{i}]" for i in index) if array.ndim > 1 else ""
            column = flat[:, k]
            if not np.isnan(column).any():  # lists of different lengths have gaps
                found.append((name + entry, column))
    return found


def factor_names(data: SweepData) -> list[str]:
    """Names of the dimensions of a sampled sweep's unit cube.

    Raises:
        StudyError: not a Morris or Saltelli design, or one with cases left out.
    """
    sweep = data.spec.sweep
    if sweep.method not in ("morris", "saltelli"):
        raise StudyError(
            f"sensitivity: sweep.method = {sweep.method!r}; allowed 'morris' or 'saltelli'"
        )
    if sweep.where or sweep.repeats > 1:
        raise StudyError("sensitivity: a design is read as a whole; leave out where and repeats")
    names = []
    for name, written in sweep.axes.items():
        axis = build_axis(name, written, data.spec.study, "sweep.axes")
        names += (
            [name] if axis.dimensions == 1 else [f"{name}[{k}]" for k in range(axis.dimensions)]
        )
    return names


def design_values(data: SweepData, metric: str) -> np.ndarray:
    """A metric at all rows of a design, NaN where the case failed or has not been run.

    Raises:
        StudyError: unknown metric.
    """
    is_ok = data["status"] == status.OK
    value = np.where(is_ok, metric_values(data, metric).astype(float), np.nan)
    return value[data.table.origin]
