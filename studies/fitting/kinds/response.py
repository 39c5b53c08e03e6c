"""Frequency responses, complex or magnitudes, and power spectra under white forces."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from studies.fitting.bench import Bench, Pose, response
from studies.fitting.kinds.contract import Line, Measurement, Noise, Residual, scaled
from studies.fitting.kinds.unknown import GAIN, Adjusted, adjusted, noise_error
from studies.study.signals import Signal

TWO_PI = 2 * np.pi
#: A measured response this many times the model's at the starting point has another unit [1].
OTHER_UNIT = 100.0


class _BenchMeasurement(Measurement):
    """What responses and spectra share: one input, one output, one pose."""

    kind, is_ordered = "response", True

    def __init__(
        self,
        name: str,
        is_checked: bool,
        bench: Bench,
        pose: Pose,
        signals: tuple[Signal, Signal],
        order: int,
        frequency: np.ndarray,
        measured: np.ndarray,
        noise: Noise,
        unit: str,
    ) -> None:
        """
        Args:
            name, is_checked, bench, pose: of the measurement.
            signals: input and output.
            order: derivatives by time that the output has: 0, 1 or 2.
            frequency: [Hz], (f,).
            measured: (f,).
            noise: of the measured values.
            unit: of the response.
        """
        super().__init__(name, is_checked, measured, noise.sigma(measured))
        self._bench, self._pose, self.signals, self._order = bench, pose, signals, order
        self.frequency, self._noise, self._unit = frequency, noise, unit

    @property
    def patches(self) -> tuple[int, int]:
        """Links, and pairs of patches on each."""
        return self._bench.study.n_links, self._bench.n_patches

    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        plant = self._bench.plant(self._pose, values, has_slopes)
        omega = TWO_PI * self.frequency
        value, slope = response(plant, self.signals, self._bench.places(self.signals), omega)
        turn = (1j * omega) ** self._order
        return value * turn, None if slope is None else slope * turn[:, None]

    def reweigh(self, values: np.ndarray) -> None:
        self.sigma = self._noise.of_model(self.predict(values, False)[0], self.measured)

    def sanity_error(self, values: np.ndarray) -> str:
        model = np.abs(self.predict(values, False)[0])
        ratio = float(np.median(np.abs(self.measured)) / max(np.median(model), 1e-300))
        if 1 / OTHER_UNIT < ratio < OTHER_UNIT:
            return ""
        return (
            f"measured is {ratio:.3g} times the model at the starting point; expected {self._unit} "
            "and a frequency in Hz: check the units"
        )

    def _line(
        self, label: str, measured: np.ndarray, model: np.ndarray, values: np.ndarray
    ) -> Line:
        return Line(
            abscissa="frequency [Hz]",
            ordinate=label,
            x=self.frequency,
            measured=measured,
            model=model,
            away=self.residual(values, False).value,
            is_log=True,
        )


class ComplexResponse(_BenchMeasurement):
    """Real and imaginary part."""

    def __init__(self, *arguments: Any, unknown: tuple[str, ...] = ()) -> None:
        """Arguments: as above; unknown: of gain and delay."""
        super().__init__(*arguments)
        self.unknown, self.n_hidden = unknown, len(unknown)

    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        model, slope, _ = self._adjusted(values, has_slopes)
        return model, slope

    def _adjusted(self, values: np.ndarray, has_slopes: bool) -> Adjusted:
        given = *super().predict(values, has_slopes), self.measured, self.sigma
        return adjusted(self.unknown, *given, TWO_PI * self.frequency)

    def found(self, values: np.ndarray) -> dict[str, float]:
        return self._adjusted(values, False).found

    def sanity_error(self, values: np.ndarray) -> str:
        if GAIN in self.unknown:
            return noise_error(self.unknown, self.measured, self.sigma)
        return super().sanity_error(values)

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        model, slope = self.predict(values, has_slopes)
        away = (model - self.measured) / self.sigma
        value = np.concatenate([away.real, away.imag])
        if slope is None:
            return Residual(value, None)
        scaled = slope / self.sigma[:, None]
        return Residual(value, np.concatenate([scaled.real, scaled.imag]))

    def compare(self, values: np.ndarray) -> Line:
        model, _ = self.predict(values, False)
        label = f"response [{self._unit}]"
        return self._line(label, np.abs(self.measured), np.abs(model), values)


class Magnitude(_BenchMeasurement):
    """Absolute value alone."""

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        model, slope = self.predict(values, has_slopes)
        size = np.abs(model)
        by = None
        if slope is not None:
            unit = np.where(size > 0, model / np.where(size > 0, size, 1.0), 0.0)
            by = (unit.conj()[:, None] * slope).real
        return scaled(size, by, self.measured, self.sigma)

    def compare(self, values: np.ndarray) -> Line:
        model, _ = self.predict(values, False)
        return self._line(f"magnitude [{self._unit}]", self.measured, np.abs(model), values)


class Spectrum(_BenchMeasurement):
    """Power spectrum of the output under a white input of unknown strength.

    The mean of n periodograms is gamma distributed about the model's. Half the squared residuals
    add up to its negative log likelihood (Whittle): r = sign(x - 1) sqrt(2 n (x - 1 - ln x)) with
    x = measured/(strength model), the strength being the likeliest, mean(measured/model).
    """

    kind, n_hidden = "spectrum", 1  # the strength of the input

    def __init__(self, averages: int, *arguments: Any) -> None:
        """Arguments: n; and those of a response, with any noise."""
        super().__init__(*arguments)
        self._averages = averages
        self.mean_square = float(
            2 * averages * (np.log(averages) - scipy.special.digamma(averages))
        )

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        model, slope = self.predict(values, has_slopes)
        weight, away = self._shares(np.abs(model) ** 2)
        root = np.sqrt(self._averages) * _half_deviance(away)  # over x - 1
        if slope is None:
            return Residual(-away * root, None)
        by = 2 * (slope / model[:, None]).real
        return Residual(-away * root, (self._averages / root)[:, None] * (by - weight @ by))

    def _shares(self, model: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of each frequency in the strength, and x - 1, (f,)."""
        ratio = self.measured / model
        return ratio / ratio.sum(), ratio / ratio.mean() - 1

    def reweigh(self, values: np.ndarray) -> None:
        pass  # its noise follows from the averages

    def compare(self, values: np.ndarray) -> Line:
        model = np.abs(self.predict(values, False)[0]) ** 2
        level = np.mean(self.measured / model)
        return self._line("power spectrum [any unit]", self.measured, level * model, values)

    def sanity_error(self, values: np.ndarray) -> str:
        return ""  # any strength will do


def _half_deviance(e: np.ndarray) -> np.ndarray:
    """sqrt(2 (e - ln(1 + e)))/|e|, 1 at 0."""
    is_small = np.abs(e) < 1e-3
    large = np.where(is_small, 1.0, e)
    series = 1 - 2 * e / 3 + e**2 / 2 - 2 * e**3 / 5
    whole = 2 * (large - np.log1p(large)) / large**2
    return np.sqrt(np.where(is_small, series, whole))
