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

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import optimize, signal

from studies.errors import StudyError, field_error
from studies.fitting.records import HIGHEST, SMALLEST, check_band, even_step

#: Orders of the stabilisation diagram.
ORDERS = range(2, 62, 2)
#: Poles are the same where frequency [1] and damping ratio [1] differ by less, and shapes are
#: as much alike (MAC) [1]; refinement moves them by up to so many times as much.
SAME_FREQUENCY, SAME_DAMPING, SAME_SHAPE, MOVED = 0.005, 0.003, 0.95, 4.0
#: Damping ratio of a mode over its standard deviation, at least [1].
CLEAR = 2.0
#: A mode is found again in this share of the orders [1].
OFTEN = 0.5
#: Poles of less and of more damping are no modes [1].
LEAST_DAMPED, MOST_DAMPED = 1e-6, 0.2
#: Rows and columns of the Hankel matrix.
LARGEST = 600
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
TWO_PI = 2 * np.pi


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


class _Poles(NamedTuple):
    """Oscillating poles."""

    size: np.ndarray  # [1/s], (m,)
    damping: np.ndarray  # [1], (m,)
    shape: np.ndarray  # of size 1, (m, c)

    def at(self, index: np.ndarray) -> _Poles:
        """Some of them."""
        return _Poles(self.size[index], self.damping[index], self.shape[index])

    def distance(self, other: _Poles) -> np.ndarray:
        """How far they are from others; up to 1 they are the same, (m, others)."""
        mac = np.abs(self.shape.conj() @ other.shape.T) ** 2
        return np.maximum.reduce(
            [
                np.abs(np.log(self.size[:, None] / other.size)) / SAME_FREQUENCY,
                np.abs(self.damping[:, None] - other.damping) / SAME_DAMPING,
                (1 - mac) / (1 - SAME_SHAPE),
            ]
        )


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
    orders = _orders(whole, step, band)
    modes, is_stable = _modes(orders)
    value = sigma = np.zeros((2, 0))
    if len(modes.size) and settings.is_ambient:
        value, sigma = _jackknifed(blocks, modes, step, band)
    elif len(modes.size):
        value, sigma = _refined(whole, modes, step, band)
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
            order=np.repeat(ORDERS[: len(orders)], [len(x.size) for x in orders]),
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
    if not SHORTEST <= size <= len(signals):
        allowed = f"{SHORTEST * step:.3g} to {len(signals) * step:.4g}, the length of the record"
        raise field_error(f"{path}.segment_s", length, allowed, "s")
    count = len(signals) // size
    pieces = signals[: count * size].reshape(count, size, -1)[:, SKIPPED:]
    return np.asarray(np.moveaxis(pieces, 0, -1)[None])


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
    power = (signals**2).reshape(len(signals), -1).sum(axis=1)
    width = max(len(power) // 50, 1)
    smooth = power[: len(power) // width * width].reshape(-1, width).mean(axis=1)
    quiet = smooth <= LOST * smooth[-len(smooth) // 4 :].mean()
    first = int(np.argmax(quiet)) if quiet.any() else len(smooth)
    return min(max(first * width, SHORTEST - SKIPPED), LONGEST)


def _observability(signals: np.ndarray) -> tuple[np.ndarray, int]:
    """Columns that span what outputs can be seen in successive samples, (rows c, n), and c.

    Args:
        signals: free responses, (t, c, r).
    """
    length, c, r = signals.shape
    rows = max(min(length // 2, LARGEST // c), 2)
    starts = np.arange(0, length - rows + 1, -(-(length - rows + 1) * r // LARGEST))
    windows = np.lib.stride_tricks.sliding_window_view(signals, rows, axis=0)[starts]
    hankel = windows.transpose(3, 1, 0, 2).reshape(rows * c, -1)
    left, size, _ = np.linalg.svd(hankel, full_matrices=False)
    kept = slice(min(ORDERS[-1], int(np.sum(size > 1e-12 * size[0]))))
    return left[:, kept], c


def _transition(seen: np.ndarray, c: int) -> np.ndarray:
    """A, by what the next sample's outputs are of this one's, (n, n)."""
    return np.asarray(np.linalg.lstsq(seen[:-c], seen[c:], rcond=None)[0])


def _orders(signals: np.ndarray, step: float, band: tuple[float, float]) -> list[_Poles]:
    """Poles within the band, order by order."""
    seen, c = _observability(signals)
    found: list[_Poles] = []
    for n in ORDERS:
        if n > seen.shape[1] and found:
            break
        value, vector = np.linalg.eig(_transition(seen[:, :n], c))
        pole = np.log(np.where(value == 0, 1e-30, value).astype(complex)) / step
        size = np.maximum(np.abs(pole), 1e-30)
        damping, shape = -pole.real / size, (seen[:c, :n] @ vector).T
        is_mode = (pole.imag > 0) & (damping > LEAST_DAMPED) & (damping < MOST_DAMPED)
        is_mode &= (size >= TWO_PI * band[0]) & (size <= TWO_PI * band[1])
        norm = np.linalg.norm(shape, axis=1, keepdims=True)
        found.append(_Poles(size, damping, shape / np.maximum(norm, 1e-300)).at(is_mode))
    return found


def _modes(orders: list[_Poles]) -> tuple[_Poles, list[np.ndarray]]:
    """Poles that come again from order to order, and which of each order do.

    From the highest order down, stable poles are paired with those already found.
    """
    below = [orders[0].at(np.zeros(0, int)), *orders]  # of the lowest order there is none
    is_stable = [np.any(high.distance(low) <= 1, axis=1) for low, high in pairwise(below)]
    modes = orders[-1].at(is_stable[-1])
    last, count = modes, np.ones(len(modes.size))
    for poles, is_kept in zip(orders[-2::-1], is_stable[-2::-1], strict=True):
        stable = poles.at(is_kept)
        away = last.distance(stable)
        mine, others = optimize.linear_sum_assignment(np.minimum(away, 1e3))
        is_same = away[mine, others] <= 1
        count[mine[is_same]] += 1
        new = stable.at(np.setdiff1d(np.arange(len(stable.size)), others[is_same]))
        for x, y in zip(last, stable, strict=True):
            x[mine[is_same]] = y[others[is_same]]
        modes, last = (_joined(x, new) for x in (modes, last))
        count = np.append(count, np.ones(len(new.size)))
    return modes.at(count >= OFTEN * len(orders)), is_stable


def _joined(one: _Poles, other: _Poles) -> _Poles:
    return _Poles(*(np.concatenate(x) for x in zip(one, other, strict=True)))


def _refined(
    signals: np.ndarray, modes: _Poles, step: float, band: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Most likely sizes and damping ratios of decays, (2, k), and their standard deviations.

    The spectra of decays that are cut off are sums of r/(1 - z q) and its conjugate, z = e^(p T),
    q = e^(-i w T), and of 1 and 1/(1 - q) from modes above and below the band; amplitudes are
    projected out.
    """
    frequency = np.fft.rfftfreq(len(signals), step)
    kept = (frequency > 0) & (frequency >= band[0]) & (frequency <= band[1])
    q = np.exp(-1j * TWO_PI * frequency[kept] * step)[:, None]
    spectra = np.fft.rfft(signals.reshape(len(signals), -1), axis=0)[kept]
    data = np.concatenate([spectra.real, spectra.imag])

    def values(x: np.ndarray) -> np.ndarray:
        away = x.reshape(2, -1)
        size = modes.size * np.exp(SAME_FREQUENCY * away[0])
        return np.stack([size, np.clip(modes.damping + SAME_DAMPING * away[1], LEAST_DAMPED, 0.99)])

    def left(x: np.ndarray) -> np.ndarray:
        size, damping = values(x)
        z = np.exp(size * step * (1j * np.sqrt(1 - damping**2) - damping))
        one, other = 1 / (1 - z * q), 1 / (1 - z.conj() * q)
        terms = np.hstack([one + other, 1j * (one - other), np.ones_like(q), 1 / (1 - q)])
        base = np.linalg.qr(np.concatenate([terms.real, terms.imag]))[0]
        return np.asarray(data - base @ (base.T @ data))

    start = np.zeros(2 * len(modes.size))
    weight = 1 / np.maximum(np.std(left(start), axis=0), 1e-12)
    found = optimize.least_squares(lambda x: (weight * left(x)).ravel(), start, x_scale="jac")
    freedom = data.size - len(start) - (len(start) + 2) * data.shape[1]
    spread = np.linalg.pinv(found.jac.T @ found.jac) * 2 * found.cost / max(freedom, 1)
    value, sigma = values(found.x), np.sqrt(np.maximum(np.diag(spread), 0.0)).reshape(2, -1)
    is_lost = (np.abs(found.x.reshape(2, -1)) > MOVED).any(axis=0) | (value[1] <= LEAST_DAMPED)
    value[:, is_lost] = np.nan
    return value, sigma * np.array([[SAME_FREQUENCY], [SAME_DAMPING]])


def _jackknifed(
    blocks: np.ndarray, modes: _Poles, step: float, band: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """The same of ambient records, by the scatter without one block each."""
    whole, count = blocks.sum(axis=0), len(blocks)
    value, _ = _refined(whole / count, modes, step, band)
    tried = np.array([_refined((whole - x) / (count - 1), modes, step, band)[0] for x in blocks])
    tried[:, 0] /= value[0]
    return value, np.sqrt((count - 1) ** 2 / count * np.var(tried, axis=0, ddof=1))


def _spectrum(
    signals: np.ndarray, step: float, band: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    frequency, power = signal.welch(signals, 1 / step, nperseg=min(len(signals), 2048), axis=0)
    kept = (frequency >= band[0]) & (frequency <= band[1])
    total = power.sum(axis=1)[kept]
    return frequency[kept], total / total.max()
