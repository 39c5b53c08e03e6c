"""Signals over the time of the study's motion."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from studies.errors import StudyError
from studies.fitting.kinds.contract import Line, Measurement, Models, Noise
from studies.fitting.kinds.entry import NoiseEntry, ThinnedEntry, ascending
from studies.fitting.kinds.motions import Motion
from studies.fitting.kinds.unknown import Adjusted, adjusted, noise_error
from studies.study.signals import OUTPUTS, Signal
from studies.study.spec import described


class TraceEntry(ThinnedEntry, NoiseEntry):
    """A signal over time of the study's motion."""

    time: str = described("time", "-", "column [s], from the start of the motion")
    value: str = described("value", "-", "column")
    unknown: tuple[Literal["gain", "offset"], ...] = described(
        (), "-", "of gain and offset, what nobody knows"
    )

    def measurement(self, models: Models, path: str) -> Measurement:
        time, value = data = np.stack(list(map(self.reader(models, path), (self.time, self.value))))
        ascending(time, self.time, path)
        longest = models.study.run.duration
        if time[0] < 0 or time[-1] > longest:
            raise StudyError(
                f"{path}: times from {time[0]:g} to {time[-1]:g} s; allowed: within the run, 0 to "
                f"{longest:g} [s] (run.duration)"
            )
        (signal,), noise = self.signals(models.study, path), self.noise(value, path)
        return Trace(self, models.motions.of(None), signal, data, noise)


class Trace(Measurement):
    """One signal over time, compared at the times of the measurement."""

    kind, is_ordered = "trace", True

    def __init__(
        self, entry: TraceEntry, motion: Motion, signal: Signal, data: np.ndarray, noise: Noise
    ) -> None:
        """
        Args:
            entry: of the file.
            motion: the run.
            signal: the output.
            data: times [s], ascending and within the run, and what was measured, (2, n).
            noise: of the measured values.
        """
        self.time, measured = data
        super().__init__(entry, measured, noise.sigma(measured))
        self.unknown = tuple(dict.fromkeys(entry.unknown))
        self.n_hidden = len(self.unknown)
        self._motion, self.signal, self._noise = motion, signal, noise
        self._unit = OUTPUTS[signal.kind][1]
        motion.add(signal)

    @property
    def patches(self) -> tuple[int, int]:
        """Links, and pairs of patches on each."""
        return self._motion.patches

    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        model, slope, _ = self._adjusted(values, has_slopes)
        return model, slope

    def _adjusted(self, values: np.ndarray, has_slopes: bool) -> Adjusted:
        run = self._motion.find(self.name, self.signal, values, has_slopes)
        model, slope = np.interp(self.time, run.time, run.value), None
        if run.slope is not None:
            by = [np.interp(self.time, run.time, x) for x in run.slope.T]
            slope = np.stack(by, axis=1)
        return adjusted(self.unknown, model, slope, self.measured, self.sigma)

    def found(self, values: np.ndarray) -> dict[str, float]:
        return self._adjusted(values, False).found

    def reweigh(self, values: np.ndarray) -> None:
        self.sigma = self._noise.of_model(self.predict(values, False)[0], self.measured)

    def compare(self, values: np.ndarray) -> Line:
        return Line(
            abscissa="time [s]",
            ordinate=f"{self.signal.kind} [{self._unit}]",
            x=self.time,
            measured=self.measured,
            model=self.predict(values, False)[0],
            away=self.residual(values, False).value,
            is_log=False,
        )

    def sanity_error(self, values: np.ndarray) -> str:
        if self.unknown:
            return noise_error(self.unknown, self.measured, self.sigma)
        model = self.predict(values, False)[0]
        ratio = float(np.ptp(self.measured) / max(np.ptp(model), 1e-300))
        if 0.01 < ratio < 100:
            return ""
        return (
            f"measured moves {ratio:.3g} times as far as the model at the starting point; expected "
            f"{self._unit}: check the unit"
        )
