"""Criteria against the closed loop: do they choose the same place?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr

from studies.engine.batches import ProgressCallback
from studies.papers.gupta_2010.closed_loop import ClosedLoops, close_loops
from studies.papers.gupta_2010.criteria import CRITERIA
from studies.study.spec import Study, paper_study


class CriterionRank(NamedTuple):
    """How a criterion orders the places, against the closed loop."""

    value: np.ndarray  # over its largest [1], (n,)
    place: float  # it chooses [m]
    residual: float  # rms vibration left there, over that without control [1]
    loss: float  # over the least one, minus 1 [1]
    correlation: float  # of ranks, of value and of what control removes [1]


class PlacementFindings(NamedTuple):
    """What was found."""

    study: Study
    loops: ClosedLoops
    ranks: dict[str, CriterionRank]  # by CRITERIA


class PlaceGrid(NamedTuple):
    """How much is computed."""

    places: int = 29
    factors: int = 300

    @property
    def steps(self) -> int:
        """What `find` reports as done."""
        return 1


def find(grid: PlaceGrid, on_progress: ProgressCallback) -> PlacementFindings:
    """Compare the criteria on the machine of the paper.

    Args:
        grid: sizes.
        on_progress: called with progress messages.
    """
    study = paper_study()
    on_progress("closing the loops", 0.0)
    length = float(np.min(study.link.length))
    half = float(np.max(study.patches.actuator_length)) / 2 + 1e-3  # from the links' ends
    places = np.linspace(half, length - half, grid.places)
    loops = close_loops(study, places, np.geomspace(0.02, 1.5, grid.factors))
    on_progress("closed the loops", 1.0)
    ranks = {name: rank(measure(loops.link), loops) for name, measure in CRITERIA.items()}
    return PlacementFindings(study, loops, ranks)


def rank(value: np.ndarray, loops: ClosedLoops) -> CriterionRank:
    """A criterion by its values at the places (n,), against the closed loops there."""
    residual, best = loops.residual, int(np.argmax(value))
    return CriterionRank(
        value=value / value[best],
        place=float(loops.place[best]),
        residual=float(residual[best]),
        loss=float(residual[best] / residual.min() - 1),
        correlation=float(spearmanr(value, -residual).statistic),
    )
