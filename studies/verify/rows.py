"""The table of a verification: one row per assumption."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from studies.results.labelled import Labelled, derived, told


class Assumption(Labelled):
    """An assumption, what it is checked against, and how far apart both are."""

    assumption: str = told("what the model assumes")
    against: str = told("what it was checked against")
    source: str = told("author and year")
    difference: float = told("relative, or a count; null: it could not be computed")
    allowed: float = told("largest difference")
    left_out: str = told("why there was nothing to check, empty if there was", default="")
    note: str = told("what went wrong, or a figure that helps", default="")

    @property
    def is_passed(self) -> bool:
        """Whether the difference is allowed, or there was nothing to check."""
        return bool(self.left_out) or bool(self.difference <= self.allowed)

    @derived("", "in a word")
    def outcome(self) -> Literal["passed", "FAILED", "left out"]:
        if self.left_out:
            return "left out"
        return "passed" if self.is_passed else "FAILED"


def worst(*differences: Any) -> float:
    """Largest of differences [1], infinite where one is NaN, which Python's `max` can pass over."""
    found = max(float(np.max(x)) if not np.any(np.isnan(x)) else np.inf for x in differences)
    return float(found)


def largest(found: Any, wanted: Any) -> float:
    """Largest difference over the largest value wanted [1], NaN counts as infinite."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    size = np.abs(wanted).max()
    return worst(np.abs(found - wanted) / (size if size > 0 else 1.0))


def worst_relative(found: Any, wanted: Any) -> float:
    """Largest difference entry by entry, over what is wanted there [1]."""
    return worst(np.abs(np.asarray(found) / np.asarray(wanted) - 1))
