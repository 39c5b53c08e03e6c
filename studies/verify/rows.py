"""The table of a verification: one row per assumption."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Assumption(NamedTuple):
    """An assumption, what it is checked against, and how far apart both are."""

    assumption: str
    against: str
    source: str  # author and year
    difference: float  # relative unless `unit` says otherwise; NaN: it could not be computed
    allowed: float
    left_out: str = ""  # why there is nothing to check, "" if there is
    note: str = ""  # what went wrong, or a figure that helps

    @property
    def is_passed(self) -> bool:
        """Whether the difference is allowed, or there was nothing to check."""
        return bool(self.left_out) or bool(self.difference <= self.allowed)

    @property
    def outcome(self) -> str:
        """In a word."""
        if self.left_out:
            return "left out"
        return "passed" if self.is_passed else "FAILED"


def largest(found: Any, wanted: Any) -> float:
    """Largest difference over the largest value wanted [1], NaN counts as infinite."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    size = np.abs(wanted).max()
    difference = np.abs(found - wanted).max() / (size if size > 0 else 1.0)
    return float(np.inf if np.isnan(difference) else difference)


def worst_relative(found: Any, wanted: Any) -> float:
    """Largest difference entry by entry, over what is wanted there [1]."""
    difference = np.abs(np.asarray(found) / np.asarray(wanted) - 1).max()
    return float(np.inf if np.isnan(difference) else difference)
