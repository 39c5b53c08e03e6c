"""What breaks the best designs of a sweep first."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from studies.engine.breaking import smallest_change
from studies.engine.controller import fixed_controller
from studies.engine.design import load_design
from studies.errors import StudyError
from studies.results.breaking import BrokenCase
from studies.space.machines import parse_tolerances


def breaking_changes(
    folder: Path, cases: Iterable[int], tolerances: Mapping[str, float | str]
) -> Iterator[BrokenCase]:
    """The smallest change that breaks each of some cases; what cannot be judged says why.

    Args:
        folder: of the sweep.
        cases: their numbers.
        tolerances: see `parse_tolerances`.

    Raises:
        StudyError: one that is none.
    """
    units = parse_tolerances(tolerances)
    for case in cases:
        try:
            design = fixed_controller(load_design(folder, case).study)
            yield BrokenCase(case, smallest_change(design, units), fault="")
        except StudyError as error:
            yield BrokenCase(case, None, fault=f"not judged: {error}")
