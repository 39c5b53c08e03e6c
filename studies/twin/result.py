"""What a comparison with the twin found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from studies.engine.stability import LoopFigures
from studies.result import Result
from studies.study.spec import Study
from studies.twin.compare import BothRuns, ChangedRun, in_window
from studies.twin.margin import GrowthMargin
from studies.twin.multibody import Settings
from studies.twin.plan import TwinPlan

#: File of the figure, without its extension.
FIGURE = "twin"


@dataclass(frozen=True, eq=False)
class TwinResult(Result):
    """A study and its twin."""

    FILES = ", numbers and figure in the same folder"

    study: Study
    plan: TwinPlan
    settings: Settings
    version: str  # of Exudyn
    runs: BothRuns
    causes: list[ChangedRun]
    loop: LoopFigures  # of our linearised sampled loop
    first_modes: np.ndarray  # the twin's poles nearest to our first modes' [rad/s], (n,)
    growth: GrowthMargin

    @property
    def window(self) -> slice:
        """The samples that are compared."""
        return in_window(self.plan)


def expected_poles(loop: LoopFigures) -> np.ndarray:
    """Of our first modes under control [rad/s], (n,), those that oscillate."""
    omega, zeta = 2 * np.pi * loop.frequency_hz[0], loop.damping_ratio[0]
    omega, zeta = (x[np.isfinite(x)] for x in (omega, zeta))
    return np.asarray(omega * (-zeta + 1j * np.sqrt(1 - zeta**2)))
