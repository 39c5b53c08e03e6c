"""Least squares: all residuals of a fit and their derivatives, in the unit cube of free numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.fitting.bench import Bench
from studies.fitting.kinds.contract import Measurement, Residual
from studies.fitting.spec import Prior
from studies.space.free import FreeNumbers

#: Residual of a design that cannot run, in standard deviations.
FAILED = 1e3


class Problem(NamedTuple):
    """What is to be fitted."""

    free: FreeNumbers
    priors: tuple[Prior, ...]
    measurements: tuple[Measurement, ...]  # those that count
    checks: tuple[Measurement, ...]  # those held out
    bench: Bench

    def parts(self, values: np.ndarray, has_slopes: bool) -> list[Residual]:
        """Residuals of each measurement, and of the priors at the end if there are any."""
        found = [x.residual(values, has_slopes) for x in self.measurements]
        if self.priors:
            at = np.array([x.number for x in self.priors])
            mean, sigma = (np.array([x[k] for x in self.priors]) for k in (1, 2))
            slope = np.zeros((len(at), len(values)))
            slope[np.arange(len(at)), at] = 1 / sigma
            found.append(Residual((values[at] - mean) / sigma, slope if has_slopes else None))
        return found

    def residual(self, u: np.ndarray) -> np.ndarray:
        """All residuals, (m,), at places between the bounds, (p,)."""
        return np.concatenate([x.value for x in self.parts(self.free.values(u), False)])

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Derivatives by the places, (m, p)."""
        values = self.free.values(u)
        by = np.concatenate([x.slope for x in self.parts(values, True) if x.slope is not None])
        return by * self.free.slopes(u)

    def costs(self, u: np.ndarray) -> np.ndarray:
        """Half the sum of squares at many places, (n, p); infinite where the model fails."""
        values = self.free.values(u)
        many, found = self.bench.many(values), []
        for k, row in enumerate(values):
            self.bench.keep(row, many[k])
            try:
                cost = 0.5 * float(np.sum(self.residual(u[k]) ** 2))
            except (StudyError, np.linalg.LinAlgError):
                cost = np.inf
            found.append(cost if np.isfinite(cost) else np.inf)
        return np.array(found)


def complaints(measurements: Sequence[Measurement], values: np.ndarray) -> None:
    """Refuse data whose unit or order cannot be meant.

    Raises:
        StudyError: naming the measurement.
    """
    for one in measurements:
        fault = one.complaint(values)
        if fault:
            raise StudyError(f"{one.name}: {fault}")
