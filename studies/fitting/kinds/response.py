"""Frequency responses, complex or magnitudes, as such or from raw records."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from studies.errors import StudyError, field_error
from studies.fitting.bench import Bench, response
from studies.fitting.kinds import entry as common
from studies.fitting.kinds.contract import Line, Measurement, Models, Noise, Residual, scaled
from studies.fitting.kinds.entry import (
    NoiseEntry,
    Percent,
    Positive,
    ShakenEntry,
    ThinnedEntry,
    ascending,
    unit_of,
)
from studies.fitting.kinds.unknown import GAIN, Adjusted, adjusted, noise_error
from studies.fitting.records import RecordSettings, recorded_response
from studies.fitting.uff import Side
from studies.study.signals import INPUTS
from studies.study.spec import Study, described

TWO_PI = 2 * np.pi
#: A measured response this many times the model's at the starting point has another unit [1].
OTHER_UNIT = 100.0
#: What may be unknown of a response.
Unknown = tuple[Literal["gain", "delay"], ...]


class FrequencyEntry(ShakenEntry, ThinnedEntry):
    """Fields of what is measured over frequency."""

    frequency: str = described("frequency_hz", "-", "column")

    def checked(self, frequency: np.ndarray, path: str) -> np.ndarray:
        """The column, if it can be one of frequencies."""
        ascending(frequency, self.frequency, path)
        if frequency[0] < 0 or frequency[-1] > 1e5:
            raise StudyError(
                f"{path}: frequencies from {frequency[0]:g} to {frequency[-1]:g}; allowed: "
                "0 to 100000 [Hz]"
            )
        return frequency


class ResponseEntry(FrequencyEntry, NoiseEntry):
    """A frequency response."""

    real: str = described("real", "-", "column")
    imag: str = described("imag", "-", "column")
    magnitude: str = described("", "-", "column; instead of real and imaginary part")
    unknown: Unknown = described((), "-", "of gain and delay, what nobody knows")

    def sides(self, study: Study, path: str) -> list[Side]:
        unit = INPUTS[self.signals(study, path)[0].kind][1]
        return [*super().sides(study, path), ("orddenom", f"{path}.input", self.input, unit)]

    def measurement(self, models: Models, path: str) -> Measurement:
        read = self.reader(models, path)
        frequency = self.checked(read(self.frequency), path)
        if self.magnitude:
            if self.unknown:
                raise StudyError(f"{path}.unknown: has no meaning for a magnitude")
            measured = read(self.magnitude)
            if np.any(measured < 0):
                raise StudyError(
                    f"{path}: column {self.magnitude!r} has negative magnitudes; in dB?"
                )
        elif self.file.lower().partition("::")[0].endswith((".uff", ".unv")):
            measured = read("value", is_real=False).astype(complex)
        else:
            measured = read(self.real, is_real=False)
            if not np.iscomplexobj(measured):
                measured = measured + 1j * read(self.imag)
        make = Magnitude if self.magnitude else ComplexResponse
        noise = self.noise(measured, path)
        return make(self, models.bench, frequency, measured, noise, path)


class RecordEntry(ShakenEntry):
    """Raw time records of an input and an output, which become a frequency response."""

    time: str = described("time", "-", "column [s], evenly spaced")
    source: str = described("input", "-", "column of the input")
    value: str = described("output", "-", "column of the output")
    segment_s: Positive = described(..., "s", "length of the segments that are averaged")
    window: Literal["hann", "none"] = described(
        "hann", "-", "of segments that overlap by half; none: each is an impact that has decayed"
    )
    estimator: Literal["H1", "H2"] = described(
        "H1", "-", "H1: noise on the output; H2: noise on the input"
    )
    from_hz: float = described(0.0, "Hz", "lowest frequency that is kept", ge=0, le=1e5)
    to_hz: float = described(
        0.0, "Hz", "highest one; 0: 0.4 times the sample rate of the record", ge=0, le=1e5
    )
    unknown: Unknown = described((), "-", "of gain and delay, what nobody knows")
    sigma_percent: Percent = described(
        0.2, "%", "standard deviation over the value, beside what the coherence says"
    )

    def measurement(self, models: Models, path: str) -> Measurement:
        names = self.time, self.source, self.value
        time, source, output = map(self.reader(models, path), names)
        settings = RecordSettings(
            segment=self.segment_s,
            has_window=self.window == "hann",
            is_h2=self.estimator == "H2",
            band=(self.from_hz, self.to_hz),
        )
        found = recorded_response(time, source, output, settings, path)
        if len(found.frequency) > common.MOST_ROWS:
            longest = self.segment_s * common.MOST_ROWS / len(found.frequency)
            raise field_error(
                f"{path}.segment_s",
                self.segment_s,
                f"up to {longest:.3g} for this band: a fit takes up to {common.MOST_ROWS} "
                "frequencies",
                "s",
            )
        noise = Noise(found.sigma, self.sigma_percent / 100)
        return ComplexResponse(self, models.bench, found.frequency, found.value, noise, path)


class BenchMeasurement(Measurement):
    """What responses and spectra share: one input, one output, one pose."""

    kind, is_ordered = "response", True

    def __init__(
        self,
        entry: ShakenEntry,
        bench: Bench,
        frequency: np.ndarray,
        measured: np.ndarray,
        noise: Noise,
        path: str,
    ) -> None:
        """
        Args:
            entry: of the file.
            bench: the machine.
            frequency: [Hz], (f,).
            measured: (f,).
            noise: of the measured values.
            path: of the entry, for messages.
        """
        super().__init__(entry, measured, noise.sigma(measured))
        source, output = entry.signals(bench.study, path)
        self.signals = source, output
        self._bench, self._pose = bench, entry.at(bench.study)
        self._order = entry.order(output, path)  # derivatives by time that the output has
        self.frequency, self._noise = frequency, noise
        self._unit = f"{unit_of(output, entry.quantity)}/{INPUTS[source.kind][1]}"

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


class ComplexResponse(BenchMeasurement):
    """Real and imaginary part."""

    def __init__(self, entry: ResponseEntry | RecordEntry, *arguments: Any) -> None:
        super().__init__(entry, *arguments)
        self.unknown = tuple(dict.fromkeys(entry.unknown))
        self.n_hidden = len(self.unknown)

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


class Magnitude(BenchMeasurement):
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
