"""Designs of a sweep, each judged over its environments.

Axes that `sweep.environments` names, such as the payload or the links' true stiffness, are what a
design meets, not what it chooses. Cases that differ in them alone are one design; it counts as good
only if each of its cases is, and ranks by their worst value, their mean, or a quantile of them.
"""

from __future__ import annotations

import numpy as np

from studies.engine.results import SweepData, direction, metric_values
from studies.show.units import count_text


def has_environments(data: SweepData) -> bool:
    """Whether cases are environments of designs."""
    return bool(data.spec.sweep.environments)


def over_environments(data: SweepData, by: str) -> np.ndarray:
    """A metric of each case's design over its environments, (n,); NaN where a case has none.

    Args:
        data: the sweep.
        by: metric or entry of one; with "-" in front, in reverse order.
    """
    value, own = metric_values(data, by.removeprefix("-")).astype(float), data.designs
    sign, over = -1.0 if direction(by) == "largest" else 1.0, data.spec.sweep.over
    count = np.bincount(own)
    if over == "mean":
        with np.errstate(invalid="ignore"):
            return (np.bincount(own, np.nan_to_num(value, nan=np.inf)) / count)[own]
    # sorted by design, and in each from the best value to the worst; NaN is worst
    order = np.lexsort((sign * value, own))
    share = 1.0 if over == "worst" else float(over)
    place = np.cumsum(count) - count + np.ceil(share * count).astype(int).clip(1) - 1
    found = value[order[place]]
    return np.where(_has_all(value, own), found, np.nan)[own]


def design_values(data: SweepData, name: str) -> np.ndarray:
    """A metric of each case, over the environments of its design if the sweep has any, (n,)."""
    value = metric_values(data, name)
    if not has_environments(data) or value.dtype.kind not in "fiub":
        return value
    return over_environments(data, name)


def _has_all(value: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Designs of which each case has a value, (m,)."""
    return np.bincount(own, ~np.isfinite(value)) == 0


def whole_designs(data: SweepData, chosen: np.ndarray) -> np.ndarray:
    """Cases of the designs of which each case is chosen, (n,)."""
    own = data.designs
    return (np.bincount(own, ~chosen) == 0)[own]


def one_each(data: SweepData, by: str, cases: np.ndarray) -> np.ndarray:
    """Of each design's cases the one nearest to its value over environments, in their order."""
    value = metric_values(data, by.removeprefix("-")).astype(float)
    gap = np.abs(value - over_environments(data, by))
    own = data.designs[cases]
    order = np.lexsort((gap[cases], own))
    first = np.append(True, np.diff(own[order]) != 0)
    return np.sort(cases[order[first]])


def over_text(data: SweepData) -> str:
    """How values over environments become one: "worst", "mean", "0.9 quantile"."""
    over = data.spec.sweep.over
    return over if isinstance(over, str) else f"{over:g} quantile"


def environments_text(data: SweepData) -> str:
    """How designs are judged, in a sentence; "" if each case is a design."""
    if not has_environments(data):
        return ""
    count = np.bincount(data.designs)
    number = f"{count.max()}" if count.min() == count.max() else f"{count.min()} to {count.max()}"
    names, repeats = ", ".join(data.spec.sweep.environments), data.spec.sweep.repeats
    what = f"environments ({names})"
    if repeats > 1:  # each of its cases is one of both
        what = f"cases, environments ({names}) times {repeats} repeats"
    return (
        f"{count_text(len(count), 'design')}, each by the {over_text(data)} of its {number} "
        f"{what}; the case shown is the one nearest to that"
    )
