"""The smallest change that breaks a design, as a result; it is read without JAX."""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.results.labelled import Labelled, derived, told, unwritten

#: Parts named in words: those that make up this share of the squared distance, at most so many.
NAMED, LONGEST = 0.9, 5


class ChangedNumber(Labelled):
    """One number of a changed machine."""

    name: str = told("such as: patch 2 of link 1")
    text: str = told("with its change, such as: patch 2 of link 1 1.8 mm towards C")
    size: float = told("of its change, in tolerances")


class BreakingChange(Labelled):
    """The nearest machine with which a design's controller is unstable."""

    distance: float = told("Euclidean, in tolerances; 0: unstable as it is, null: none was found")
    change: Any = unwritten()  # `MachineChange` of NumPy arrays
    parts: tuple[ChangedNumber, ...] = told("numbers that change, largest first")
    breaking: str = told("what goes unstable, empty if none was found")
    tolerances: dict[str, float] = told(
        "units of change: kg, m, samples, kg m2; 1 of a factor's logarithm"
    )

    @derived("", "in a sentence")
    def text(self) -> str:
        if self.distance == 0:
            return f"no change breaks it: it is unstable as it is, by {self.breaking}"
        if not np.isfinite(self.distance):
            return "no change within its limits that breaks it was found"
        share = np.cumsum([part.size**2 for part in self.parts]) / self.distance**2
        count = min(int(np.searchsorted(share, NAMED)) + 1, LONGEST, len(self.parts))
        more = len(self.parts) - count
        others = f" and {more} smaller change{'s' * (more > 1)}" if more else ""
        listed = ", ".join(part.text for part in self.parts[:count])
        return (
            f"the smallest change that breaks it, {self.distance:.3g} tolerances: {listed}"
            f"{others}; unstable is then {self.breaking}"
        )


class BrokenCase(Labelled):
    """A case of a sweep, and the smallest change that breaks it, or why there is none."""

    case: int = told("number of the case")
    smallest_change: BreakingChange | None = told("that breaks it; null: it could not be judged")
    fault: str = told("why it could not be judged, empty if it was")

    @property
    def text(self) -> str:
        """In a sentence."""
        return self.fault if self.smallest_change is None else self.smallest_change.text
