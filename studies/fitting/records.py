"""Raw time records of an input and an output as a frequency response with its noise.

Segments of the record are averaged (Welch). Of a coherence g^2 over n independent segments, real
and imaginary part of the estimate each have the standard deviation |H| sqrt((1 - g^2)/(2 n g^2))
(Bendat and Piersol, Random Data, 2010, chapter 9). A window blurs what is narrower than the
reciprocal of a segment, by an error that falls with the square of its length: a third of what
segments of half the length differ by. That is taken off (Richardson), and a part of it is left as
uncertainty.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import signal

from studies.errors import StudyError, field_error

#: Independent segments in n that overlap by half under a Hann window, over n [1].
INDEPENDENT = 0.95
#: Share of a window's error that is left once it was taken off, and how much noisier that makes a
#: response [1].
LEFT, NOISIER = 0.15, 1.15
#: Steps of the time may differ by this share.
UNEVEN = 1e-3
#: Segments at least; one has no coherence.
FEWEST = 4
#: Share of the sample rate up to which responses are taken if nothing else is said [1].
HIGHEST = 0.4
#: Factor in the power of averaged cross spectra from which two clocks are seen [1].
DRIFTING = 1.5
#: A record that changes by less is still [its unit].
SMALLEST = 1e-150


class RecordSettings(NamedTuple):
    """How a record becomes a response."""

    segment: float  # length of a segment [s]
    has_window: bool  # Hann, segments overlap by half; else each one stands alone, as impacts do
    is_h2: bool  # noise is on the input rather than on the output
    band: tuple[float, float]  # frequencies that are kept [Hz]; an end of 0: as far as it goes


class RecordedResponse(NamedTuple):
    """A frequency response from records."""

    frequency: np.ndarray  # [Hz], (f,)
    value: np.ndarray  # complex, (f,)
    sigma: np.ndarray  # of real and imaginary part, (f,)
    coherence: np.ndarray  # [1], (f,)
    averages: float  # independent segments


def recorded_response(
    time: np.ndarray, source: np.ndarray, output: np.ndarray, settings: RecordSettings, path: str
) -> RecordedResponse:
    """The response of a recorded output to a recorded input.

    Args:
        time: [s], evenly spaced, (n,).
        source, output: (n,).
        settings: how.
        path: where it is written, for messages.

    Raises:
        StudyError: uneven time, records that are too short, or an input that does nothing.
    """
    step = even_step(time, path)
    size = 2 * max(round(settings.segment / (2 * step)), 1)
    last = float(time[-1] - time[0])
    hop = size // 2 if settings.has_window else size
    count = (len(time) - size) // hop + 1 if len(time) >= size else 0
    longest = last / _in_all(settings)
    if longest < 16 * step:  # no segment would do
        least = 16 * step * _in_all(settings)
        raise StudyError(
            f"{path}: a record of {last:.4g} s; allowed: {least:.4g} s or more, {FEWEST} segments "
            f"of 16 samples ({16 * step:.3g} s)"
        )
    if size < 16 or count < FEWEST:
        raise field_error(
            f"{path}.segment_s",
            settings.segment,
            f"{16 * step:.3g} to {longest:.3g}: {FEWEST} segments or more of this "
            f"record of {last:.4g} s",
            "s",
        )
    for name, x in (("input", source), ("output", output)):
        if not np.ptp(x) > SMALLEST:
            raise StudyError(f"{path}: the recorded {name} does not change")
    check_band(settings.band, step, path)
    # of size 1, so that their powers are numbers
    unit = np.std(output) / np.std(source)
    source, output = source / np.std(source), output / np.std(output)
    _check_clocks(source, output, step, size, path)
    whole = _estimate(source, output, step, size, settings)
    half = _estimate(source, output, step, size // 2, settings)
    averages = INDEPENDENT * count if settings.has_window else float(count)
    low, high = settings.band
    # neighbours are alike under a window, and segments of half the length know every other one
    frequency = whole.frequency[2::2]
    keep = (frequency >= low) & (frequency <= (high or HIGHEST / step))
    if np.sum(keep) < 3:
        raise StudyError(
            f"{path}: {int(np.sum(keep))} frequencies between from_hz = {low:g} and to_hz = "
            f"{high or HIGHEST / step:g}; allowed: 3 or more, {2 / (size * step):.3g} Hz apart"
        )
    value, coherence = unit * whole.value[2::2][keep], whole.coherence[2::2][keep]
    share = np.clip(coherence, 1e-6, 1.0)
    random = np.abs(value) * np.sqrt((1 - share) / (2 * averages * share))
    if not settings.has_window:  # segments are not cut out of what goes on
        return RecordedResponse(
            frequency=frequency[keep],
            value=value,
            sigma=random,
            coherence=coherence,
            averages=averages,
        )
    blurred = (value - unit * half.value[1 : len(frequency) + 1][keep]) / 3
    return RecordedResponse(
        frequency=frequency[keep],
        value=value + blurred,
        sigma=np.hypot(NOISIER * random, LEFT * np.abs(blurred)),
        coherence=coherence,
        averages=averages,
    )


def _check_clocks(
    source: np.ndarray, output: np.ndarray, step: float, size: int, path: str
) -> None:
    """Refuse an output that falls further behind its input from segment to segment.

    By d s a segment, cross spectra turn by -2 pi f d: their average is too small, or nothing.

    Raises:
        StudyError: turned back, the average has `DRIFTING` times the power.
    """
    count, window = len(source) // size, signal.get_window("hann", size)
    spectra = [
        np.fft.rfft(x[: count * size].reshape(count, size) * window)[:, 1:]
        for x in (source, output)
    ]
    cross, turn = spectra[1] * spectra[0].conj(), 2 * np.pi * np.fft.rfftfreq(size, step)[1:]
    drift, back, fine = 0.0, cross, 16 * size
    for apart in (1, count // 2):  # segments between those compared: near ones, then exactly
        pair = np.sum(back[apart:] * back[:-apart].conj(), axis=0)
        lag = int(np.argmax(np.fft.irfft(np.append(0, pair), fine)))
        late = step * size / fine * (lag - fine if lag > fine // 2 else lag)
        left, weight = np.angle(pair * np.exp(1j * late * turn)), np.abs(pair)
        late -= float(np.sum(weight * turn * left) / np.sum(weight * turn**2))
        drift += late / apart
        back = cross * np.exp(1j * np.outer(np.arange(count), drift * turn))
    power = [float(np.sum(np.abs(np.sum(x, axis=0)) ** 2)) for x in (cross, back)]
    if power[1] > DRIFTING * power[0]:
        raise StudyError(
            f"{path}: the output falls behind the input by {1e6 * drift / (size * step):.3g} us "
            "more each second, as if recorded with another clock; record both with one clock, or "
            f"multiply the output's time by {1 - drift / (size * step):.7g}"
        )


def check_band(band: tuple[float, float], step: float, path: str) -> None:
    """Refuse a band [Hz] that a record of this sample period [s] has not.

    Raises:
        StudyError: above half the sample rate, or empty.
    """
    low, high = band
    if high > 0.5 / step:
        most = f"up to {0.5 / step:.6g}, half the sample rate of the record"
        raise field_error(f"{path}.to_hz", high, most, "Hz")
    if low >= (high or HIGHEST / step):
        raise field_error(f"{path}.from_hz", low, f"below {high or HIGHEST / step:.6g}", "Hz")


def _in_all(settings: RecordSettings) -> float:
    """Length of `FEWEST` segments over that of one [1]."""
    return (FEWEST + 1) / 2 if settings.has_window else FEWEST


def even_step(time: np.ndarray, path: str) -> float:
    """Sample period of a record [s].

    Raises:
        StudyError: uneven time.
    """
    steps = np.diff(time)
    step = float(np.mean(steps)) if len(steps) else 0.0
    if not step > 0 or np.abs(steps - step).max() > UNEVEN * step:
        row = int(np.argmax(np.abs(steps - step))) + 2 if len(steps) else 1
        raise StudyError(
            f"{path}: time must ascend evenly, as records do; row {row} does not (or give a "
            "response with kind = 'response')"
        )
    return step


class _Estimate(NamedTuple):
    frequency: np.ndarray
    value: np.ndarray
    coherence: np.ndarray


def _estimate(
    source: np.ndarray, output: np.ndarray, step: float, size: int, settings: RecordSettings
) -> _Estimate:
    """Averages over segments of so many samples."""
    how = {
        "fs": 1 / step,
        "window": "hann" if settings.has_window else "boxcar",
        "nperseg": size,
        "noverlap": size // 2 if settings.has_window else 0,
        "detrend": "constant" if settings.has_window else False,
    }
    frequency, cross = signal.csd(source, output, **how)
    _, power = signal.welch(source, **how)
    _, answer = signal.welch(output, **how)
    power, answer = (np.maximum(x, np.finfo(float).tiny) for x in (power, answer))
    coherence = np.minimum(np.abs(cross) ** 2 / (power * answer), 1.0)
    safe = np.where(np.abs(cross) > 0, cross, np.finfo(float).tiny)
    value = answer / safe.conj() if settings.is_h2 else cross / power
    return _Estimate(frequency, value, coherence)
