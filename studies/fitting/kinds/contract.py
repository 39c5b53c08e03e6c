"""What every kind of measurement does."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class Residual(NamedTuple):
    """Model minus measurement, in standard deviations of the measurement."""

    value: np.ndarray  # (m,)
    slope: np.ndarray | None  # by the parameters, (m, p); None if not asked for


def scaled(
    found: np.ndarray, slope: np.ndarray | None, measured: np.ndarray, sigma: np.ndarray
) -> Residual:
    """The residual of real numbers of the model, (m,), with their derivatives, (m, p)."""
    value = (found - measured) / sigma
    return Residual(value, None if slope is None else slope / sigma[:, None])


class Line(NamedTuple):
    """One measurement over frequency or time."""

    abscissa: str  # with its unit
    ordinate: str
    x: np.ndarray  # (n,)
    measured: np.ndarray  # (n,)
    model: np.ndarray  # (n,)
    away: np.ndarray  # model minus measurement in standard deviations, (n,), or more parts of it
    is_log: bool  # ordinate


class Numbers(NamedTuple):
    """Measured numbers that stand alone."""

    labels: tuple[str, ...]  # with their units
    measured: np.ndarray  # (n,)
    model: np.ndarray  # (n,)
    sigma: np.ndarray  # of the measured ones, (n,)
    notes: tuple[str, ...] = ()  # on the model's, of the first of them

    @property
    def away(self) -> np.ndarray:
        """Model minus measurement, in standard deviations, (n,)."""
        return (self.model - self.measured) / self.sigma


class DataAndModel(NamedTuple):
    """A measurement beside the model."""

    name: str
    is_checked: bool  # held out
    part: Line | Numbers

    @property
    def title(self) -> str:
        """Its name, and whether it was held out."""
        return f"{self.name} (held out)" if self.is_checked else self.name


class Noise(NamedTuple):
    """Standard deviation of measured values: both parts in quadrature."""

    fixed: float  # in the unit of the values
    share: float  # of the values [1]

    def sigma(self, value: np.ndarray) -> np.ndarray:
        """Of each value."""
        return np.hypot(self.fixed, self.share * np.abs(value))

    def of_model(self, model: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """The same of a model's values; of measured ones where the model is 0."""
        found = self.sigma(model)
        return np.where(found > 0, found, self.sigma(measured))


class Measurement(Protocol):
    """One set of measured numbers and its model."""

    name: str
    kind: str
    is_checked: bool  # held out: not fitted, only compared
    is_ordered: bool  # neighbours in `residual` are neighbours in time or frequency
    n_hidden: int  # numbers that it fits by itself
    mean_square: float  # of residuals that are noise [1]

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        """At some values of the parameters, (p,)."""
        ...

    def reweigh(self, values: np.ndarray) -> None:
        """Take noise that is a share of the value from the model's values from now on.

        Of measured values, those that noise made small would count more than the others.
        """
        ...

    def comparison(self, values: np.ndarray) -> Line | Numbers:
        """For figures and tables."""
        ...

    def complaint(self, values: np.ndarray) -> str:
        """What looks wrong with the data at the starting point, "" if nothing."""
        ...
