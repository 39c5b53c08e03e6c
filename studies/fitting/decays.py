"""Modes of a machine that nobody shakes: from how it rings, or moves by chance.

Free decays are sums of the modes' exponentials. So are the correlations of what a machine does
under a white input that nobody knows (James, Carne and Lauffer 1995). Their poles come from the
left singular vectors U of the signals' Hankel matrix, in which one sample after the other is one
row of blocks below the other (Kung 1978; noise does not damp them, unlike the eigensystem
realisation's):

    U without its last block A = U without its first block

Every order n, of the n largest singular values, has its A and poles. Those of the machine come
again from order to order, which is the stabilisation diagram; those of noise do not. The modes'
poles are then moved to where what is left of the spectra within the band is least, which under
white noise is most likely, and gives standard deviations. Those of ambient modes are the scatter
over the record without one of its blocks at a time (jackknife).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import signal

from studies.errors import StudyError, field_error
from studies.fitting.realisation import (
    SAME_FREQUENCY,
    TWO_PI,
    RingingPoles,
    find_modes,
    find_orders,
    refined,
)
from studies.fitting.records import HIGHEST, SMALLEST, check_band, even_step

#: Damping ratio of a mode over its standard deviation, at least [1].
CLEAR = 3.0
#: A mode is found again in this share of the orders; of ambient records, whose noise is louder
#: where modes are, in more [1].
OFTEN, OFTEN_AMBIENT = 0.3, 0.5
#: Windows of a decay in which its power is looked at, and how many times as loud as the others what
#: a fit leaves of one may be [1].
WINDOWS, UNEVEN = 50, 10.0
#: Windows in which the release is sought.
FINE = 500
#: What is left of decays over them, from which on it is looked at [1].
ROUNDING = 1e-6
#: Samples over a period of the highest frequency.
DENSE = 2.6
#: Samples that the filter before them takes.
SKIPPED = 12
#: Power of a decay is lost in that of its last quarter below so many times as much [1].
LOST = 2.0
#: Samples of a decay, at least, and those that are used at most.
SHORTEST, LONGEST = 100, 2**15
#: Blocks of an ambient record.
BLOCKS = 16


class DecaySettings(NamedTuple):
    """How a record becomes modes."""

    segment: float  # length of a decay, or of the correlations [s]; 0: as long as may be
    is_ambient: bool  # excited by chance all the time, instead of left to ring
    band: tuple[float, float]  # frequencies [Hz]; a high end of 0: as far as it goes


class Diagram(NamedTuple):
    """A stabilisation diagram."""

    frequency: np.ndarray  # of the poles of all orders [Hz], (n,)
    order: np.ndarray  # (n,)
    is_stable: np.ndarray  # come again from the order below, (n,)
    chosen: np.ndarray  # of the modes [Hz], (k,)
    spectrum: tuple[np.ndarray, np.ndarray]  # [Hz], power of all signals over its peak [1]


class DecayModes(NamedTuple):
    """Modes from records."""

    frequency: np.ndarray  # [Hz], ascending, (k,)
    sigma: np.ndarray  # [Hz], (k,)
    damping: np.ndarray  # [1], (k,)
    damping_sigma: np.ndarray  # [1], (k,)
    shapes: np.ndarray  # complex, of all signals, (k, c)
    diagram: Diagram


def decay_modes(
    time: np.ndarray, signals: np.ndarray, settings: DecaySettings, path: str
) -> DecayModes:
    """Modes of a machine from records of its free or ambient vibration.

    Args:
        time: [s], evenly spaced, (n,).
        signals: in any units, (n, c).
        settings: how.
        path: where it is written, for messages.

    Raises:
        StudyError: uneven time, records that are too short or do not change, no mode in the band.
    """
    step = even_step(time, path)
    check_band(settings.band, step, path)
    band = settings.band[0], settings.band[1] or HIGHEST / step
    size = np.ptp(signals, axis=0)
    if not np.all(size > SMALLEST):
        raise StudyError(f"{path}: recorded signal {int(np.argmin(size)) + 1} does not change")
    scale = signals.std(axis=0)
    thinned, step = _thinned(signals / scale, step, band[1])
    cut = _correlations if settings.is_ambient else _segments
    blocks = cut(thinned, step, settings.segment, path)
    blocks = blocks[:, : _loud(blocks.mean(axis=0))]
    whole = blocks.mean(axis=0)
    orders = find_orders(whole, step, band)
    modes, is_stable = find_modes(orders, OFTEN_AMBIENT if settings.is_ambient else OFTEN)
    value = sigma = np.zeros((2, 0))
    if len(modes.size) and settings.is_ambient:
        value, sigma = _jackknifed(blocks, modes, step, band, path)
    elif len(modes.size):
        value, sigma, rest = refined(whole, modes, step, band, path)
        if np.std(rest) > ROUNDING * np.std(whole):
            _check_rest(rest, step, path)
    is_found = (sigma[0] < SAME_FREQUENCY) & (value[1] > CLEAR * sigma[1])
    if not is_found.any():
        raise StudyError(
            f"{path}: no mode from {band[0]:g} to {band[1]:.4g} Hz stands out of the noise; "
            "allowed: longer or louder records, or a band where there are modes"
        )
    (size, damping), sigma = value[:, is_found], sigma[:, is_found]
    ascending = np.argsort(size)
    shapes = (modes.shape * scale)[is_found][ascending]
    hertz = size[ascending] / TWO_PI
    return DecayModes(
        frequency=hertz,
        sigma=hertz * sigma[0, ascending],
        damping=damping[ascending],
        damping_sigma=sigma[1, ascending],
        shapes=shapes / np.abs(shapes).max(axis=1, keepdims=True),
        diagram=Diagram(
            frequency=np.concatenate([x.size for x in orders]) / TWO_PI,
            order=np.repeat(2 + 2 * np.arange(len(orders)), [len(x.size) for x in orders]),
            is_stable=np.concatenate(is_stable),
            chosen=hertz,
            spectrum=_spectrum(thinned, step, band),
        ),
    )


def _thinned(signals: np.ndarray, step: float, high: float) -> tuple[np.ndarray, float]:
    """Signals at a rate that the band needs. A causal filter leaves decays what they are."""
    every = int(1 / (step * DENSE * high))
    if every < 2:
        return signals, step
    sections = signal.cheby1(8, 0.05, 0.8 / every, output="sos")
    return signal.sosfilt(sections, signals, axis=0)[::every], step * every


def _segments(signals: np.ndarray, step: float, length: float, path: str) -> np.ndarray:
    """Decays one after another, as if the machine were the same with as many inputs.

    Returns:
        one block, (1, t, c, decays).
    """
    size = round(length / step) or len(signals)
    if len(signals) < SHORTEST:
        raise StudyError(
            f"{path}: a record of {len(signals) * step:.3g} s; allowed: {SHORTEST * step:.3g} s or "
            "more for this band"
        )
    if not SHORTEST <= size <= len(signals):
        allowed = f"{SHORTEST * step:.3g} to {len(signals) * step:.4g}, the length of the record"
        raise field_error(f"{path}.segment_s", length, allowed, "s")
    count = len(signals) // size
    pieces = signals[: count * size].reshape(count, size, -1)[:, SKIPPED:]
    pieces = pieces - pieces[:, -(size // 4) :].mean(axis=1, keepdims=True)
    # what was recorded before the release is no decay
    power = _windowed(np.moveaxis(pieces, 0, -1), FINE)
    last = int(power.argmax(axis=0).max())
    start = (last + 1) * max((size - SKIPPED) // FINE, 1) if last else 0
    if size - SKIPPED - start < SHORTEST - SKIPPED or start > size // 2:
        raise StudyError(
            f"{path}: loudest {start * step:.3g} s after the start of a decay of {size * step:.3g} "
            "s (segment_s); allowed: decays that begin in its first half"
        )
    return np.asarray(np.moveaxis(pieces[:, start:], 0, -1)[None])


def _windowed(signals: np.ndarray, count: int = WINDOWS) -> np.ndarray:
    """Power in so many windows, (count or a few more, ...), of signals (t, c, ...)."""
    width = max(len(signals) // count, 1)
    power = np.sum(signals**2, axis=1)[: len(signals) // width * width]
    return np.asarray(power.reshape(-1, width, *power.shape[1:]).mean(axis=1))


def _correlations(signals: np.ndarray, step: float, length: float, path: str) -> np.ndarray:
    """Correlations of all signals with all in successive blocks of the record.

    Returns:
        (blocks, t, c, c).
    """
    block = len(signals) // BLOCKS
    if block // 2 < SHORTEST:
        raise StudyError(
            f"{path}: an ambient record of {len(signals) * step:.4g} s; allowed: "
            f"{2 * SHORTEST * BLOCKS * step:.3g} s or more for this band"
        )
    size = min(round(length / step) or block // 2, LONGEST)
    if not SHORTEST <= size <= block // 2:
        allowed = f"{SHORTEST * step:.3g} to {block // 2 * step:.4g} of this record"
        raise field_error(f"{path}.segment_s", length, allowed, "s")
    pieces = signals[: BLOCKS * block].reshape(BLOCKS, block, -1)
    spectra = np.fft.rfft(pieces - pieces.mean(axis=1, keepdims=True), 2 * block, axis=1)
    lags = np.arange(SKIPPED, size)
    found = [
        np.fft.irfft(spectra * spectra[..., k : k + 1].conj(), axis=1)[:, lags]
        for k in range(signals.shape[1])
    ]
    return np.stack(found, axis=-1) / (block - lags)[:, None, None]


def _loud(signals: np.ndarray) -> int:
    """Samples until decays, (t, c, r), are lost in what is left at their end."""
    smooth = _windowed(signals.reshape(len(signals), -1))
    width = max(len(signals) // WINDOWS, 1)
    quiet = smooth <= LOST * smooth[-len(smooth) // 4 :].mean()
    first = int(np.argmax(quiet)) if quiet.any() else len(smooth)
    return min(max(first * width, SHORTEST - SKIPPED), LONGEST)


def _check_rest(rest: np.ndarray, step: float, path: str) -> None:
    """Refuse what modes leave of decays if it has a beginning of its own."""
    power = _windowed(rest)
    # modes that decay at once are left at the start, and a band has ends
    late = power[WINDOWS // 10 : -WINDOWS // 10]
    k = int(late.argmax())
    if late[k] > UNEVEN * np.median(power):
        at = (WINDOWS // 10 + k) * (len(rest) // WINDOWS) * step
        raise StudyError(
            f"{path}: what its modes leave of the decays is {late[k] / np.median(power):.3g} times "
            f"as loud {at:.3g} s after their start as usual: something else begins there; allowed: "
            "segment_s from one release to the next"
        )


def _jackknifed(
    blocks: np.ndarray, modes: RingingPoles, step: float, band: tuple[float, float], path: str
) -> tuple[np.ndarray, np.ndarray]:
    """`refined` of ambient records; deviations by the scatter without one block each."""
    whole, count = blocks.sum(axis=0), len(blocks)
    value, *_ = refined(whole / count, modes, step, band, path)
    tried = np.array(
        [refined((whole - x) / (count - 1), modes, step, band, path)[0] for x in blocks]
    )
    tried[:, 0] /= value[0]
    return value, np.sqrt((count - 1) ** 2 / count * np.var(tried, axis=0, ddof=1))


def _spectrum(
    signals: np.ndarray, step: float, band: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    size = max(2048, round(100 / (step * (band[1] - band[0]))))
    frequency, power = signal.welch(signals, 1 / step, nperseg=min(len(signals), size), axis=0)
    kept = (frequency >= band[0]) & (frequency <= band[1])
    total = power.sum(axis=1)[kept]
    return frequency[kept], total / total.max()
