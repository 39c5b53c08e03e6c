"""Least squares: all residuals of a fit and their derivatives, in the unit cube of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.fitting.bench import Bench
from studies.fitting.kinds.contract import Measurement, Residual
from studies.fitting.spec import MOTIONS, FitSpec, Prior
from studies.space.free import FreeNumbers

#: Size of a residual from which the robust loss grows linearly, in standard deviations.
SOFT = 2.0


class Problem(NamedTuple):
    """What is to be fitted."""

    free: FreeNumbers
    priors: tuple[Prior, ...]
    measurements: tuple[Measurement, ...]  # without those held out
    bench: Bench
    is_robust: bool = False  # residuals beyond SOFT grow as their root

    @property
    def has_motions(self) -> bool:
        """Whether whole motions are run, which take a hundred times as long as a plant."""
        return any(x.kind in MOTIONS for x in self.measurements)

    def parts(self, values: np.ndarray, has_slopes: bool) -> list[Residual]:
        """Residuals of each measurement, and of the priors at the end if there are any."""
        residuals = [x.residual(values, has_slopes) for x in self.measurements]
        if self.priors:
            at = np.array([x.number for x in self.priors])
            mean, sigma = (np.array([x[k] for x in self.priors]) for k in (1, 2))
            slope = np.zeros((len(at), len(values)))
            slope[np.arange(len(at)), at] = 1 / sigma
            residuals.append(Residual((values[at] - mean) / sigma, slope if has_slopes else None))
        return residuals

    def residual(self, u: np.ndarray) -> np.ndarray:
        """All residuals, (m,), at places between the bounds, (p,)."""
        return self.stacked(self.parts(self.free.values(u), False))

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Derivatives by the places, (m, p)."""
        return self.stacked_slopes(self.parts(self.free.values(u), True), u)

    def stacked(self, parts: Sequence[Residual]) -> np.ndarray:
        """`residual` from its parts."""
        value = np.concatenate([x.value for x in parts])
        return softened(value)[0] if self.is_robust else value

    def stacked_slopes(self, parts: Sequence[Residual], u: np.ndarray) -> np.ndarray:
        """`jacobian` from its parts."""
        by = np.concatenate([x.slope for x in parts if x.slope is not None])
        if self.is_robust:
            by = by * softened(np.concatenate([x.value for x in parts]))[1][:, None]
        return by * self.free.slopes(u)

    def costs(self, u: np.ndarray) -> np.ndarray:
        """Half the sum of squares at many places, (n, p); infinite where the model fails.

        Plants come in one batch. Motions run one by one: batched, 16 of them take 1.7 times as
        long, and six seconds to compile.
        """
        values = self.free.values(u)
        many, costs = self.bench.many(values), []
        for k, row in enumerate(values):
            self.bench.keep(row, many[k])
            try:
                cost = 0.5 * float(np.sum(self.residual(u[k]) ** 2))
            except (StudyError, np.linalg.LinAlgError):
                cost = np.inf
            costs.append(cost if np.isfinite(cost) else np.inf)
        return np.array(costs)


def make_problem(spec: FitSpec, bench: Bench, measurements: Sequence[Measurement]) -> Problem:
    """The problem of a fit.

    Args:
        spec: of the fit.
        bench: its linear machine.
        measurements: all of them; those held out are left out.
    """
    return Problem(
        free=spec.free,
        priors=spec.priors,
        measurements=tuple(x for x in measurements if not x.is_checked),
        bench=bench,
        is_robust=spec.fit.loss == "robust",
    )


def softened(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals whose squares are the loss 2 C^2 (sqrt(1 + (r/C)^2) - 1), and their derivatives."""
    root = np.hypot(1.0, r / SOFT)
    # sqrt(1 + x) - 1 without cancellation
    value = r * np.sqrt(2 / (root + 1))
    is_small = np.abs(r) < 1e-8
    slope = np.where(is_small, 1.0, r / (np.where(is_small, 1.0, value) * root))
    return value, slope


def check_sanity(measurements: Sequence[Measurement], values: np.ndarray) -> None:
    """Refuse data whose unit or order cannot be meant.

    Raises:
        StudyError: naming the measurement.
    """
    for one in measurements:
        fault = one.sanity_error(values)
        if fault:
            raise StudyError(f"{one.name}: {fault}")
