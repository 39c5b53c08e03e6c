"""Which parameters matter, and what failures depend on."""

from __future__ import annotations

import numpy as np

from jaxmodel import status
from studies.engine.results import SweepData, metric_values, swept_names
from studies.errors import StudyError
from studies.results.labelled import Labelled, labelled, told
from studies.space.axes import build_axis
from studies.space.designs import unit_points
from studies.space.methods import METHODS, Analysis


class FailureShare(Labelled):
    """A part of a parameter's values."""

    share: float = labelled("1", "of failures there")
    where: str = told("which values")


class Cause(Labelled):
    """How failures depend on one parameter."""

    name: str = told("parameter")
    distance: float = labelled("1", "Kolmogorov-Smirnov distance of failed and of ok cases")
    p_value: float = labelled("1", "of that distance")
    low: FailureShare = told("its lowest quarter; of a choice, the best value")
    high: FailureShare = told("its highest quarter; of a choice, the worst value")


def failure_causes(data: SweepData) -> list[Cause]:
    """Which parameters cause the failures, strongest first; [] if none or all failed.

    Args:
        data: the sweep.
    """
    codes = data["status"]
    is_run = codes >= 0
    is_failed = (codes != status.OK)[is_run]
    if not is_failed.any() or is_failed.all():
        return []
    from scipy.stats import ks_2samp  # takes a third of a second

    causes = []
    for name, column in scalar_columns(data):
        value = column[is_run]
        if value.dtype.kind == "b":
            value = value.astype(float)
        if len(np.unique(value)) < 2:
            continue
        if value.dtype.kind in "UO":
            causes.append(_text_cause(name, value.astype(str), is_failed))
            continue
        test = ks_2samp(value[is_failed], value[~is_failed])
        ends = np.quantile(value, (0.25, 0.75))
        rates = is_failed[value <= ends[0]].mean(), is_failed[value >= ends[1]].mean()
        low, high = (
            FailureShare(float(rate), f"{sign} {end:.4g}")
            for rate, end, sign in zip(rates, ends, ("<=", ">="), strict=True)
        )
        causes.append(Cause(name, float(test.statistic), float(test.pvalue), low, high))
    return sorted(causes, key=lambda cause: -cause.distance)


def _text_cause(name: str, value: np.ndarray, is_failed: np.ndarray) -> Cause:
    """The same for texts: total variation instead of the Kolmogorov distance, chi-squared test."""
    from scipy.stats import chi2_contingency

    names, which = np.unique(value, return_inverse=True)
    bad = np.bincount(which, is_failed, len(names))
    good = np.bincount(which, ~is_failed, len(names))
    rate = bad / (bad + good)
    distance = np.abs(bad / bad.sum() - good / good.sum()).sum() / 2
    best, worst = int(np.argmin(rate)), int(np.argmax(rate))
    return Cause(
        name=name,
        distance=float(distance),
        p_value=float(chi2_contingency(np.stack([bad, good])).pvalue),
        low=FailureShare(float(rate[best]), str(names[best])),
        high=FailureShare(float(rate[worst]), str(names[worst])),
    )


def scalar_columns(data: SweepData) -> list[tuple[str, np.ndarray]]:
    """Axes as columns of single numbers or texts."""
    columns = []
    for name in swept_names(data):
        array = data[name]
        if array.dtype.kind in "UO":
            columns.append((name, array))
            continue
        flat = array.reshape(len(array), -1)
        for k in range(flat.shape[1]):
            index = np.unravel_index(k, array.shape[1:])
            entry = "".join(f"[{i}]" for i in index) if array.ndim > 1 else ""
            column = flat[:, k]
            if not np.isnan(column).any():  # lists of different lengths have gaps
                columns.append((name + entry, column))
    return columns


def analyse(data: SweepData, metric: str) -> Analysis:
    """Analyse the factors of a sweep's design.

    Args:
        data: of a sweep by a method with an analysis.
        metric: to analyse.

    Raises:
        StudyError: no such design or metric, or too many cases failed.
    """
    names, value = factor_names(data), design_values(data, metric)
    seed, analysis = data.spec.sweep.seed, METHODS[data.spec.sweep.method].analysis
    assert analysis is not None
    return analysis(unit_points(data.spec.root, len(names), seed), value, names)


def factor_names(data: SweepData) -> list[str]:
    """Names of the dimensions of a sampled sweep's unit cube.

    Raises:
        StudyError: not a design made for an analysis, or one with excluded cases.
    """
    sweep = data.spec.sweep
    if METHODS[sweep.method].analysis is None:
        allowed = " or ".join(repr(name) for name, method in METHODS.items() if method.analysis)
        raise StudyError(f"sensitivity: sweep.method = {sweep.method!r}; allowed: {allowed}")
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
    """A metric at all rows of a design, NaN if the case failed or has not run.

    Raises:
        StudyError: unknown metric.
    """
    is_ok = data["status"] == status.OK
    value = np.where(is_ok, metric_values(data, metric).astype(float), np.nan)
    return value[data.table.origin]
