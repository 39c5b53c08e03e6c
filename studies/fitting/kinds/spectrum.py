"""Power spectra under a white input of unknown strength."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from studies.errors import StudyError
from studies.fitting.kinds.contract import Line, Measurement, Models, Noise, Residual
from studies.fitting.kinds.response import BenchMeasurement, FrequencyEntry
from studies.study.spec import described


class SpectrumEntry(FrequencyEntry):
    """A power spectrum under a white input of unknown strength."""

    density: str = described("density", "-", "column, unit^2/Hz in any scale")
    averages: int = described(1, "1", "independent spectra in the mean", ge=1, le=10**6)

    def measurement(self, models: Models, path: str) -> Measurement:
        frequency, density = map(self.reader(models, path), (self.frequency, self.density))
        keep = self.checked(frequency, path) > 0  # the mean says nothing about white noise
        if np.any(density[keep] <= 0):
            raise StudyError(
                f"{path}: column {self.density!r} has values that are not positive; in dB?"
            )
        data = frequency[keep], density[keep], Noise(0.0, 0.0)
        return Spectrum(self, models.bench, *data, path)


class Spectrum(BenchMeasurement):
    """Power spectrum of the output under a white input of unknown strength.

    The mean of n periodograms is gamma distributed about the model's. Half the squared residuals
    add up to its negative log likelihood (Whittle): r = sign(x - 1) sqrt(2 n (x - 1 - ln x)) with
    x = measured/(strength model), the strength being the likeliest, mean(measured/model).
    """

    kind, n_hidden = "spectrum", 1  # the strength of the input

    def __init__(self, entry: SpectrumEntry, *arguments: Any) -> None:
        super().__init__(entry, *arguments)
        n = self._averages = entry.averages
        self.mean_square = float(2 * n * (np.log(n) - scipy.special.digamma(n)))

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
