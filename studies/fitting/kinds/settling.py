"""How long signals take to settle after the study's motion."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from studies.errors import StudyError, field_error
from studies.fitting.kinds.contract import Measurement, Models
from studies.fitting.kinds.entry import OutputEntry, Positive
from studies.fitting.kinds.motions import Motion, Recording
from studies.study.links import OneALink
from studies.study.signals import OUTPUTS, Signal
from studies.study.spec import described

#: A signal that moves less is at rest [its unit].
STILL = 1e-15
#: Step of derivatives through complex numbers, exact to rounding [1].
TINY = 1e-30


class SettlingEntry(OutputEntry):
    """How long a signal takes to settle after the study's motion."""

    time_s: float = described(
        ...,
        "s",
        "from the end of the reference trajectory until it stays within the band",
        ge=0,
        le=1e4,
    )
    sigma_s: Positive = described(..., "s", "standard deviation")
    band: Positive | None = described(None, "unit of the output", "to each side of 0")
    band_percent: Annotated[float, Field(ge=1e-6, lt=100)] | None = described(
        None, "%", "the same, over the largest value after the reference trajectory without control"
    )
    links: OneALink[bool] | None = described(
        None, "-", "under control; default: those of the study"
    )

    def measurement(self, models: Models, path: str) -> Measurement:
        if (self.band is None) == (self.band_percent is None):
            raise StudyError(
                f"{path}: give band [unit of the output] or band_percent [%], one of them"
            )
        (signal,), longest = self.signals(models.study, path), models.study.run.duration
        if signal.kind in ("slider", "platform", "motor"):
            forms = ", ".join(OUTPUTS[x][0] for x in ("sensor", "deflection"))
            raise field_error(f"{path}.output", self.output, f"{forms}, which settle about 0")
        if self.time_s > longest:
            allowed = f"within the run, at most {longest:g} (run.duration)"
            raise field_error(f"{path}.time_s", self.time_s, allowed, "s")
        band = Band(self.band or 0.0, None)
        if self.band_percent is not None:
            band = Band(self.band_percent / 100, models.motions.uncontrolled())
        return Settling(self, models.motions.of(self.links), signal, band)


class Band(NamedTuple):
    """Within which a signal has settled."""

    width: float  # in the unit of the signal, or a share of its largest value without control
    without: Motion | None  # the run without control, if it is a share


class Settling(Measurement):
    """Time from the end of the command until a signal stays within a band.

    The signal's envelope counts: from peak to peak it decays exponentially, so that the time and
    its derivatives are smooth while peaks sink below the band.
    """

    kind, labels = "settling", ("settling time [s]",)

    def __init__(self, entry: SettlingEntry, motion: Motion, signal: Signal, band: Band) -> None:
        """
        Args:
            entry: of the file.
            motion: the run.
            signal: the output.
            band: of the output.
        """
        super().__init__(entry, np.array([entry.time_s]), np.array([entry.sigma_s]))
        self._motion, self._signal, self._band = motion, signal, band
        for run in (motion, band.without):
            if run is not None:
                run.add(signal)

    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        run = self._motion.find(self.name, self._signal, values, has_slopes)
        level, by_level = self._level(values, has_slopes)
        entry = find_band_entry(run, level)
        if entry is None:
            raise StudyError(
                f"{self.name}: the model does not settle to {level:.3g} within the run; allowed: "
                "a wider band or a longer run.duration"
            )
        time = np.array([entry.time])
        if run.slope is None or by_level is None:
            return time, None
        size = np.sign(run.value[entry.samples])[:, None] * run.slope[entry.samples]
        return time, (entry.by_samples @ size + entry.by_level * by_level)[None]

    def _level(self, values: np.ndarray, has_slopes: bool) -> tuple[float, np.ndarray | None]:
        """The band in the unit of the signal, and its derivatives."""
        width, without = self._band
        if without is None:
            return width, np.zeros(len(values)) if has_slopes else None
        free = without.find(self.name, self._signal, values, has_slopes)
        k = int(np.argmax(np.where(free.time > free.command_end, np.abs(free.value), 0.0)))
        slope = None if free.slope is None else width * np.sign(free.value[k]) * free.slope[k]
        return width * abs(float(free.value[k])), slope

    def sanity_error(self, values: np.ndarray) -> str:
        self.predict(values, False)  # may not settle
        run = self._motion.find(self.name, self._signal, values, False)
        if np.ptp(run.value) < STILL:
            return f"the signal stays at {run.value[0]:.3g} in the model: nothing settles"
        return ""


class BandEntry(NamedTuple):
    """When a signal's envelope enters a band, and how that depends on the signal."""

    time: float  # from the end of the command [s]
    samples: np.ndarray  # that it depends on, (6,)
    by_samples: np.ndarray  # derivatives by their sizes, (6,)
    by_level: float  # derivative by the band


def find_band_entry(run: Recording, level: float) -> BandEntry | None:
    """When the envelope of a recorded signal enters a band for good.

    Args:
        run: the signal.
        level: half the width of the band, in the unit of the signal.

    Returns:
        Time 0 if no peak after the command is larger; None if the last peak still is.
    """
    size = np.abs(run.value)
    inner = (size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])
    peak = np.flatnonzero(inner & (run.time[:-2] >= run.command_end)) + 1
    outside = np.flatnonzero(size[peak] > level)
    if not outside.size:
        return BandEntry(0.0, np.arange(6), np.zeros(6), 0.0)
    last = int(outside[-1])
    if last + 1 == len(peak):
        return None
    first, second = peak[last], peak[last + 1]
    samples = np.concatenate([first + np.arange(-1, 2), second + np.arange(-1, 2)])
    start = run.time[first] - run.command_end, run.time[second] - run.command_end
    period = run.time[1] - run.time[0]
    x = np.append(size[samples], level)
    steps = x + 1j * TINY * np.diag(np.maximum(x, 1e-300))
    by = np.array([_entered(row, start, period).imag for row in steps]) / (
        TINY * np.maximum(x, 1e-300)
    )
    return BandEntry(float(_entered(x, start, period).real), samples, by[:6], float(by[6]))


def _entered(x: np.ndarray, start: tuple[float, float], period: float) -> Any:
    """Time at which the exponential between two peaks meets a level.

    Args:
        x: sizes of three samples about each peak, and the level, (7,); may be complex.
        start: times of the middle samples [s].
        period: of the samples [s].
    """
    (time, peak), (after, lower) = (
        _vertex(x[k : k + 3], at, period) for k, at in zip((0, 3), start, strict=True)
    )
    return time + (after - time) * np.log(peak / x[6]) / np.log(peak / lower)


def _vertex(x: np.ndarray, middle: float, period: float) -> tuple[Any, Any]:
    """Time and height of the parabola through three samples."""
    slope, bend = (x[2] - x[0]) / 2, x[2] - 2 * x[1] + x[0]
    return middle - period * slope / bend, x[1] - slope**2 / (2 * bend)
