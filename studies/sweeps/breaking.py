"""What breaks the best designs of a sweep first."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from studies.engine.breaking import BreakingChange, parse_tolerances, smallest_change
from studies.engine.controller import fixed_controller
from studies.engine.design import load_design
from studies.errors import StudyError


class BrokenCase(NamedTuple):
    """A case of a sweep, and the smallest change that breaks it, or why there is none."""

    case: int
    change: BreakingChange | None
    fault: str  # "" if there is a change

    @property
    def text(self) -> str:
        """In a sentence."""
        return self.fault if self.change is None else self.change.text

    def record(self) -> dict[str, Any]:
        """For a JSON document."""
        found = None if self.change is None else self.change.record()
        return {"case": self.case, "smallest_change": found, "fault": self.fault}


def breaking_changes(
    folder: Path, cases: Iterable[int], tolerances: Iterable[str]
) -> Iterator[BrokenCase]:
    """The smallest change that breaks each of some cases; what cannot be judged says why.

    Args:
        folder: of the sweep.
        cases: their numbers.
        tolerances: texts NAME=VALUE, see `parse_tolerances`.

    Raises:
        StudyError: a text that is none.
    """
    units = parse_tolerances(tolerances)
    for case in cases:
        try:
            design = fixed_controller(load_design(folder, case).study)
            yield BrokenCase(case, smallest_change(design, units), fault="")
        except StudyError as error:
            yield BrokenCase(case, None, fault=f"not judged: {error}")
