"""What every kind of measurement is: an entry of the file, and what it becomes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from studies.fitting.bench import Bench
from studies.fitting.decays import Diagram
from studies.fitting.kinds.motions import Motions
from studies.fitting.kinds.runs import Runs
from studies.study.signals import Signal
from studies.study.spec import Section, Study, described


class Residual(NamedTuple):
    """Model minus measurement, in standard deviations of the measurement."""

    value: np.ndarray  # (m,)
    slope: np.ndarray | None  # by the parameters, (m, p); None if not asked for


def scaled(
    model: np.ndarray, slope: np.ndarray | None, measured: np.ndarray, sigma: np.ndarray
) -> Residual:
    """The residual of real numbers of the model, (m,), with their derivatives, (m, p)."""
    value = (model - measured) / sigma
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
    diagram: Diagram | None = None  # of modes from raw records

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

    fixed: float | np.ndarray  # in the unit of the values, of all or of each
    share: float  # of the values [1]

    def sigma(self, value: np.ndarray) -> np.ndarray:
        """Of each value."""
        return np.asarray(np.hypot(self.fixed, self.share * np.abs(value)))

    def of_model(self, model: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """The same of a model's values; of measured ones where the model is 0."""
        sigma = self.sigma(model)
        return np.where(sigma > 0, sigma, self.sigma(measured))


class Models(NamedTuple):
    """What measurements are predicted with."""

    study: Study
    folder: Path  # where the files of the data are
    bench: Bench
    runs: Runs
    motions: Motions


class DataEntry(Section):
    """Fields of every measurement."""

    kind: str = described(..., "-", "kind of measurement")
    name: str = described("", "-", "in messages and figures; default: its number", max_length=60)
    check: bool = described(False, "-", "held out: compared, not fitted")

    def measurement(self, models: Models, path: str) -> Measurement:
        """The measurement with its data.

        Args:
            models: what predicts it.
            path: where the entry is written, for messages.

        Raises:
            StudyError: data that cannot be used, or do not fit the machine.
        """
        raise NotImplementedError

    def signals(self, study: Study, path: str) -> tuple[Signal, ...]:
        """Its input, if it has one, and its outputs."""
        return ()


class Measurement(ABC):
    """One set of measured numbers and its model.

    Where `predict` gives real numbers, and every one of them has its label, the defaults will do.
    """

    kind: ClassVar[str]
    is_ordered: ClassVar[bool] = False  # neighbours in `residual` are neighbours in time, frequency
    n_hidden: int = 0  # numbers that it fits by itself
    unknown: tuple[str, ...] = ()  # those of them that nobody knows and `found` tells
    mean_square: float = 1.0  # of residuals that are noise [1]
    labels: tuple[str, ...] = ()  # of the numbers, with their units

    def __init__(self, entry: DataEntry, measured: np.ndarray, sigma: np.ndarray) -> None:
        """
        Args:
            entry: of the file.
            measured: (n,).
            sigma: standard deviations of the measured values, (n,).
        """
        self.name, self.is_checked = entry.name, entry.check
        self.measured, self.sigma = measured, sigma

    @abstractmethod
    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        """Numbers of the model at some values of the parameters (p,), (n,).

        Returns:
            (the numbers, their derivatives by the parameters (n, p) or None).
        """

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        """At some values of the parameters, (p,)."""
        return scaled(*self.predict(values, has_slopes), self.measured, self.sigma)

    def reweigh(self, values: np.ndarray) -> None:  # noqa: B027
        """Take noise that is a share of the value from the model's values from now on.

        Of measured values, those that noise made small would count more than the others. By
        default the noise is no share, or one of the measured values.
        """

    def found(self, values: np.ndarray) -> dict[str, float]:
        """Unknown numbers of its own, by name: gain [1], delay [s], offset [its unit]."""
        return {}

    def compare(self, values: np.ndarray) -> Line | Numbers:
        """For figures and tables."""
        model, _ = self.predict(values, False)
        return Numbers(labels=self.labels, measured=self.measured, model=model, sigma=self.sigma)

    def sanity_error(self, values: np.ndarray) -> str:
        """What looks wrong with the data at the starting point, "" if nothing."""
        return ""
