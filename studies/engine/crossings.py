"""Phase and delay margins of loops in a few milliseconds, in NumPy.

A common phase or delay makes a loop unstable where it turns an eigenvalue of L into -1, so where
that has modulus 1. Eigenvalues at neighbouring frequencies of a grid show these places; each is
then solved for with the complete response. A delay turns the images of the spectrum differently:
where they matter, eigenvalues are taken at `LEVELS` parts of a sample.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel.loop_figures import MOST_DELAY, MOST_PHASE
from jaxmodel.robustness import MarginPlace
from studies.engine.loop_gain import LoopGains
from studies.engine.margin_grid import GridGain, perron_radius

#: Eigenvalues are computed where they can be at least this [1].
STRONG = 0.9
#: Delays within a sample, and the change that half a sample makes beside its phase for which they
#: are needed [1].
LEVELS, MATTERS = 8, 0.03
#: Peaks of the largest eigenvalue just below 1 per loop, near which one more frequency is taken.
PEAKS = 4
#: Step of a delay for its derivative [samples].
SLIGHT = 0.01
#: Points between neighbouring frequencies where a crossing is looked at again, and how much later
#: than the first ones may be, as a factor.
BETWEEN, LATER = 6, 10.0
#: Places per loop that are solved for, steps at most, and the residual that ends them.
SOLVED, STEPS, RESIDUAL = 12, 8, 1e-9


class _Places(NamedTuple):
    """Where an eigenvalue of L has modulus 1, (p,) each."""

    loop: np.ndarray  # number
    level: np.ndarray  # further delay [samples]
    omega: np.ndarray  # [rad/s]
    log: np.ndarray  # of -eigenvalue: its angle, -pi to pi, times j
    slope: np.ndarray  # of the same by omega, complex [s]
    left: np.ndarray  # neighbouring frequencies [rad/s]
    right: np.ndarray
    column: np.ndarray  # of the left one

    def chosen(self, rows: np.ndarray) -> _Places:
        """Some of them."""
        return _Places(*(x[rows] for x in self))


def _joined(parts: list[_Places]) -> _Places:
    return _Places(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def phase_margins(loops: LoopGains, grid: GridGain) -> MarginPlace:
    """Smallest common phase of all commands that makes stable loops unstable [deg], (n,) each."""
    omega, _, eigenvalue = _searched(loops, grid)
    places = _crossings(omega, eigenvalue, np.arange(len(omega)))
    first = _early(places, np.abs(places.log.imag), len(omega))
    places = _looked_again(loops, places.chosen(first))
    sign = np.where(places.log.imag < 0, -1.0, 1.0)

    def eigenvalues(rows: np.ndarray, omega: np.ndarray, t: np.ndarray) -> np.ndarray:
        turned = np.exp(-1j * sign[rows] * t)[:, None]
        found = np.linalg.eigvals(loops.part(places.loop[rows]).exact(omega[:, None])[:, 0])
        return found * turned

    found = _smallest(places, np.abs(places.log.imag), sign, -1j * sign, eigenvalues, len(omega))
    return found._replace(value=np.minimum(np.rad2deg(found.value), MOST_PHASE))


def delay_margins(loops: LoopGains, grid: GridGain) -> MarginPlace:
    """Smallest common further delay that makes stable loops unstable [samples], (n,) each."""
    # images that add up at once may cancel later, and the other way round
    turned = loops.at_delay(grid.omega, np.full(grid.omega.shape, 0.5))
    later = grid._replace(radius=np.maximum(grid.radius, perron_radius(turned)))
    omega, gain, at_once = _searched(loops, later)
    n = len(omega)
    angle = omega * loops.period[:, None]
    half = loops.at_delay(omega, np.full(omega.shape, 0.5))
    change = np.linalg.norm(half * np.exp(0.5j * angle)[..., None, None] - gain, axis=(2, 3))
    is_mixed = change > MATTERS * np.linalg.norm(gain, axis=(2, 3))
    places = _crossings(omega, at_once, np.arange(n))
    plain = places.chosen(~_is_in(is_mixed, places))
    plain = plain.chosen(_early(plain, _delays(loops, plain)[0], n))
    plain = _looked_again(loops, plain)
    found = [(plain, *_delays(loops, plain))]
    if is_mixed.any():
        found.append(_at_levels(loops, omega, is_mixed))
    places = _joined([x[0] for x in found])
    delay, rate = (np.concatenate([x[k] for x in found]) for k in (1, 2))

    def eigenvalues(rows: np.ndarray, omega: np.ndarray, t: np.ndarray) -> np.ndarray:
        part = loops.part(places.loop[rows])
        return np.linalg.eigvals(part.exact(omega[:, None], t[:, None])[:, 0])

    late = _smallest(places, delay, np.ones(len(delay)), rate, eigenvalues, n)
    return late._replace(value=np.minimum(late.value, MOST_DELAY))


def _searched(loops: LoopGains, grid: GridGain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies that matter [rad/s], rising, (n, Q), L there, and its eigenvalues.

    Where the largest modulus peaks just below 1 at a frequency of the grid, it may exceed 1 beside
    it: so also where a parabola through three moduli has its top.
    """
    columns = _columns(grid.radius >= STRONG)
    omega = np.take_along_axis(grid.omega, columns, axis=1)
    gain = np.take_along_axis(grid.gain, columns[..., None, None], axis=1)
    eigenvalue = np.linalg.eigvals(gain)
    size = np.abs(eigenvalue).max(axis=2)
    before, middle, after = size[:, :-2], size[:, 1:-1], size[:, 2:]
    is_peak = (middle >= before) & (middle >= after) & (middle >= STRONG) & (middle < 1)
    if not is_peak.any():
        return omega, gain, eigenvalue
    highest = np.argsort(-np.where(is_peak, middle, 0.0), axis=1)[:, :PEAKS]
    tops = _tops(omega, size)
    top = np.take_along_axis(np.where(is_peak, tops, omega[:, 1:-1]), highest, axis=1)
    there = loops.searched(top)
    order = np.argsort(np.concatenate([omega, top], axis=1), axis=1)

    def ordered(*parts: np.ndarray) -> np.ndarray:
        whole = np.concatenate(parts, axis=1)
        return np.take_along_axis(whole, order.reshape(*order.shape, *[1] * (whole.ndim - 2)), 1)

    return (
        ordered(omega, top),
        ordered(gain, there),
        ordered(eigenvalue, np.linalg.eigvals(there)),
    )


def _tops(omega: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Tops of parabolas through every three neighbours, between the outer two, (n, Q - 2)."""
    step, rise = np.diff(omega, axis=1), np.diff(size, axis=1)
    left, right = step[:, :-1], step[:, 1:]
    with np.errstate(all="ignore"):  # frequencies that fill up are equal
        into, out = rise[:, :-1] / left, rise[:, 1:] / right
        move = (into * right + out * left) / (2 * (into - out))
    move = np.nan_to_num(move, nan=0.0, posinf=0.0, neginf=0.0)
    return omega[:, 1:-1] + np.clip(move, -left, right)


def _delays(loops: LoopGains, places: _Places) -> tuple[np.ndarray, np.ndarray]:
    """Delays that turn an eigenvalue into -1 [samples] without images, and rates of its log."""
    angle = places.omega * loops.period[places.loop]
    return np.mod(places.log.imag, 2 * np.pi) / angle, -1j * angle


def _is_in(columns: np.ndarray, places: _Places) -> np.ndarray:
    return columns[places.loop, places.column] | columns[places.loop, places.column + 1]


def _columns(is_chosen: np.ndarray) -> np.ndarray:
    """Columns chosen in any row and their neighbours, rising, (n, Q); other ones fill up."""
    near = is_chosen.copy()
    near[:, 1:] |= is_chosen[:, :-1]
    near[:, :-1] |= is_chosen[:, 1:]
    count = max(2, int(near.sum(axis=1).max()))
    return np.sort(np.argsort(~near, axis=1, kind="stable")[:, :count], axis=1)


def _early(places: _Places, t: np.ndarray, n: int) -> np.ndarray:
    """Which places can be the first of their loop, by t as it seems so far, (p,)."""
    first = np.full(n, np.inf)
    np.minimum.at(first, places.loop, t)
    return t <= LATER * first[places.loop] + 1e-3


def _looked_again(loops: LoopGains, places: _Places) -> _Places:
    """The crossings between the neighbouring frequencies of places, on a finer grid."""
    ends = np.stack([places.loop, places.left, places.right, places.level], axis=1)
    rows = np.unique(ends, axis=0, return_index=True)[1]
    chosen = places.chosen(rows)
    share = np.linspace(0, 1, BETWEEN + 2)
    omega = chosen.left[:, None] + (chosen.right - chosen.left)[:, None] * share
    level = np.broadcast_to(chosen.level[:, None], omega.shape)
    gain = loops.part(chosen.loop).at_delay(omega, level)
    return _crossings(omega, np.linalg.eigvals(gain), chosen.loop, chosen.level)


def _crossings(
    omega: np.ndarray, eigenvalue: np.ndarray, loop: np.ndarray, level: np.ndarray | None = None
) -> _Places:
    """Places between neighbouring columns.

    Args:
        omega: rising [rad/s], (r, Q).
        eigenvalue: (r, Q, m).
        loop: of each row, (r,).
        level: further delay of each row [samples], (r,); None: 0.
    """
    left, right = eigenvalue[:, :-1], eigenvalue[:, 1:]
    apart = np.abs(left[..., :, None] - right[..., None, :])
    to_right, to_left = apart.argmin(axis=3), apart.argmin(axis=2)
    # a pair found from both sides is one
    is_new = np.take_along_axis(to_right, to_left, axis=2) != np.arange(eigenvalue.shape[2])
    level, parts = np.zeros(len(omega)) if level is None else level, []
    for a, b, is_one in (
        (left, np.take_along_axis(right, to_right, axis=2), np.ones_like(is_new)),
        (np.take_along_axis(left, to_left, axis=2), right, is_new),
    ):
        row, column, channel = np.nonzero(((np.abs(a) < 1) != (np.abs(b) < 1)) & is_one)
        a, b = a[row, column, channel], b[row, column, channel]
        begin, end = omega[row, column], omega[row, column + 1]
        ratio = np.log(b / a)
        share = -np.log(np.abs(a)) / ratio.real
        angle = np.angle(-a) + share * ratio.imag
        log = 1j * ((angle + np.pi) % (2 * np.pi) - np.pi)
        slope = ratio / np.where(end > begin, end - begin, 1.0)
        parts.append(
            _Places(
                loop=loop[row],
                level=level[row],
                omega=begin + share * (end - begin),
                log=log,
                slope=slope,
                left=begin,
                right=end,
                column=column,
            )
        )
    return _joined(parts)


def _at_levels(
    loops: LoopGains, omega: np.ndarray, is_mixed: np.ndarray
) -> tuple[_Places, np.ndarray, np.ndarray]:
    """Places where images matter, with their delays [samples] and rates of the logarithm.

    A whole sample turns all images alike, so the levels within one sample tell those of all.
    """
    columns = _columns(is_mixed)
    omega, is_mixed = (np.take_along_axis(x, columns, axis=1) for x in (omega, is_mixed))
    whole, n, found = np.arange(int(MOST_DELAY)), len(omega), []
    for step in np.arange(LEVELS) / LEVELS:
        value = np.linalg.eigvals(loops.at_delay(omega, np.full(omega.shape, step)))
        places = _crossings(omega, value, np.arange(n), np.full(n, step))
        found.append(places.chosen(_is_in(is_mixed, places)))
    places = _looked_again(loops, _joined(found))
    part, period = loops.part(places.loop), loops.period[places.loop]
    # both at the same frequency: between the grid's, where places lie, angles are not exact
    now, later = (
        -np.linalg.eigvals(part.at_delay(places.omega[:, None], places.level[:, None] + more)[:, 0])
        for more in (0.0, SLIGHT)
    )
    now = _nearest(now, np.exp(places.log))
    rate = np.log(_nearest(later, now) / now) / SLIGHT
    angle = places.log.imag[:, None] - (places.omega * period)[:, None] * whole
    angle = (angle + np.pi) % (2 * np.pi) - np.pi
    slope = places.slope[:, None] - 1j * period[:, None] * whole
    # later images also change the modulus, so where it is 1 moves along the axis
    moved = -rate.real[:, None] / np.where(slope.real == 0, 1e-300, slope.real)
    along = rate.imag[:, None] + slope.imag * moved
    shift = -angle / np.where(np.abs(along) < 1e-3, 1e-3, along)
    delay = places.level[:, None] + whole + shift
    row, late = np.nonzero((np.abs(shift) < 1 / LEVELS) & (delay > 0))
    chosen = places.chosen(row)
    omega = chosen.omega + moved[row, late] * shift[row, late]
    chosen = chosen._replace(omega=omega, slope=slope[row, late])
    return chosen, delay[row, late], rate[row]


def _nearest(candidates: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Of each row of candidates (p, m) the one nearest to its value, (p,)."""
    best = np.abs(candidates - value[:, None]).argmin(axis=1)[:, None]
    return np.take_along_axis(candidates, best, axis=1)[:, 0]


def _smallest(
    places: _Places,
    t: np.ndarray,
    sign: np.ndarray,
    rate: np.ndarray,
    eigenvalues: Callable[..., np.ndarray],
    n: int,
) -> MarginPlace:
    """Smallest t of each loop at which an eigenvalue is -1, infinite if there is none, (n,) each.

    Newton's iteration for the logarithm of -eigenvalue by (omega, t), with slopes from the grid
    that each step corrects (Broyden 1965). The place on the grid counts where it fails.

    Args:
        places: on the grid, p of them.
        t: there, (p,).
        sign: of the phase there, (p,).
        rate: of the logarithm by t, (p,).
        eigenvalues: of L with t, (p, m), of (rows, omega, t).
        n: number of loops.
    """
    order = np.lexsort((t, places.loop))
    rank = np.arange(len(order)) - np.searchsorted(places.loop[order], places.loop[order])
    rows = order[rank < SOLVED]
    w, value = places.omega[rows], t[rows].copy()
    start, width = value.copy(), np.maximum(np.abs(w) * 1e-3, 1e-9)
    slope = np.stack([places.slope[rows] + 0j, rate[rows] + 0j], axis=1)
    turned = _nearest_log(eigenvalues(rows, w, value))
    for _ in range(STEPS):
        if np.all(np.abs(turned) < RESIDUAL):
            break
        area = np.imag(np.conj(slope[:, 0]) * slope[:, 1])
        area = np.where(area == 0, 1e-300, area)
        dw = np.imag(np.conj(slope[:, 1]) * turned) / area
        dt = -np.imag(np.conj(slope[:, 0]) * turned) / area
        w, value = w + dw, value + dt
        now = _nearest_log(eigenvalues(rows, np.maximum(w, 1e-3), value))
        # weights make frequency and t comparable
        step = np.stack([dw / width**2, dt], axis=1)
        size = np.maximum(dw**2 / width**2 + dt**2, 1e-300)
        slope = slope + now[:, None] * step / size[:, None]
        turned = now
    is_good = (np.abs(turned) < 1e-4) & (value > 0) & (np.abs(value - start) < 0.5)
    value, w = np.where(is_good, value, start), np.where(is_good, w, places.omega[rows])
    found = MarginPlace(np.full(n, np.inf), np.ones(n), np.ones(n))
    last_first = np.argsort(-value)  # the smallest is written last
    owner = places.loop[rows][last_first]
    for array, each in zip(found, (value, w, sign[rows]), strict=True):
        array[owner] = each[last_first]
    return found


def _nearest_log(eigenvalue: np.ndarray) -> np.ndarray:
    """Logarithm of -eigenvalue for the one nearest to -1, (p,)."""
    return np.log(-_nearest(eigenvalue, np.full(len(eigenvalue), -1.0)))
