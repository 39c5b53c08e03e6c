"""Poles of free responses, order by order, and the most likely ones of those that come again."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import optimize

from studies.errors import StudyError

#: Orders of the stabilisation diagram.
ORDERS = range(2, 62, 2)
#: Poles are the same where frequency [1] and damping ratio [1] differ by less, and shapes are
#: as much alike (MAC) [1]; refinement moves them by up to so many times as much.
SAME_FREQUENCY, SAME_DAMPING, SAME_SHAPE, MOVED = 0.005, 0.003, 0.95, 4.0
#: Poles of less and of more damping are no modes [1].
LEAST_DAMPED, MOST_DAMPED = 1e-6, 0.2
#: Singular values below this share of the largest are rounding [1].
EXACT = 1e-9
#: Rows and columns of the Hankel matrix.
LARGEST = 600
#: Spectral lines of a band, over the numbers that they determine [1].
FEWEST_LINES = 1.5
TWO_PI = 2 * np.pi


class RingingPoles(NamedTuple):
    """Oscillating poles."""

    size: np.ndarray  # [1/s], (m,)
    damping: np.ndarray  # [1], (m,)
    shape: np.ndarray  # of size 1, (m, c)

    def at(self, index: np.ndarray) -> RingingPoles:
        """Some of them."""
        return RingingPoles(self.size[index], self.damping[index], self.shape[index])

    def distance(self, other: RingingPoles) -> np.ndarray:
        """How far they are from others; up to 1 they are the same, (m, others)."""
        mac = np.abs(self.shape.conj() @ other.shape.T) ** 2
        return np.maximum.reduce(
            [
                np.abs(np.log(self.size[:, None] / other.size)) / SAME_FREQUENCY,
                np.abs(self.damping[:, None] - other.damping) / SAME_DAMPING,
                (1 - mac) / (1 - SAME_SHAPE),
            ]
        )


def _realised(
    signals: np.ndarray, rows: int, every: int, noise: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """What outputs can be seen in successive samples, in columns, and the states' course.

    Args:
        signals: free responses, (t, c, r).
        rows: samples in a block column of their Hankel matrix.
        every: how many samples a column is after the one before.
        noise: singular values below this share of the largest are left out [1].

    Returns:
        (rows c, n), (n, columns), c.
    """
    starts = np.arange(0, len(signals) - rows + 1, every)
    windows = np.lib.stride_tricks.sliding_window_view(signals, rows, axis=0)[starts]
    hankel = windows.transpose(3, 1, 2, 0).reshape(rows * signals.shape[1], -1)
    left, size, right = np.linalg.svd(hankel, full_matrices=False)
    kept = size > noise * size[0]
    return left[:, kept], size[kept, None] * right[kept], signals.shape[1]


def _transition(seen: np.ndarray, c: int) -> np.ndarray:
    """A, by what the next sample's outputs are of this one's, (n, n)."""
    return np.asarray(np.linalg.lstsq(seen[:-c], seen[c:], rcond=None)[0])


def ringing_poles(signals: np.ndarray, depth: int, noise: float) -> np.ndarray:
    """Discrete poles in a free response [1], those of the largest amplitude at its end first.

    Args:
        signals: from some sample after the last excitation on, (t, c).
        depth: samples in a block column.
        noise: singular values below this share of the largest are noise [1].
    """
    seen, course, c = _realised(signals[..., None], depth, 1, noise)
    value, vector = np.linalg.eig(_transition(seen, c))
    last = np.linalg.lstsq(vector, course[:, -1].astype(complex), rcond=None)[0]
    return np.asarray(value[np.argsort(-np.abs(last))])


def find_orders(signals: np.ndarray, step: float, band: tuple[float, float]) -> list[RingingPoles]:
    """Poles within the band, order by order."""
    length, c, r = signals.shape
    rows = max(min(length // 2, LARGEST // c), 2)
    seen, _, c = _realised(signals, rows, -(-(length - rows + 1) * r // LARGEST), EXACT)
    seen = seen[:, : ORDERS[-1]]
    found: list[RingingPoles] = []
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
        found.append(RingingPoles(size, damping, shape / np.maximum(norm, 1e-300)).at(is_mode))
    if len(found) < len(ORDERS):  # without noise the last one says it all
        found += [found[-1]] * (len(found) + 1)
    return found


def find_modes(orders: list[RingingPoles], often: float) -> tuple[RingingPoles, list[np.ndarray]]:
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
    return modes.at(count >= often * len(orders)), is_stable


def _joined(one: RingingPoles, other: RingingPoles) -> RingingPoles:
    return RingingPoles(*(np.concatenate(x) for x in zip(one, other, strict=True)))


def refined(
    signals: np.ndarray, modes: RingingPoles, step: float, band: tuple[float, float], path: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Most likely sizes and damping ratios of decays, (2, k), their standard deviations, the rest.

    The spectra of decays that are cut off are sums of r/(1 - z q) and its conjugate, z = e^(p T),
    q = e^(-i w T), and of 1 and 1/(1 - q) from modes above and below the band; amplitudes are
    projected out.
    """
    frequency = np.fft.rfftfreq(len(signals), step)
    kept = (frequency > 0) & (frequency >= band[0]) & (frequency <= band[1])
    lines, least = int(kept.sum()), int(FEWEST_LINES * (2 * len(modes.size) + 2))
    if lines < least:
        raise StudyError(
            f"{path}: {lines} spectral lines from {band[0]:g} to {band[1]:.4g} Hz, "
            f"{1 / (len(signals) * step):.3g} Hz apart; allowed: {least} or more for "
            f"{len(modes.size)} modes (a wider band, or longer decays)"
        )
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
    rest = np.zeros((len(frequency), data.shape[1]), complex)
    rest[kept] = np.array([1, 1j]) @ left(found.x).reshape(2, lines, -1).swapaxes(0, 1)
    in_time = np.fft.irfft(rest, len(signals), axis=0)
    return value, sigma * np.array([[SAME_FREQUENCY], [SAME_DAMPING]]), in_time
