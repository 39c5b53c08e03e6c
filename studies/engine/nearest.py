"""The point nearest to the origin at which a loop is unstable: descent on exact gradients.

The distance of that point is the reliability index of structural reliability (Hasofer and Lind
1974), its search that of Rackwitz and Fiessler (1978): of each motion that may go unstable, the
growth is linearised and the nearest point of the tangent plane is next. Every pole of the nominal
loop is a starting point of its own. Unstable points are pulled back along their ray to the first
crossing, and the best ones then slide along the limit as long as they come nearer.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import eig
from scipy.optimize import brentq

from jaxmodel.sampled_loop import RADIUS_TOLERANCE
from studies.engine.eigenvalues import eigenvalues

#: Motions that begin, those nearest to the limit, by steps so far from zero [tolerances].
MOTIONS, BEGINNING, RADIUS = 36, 2, 4.0
#: Motions that go on, and steps of each.
STARTS, STEPS = 12, 8
#: Of motions of one frequency, as the three of equal links are, so many come before the others.
FIRST_ALIKE, SAME_FREQUENCY = 2, 0.01
#: Steps along the limit of all that arrive; how many go on; their steps.
FIRST, KEPT, SLIDES = 3, 2, 10
#: Threads: JAX and LAPACK run beside each other.
WORKERS = 2
#: Longest step, as a share of the distance aimed at [1].
STRIDE = 0.5
#: Poles that decay to less than this over a sample cannot be the first to reach the circle [1].
FASTEST = 0.2
#: Points on the last ray at which an earlier crossing is looked for.
RAY = 12
#: Relative error of a crossing on a ray [1].
CLOSE = 1e-4
#: Relative progress of a slide that is not worth another step [1].
ENOUGH = 2e-3
#: Step of the differences that choose the motions to begin with [tolerances].
PROBE = 1e-4


class Loops(NamedTuple):
    """A loop as a function of p numbers x, each in units of its tolerance."""

    matrix: Callable[[np.ndarray], np.ndarray]  # transition over a sample, (n, n)
    # derivative of sum(weight * matrix) by x, (p,), of x and a weight (n, n)
    slope: Callable[[np.ndarray, np.ndarray], np.ndarray]
    lower: np.ndarray  # limits of x, not above 0, (p,)
    upper: np.ndarray  # not below 0, (p,)


class _Pole(NamedTuple):
    growth: float  # as `growth`, of this pole
    right: np.ndarray  # v, M v = z v, (n,)
    left: np.ndarray  # w, w'M = z w', (n,)
    size: complex  # z w'v

    @property
    def turn(self) -> float:
        """Angle by which the motion turns in a sample [rad]."""
        return float(abs(np.angle(self.size / (self.left @ self.right))))

    @property
    def weight(self) -> np.ndarray:
        """Derivative of the growth by the matrix: Re(w_i v_j/(z w'v)), (n, n)."""
        return np.real(np.outer(self.left, self.right) / self.size)


def growth(matrix: np.ndarray) -> float:
    """ln of the spectral radius, 0 at `RADIUS_TOLERANCE`: positive if unstable [1].

    NaN if the matrix is not finite.
    """
    if not np.all(np.isfinite(matrix)):
        return float("nan")
    return float(np.log(np.abs(eigenvalues(matrix)).max()) - np.log1p(RADIUS_TOLERANCE))


def nearest_unstable(loops: Loops) -> np.ndarray | None:
    """x of smallest Euclidean norm on the limit of stability, (p,); None: no such point is found.

    Args:
        loops: the loop; zero if the nominal one is unstable.
    """
    origin = np.zeros(len(loops.lower))
    poles = _poles(loops.matrix(origin))
    if not poles or max(pole.growth for pole in poles) > 0:
        return origin
    poles = sorted(poles, key=lambda pole: -pole.growth)[:MOTIONS]
    slopes = _first_slopes(loops, poles)
    with ThreadPoolExecutor(WORKERS) as threads:
        begun = list(filter(None, threads.map(partial(_begin, loops), poles, slopes)))
        found = list(threads.map(partial(_descend, loops), _chosen(begun)))
        unstable = _distinct([x for x in found if x is not None])
        limit = list(threads.map(partial(_back_to_limit, loops, points=1), unstable))
        limit = list(threads.map(partial(_slide, loops, steps=FIRST), limit))
        ends = list(threads.map(partial(_slide, loops, steps=SLIDES), _distinct(limit)[:KEPT]))
    best = min(ends, key=np.linalg.norm, default=None)
    return None if best is None else _back_to_limit(loops, best, RAY)


def _first_slopes(loops: Loops, poles: list[_Pole]) -> list[np.ndarray]:
    """Derivatives of all poles' growth at zero, by differences: they only choose the starts."""
    nominal, size = loops.matrix(np.zeros(len(loops.lower))), len(loops.lower)
    slopes = np.zeros((len(poles), size))
    for k in range(size):
        step = PROBE if loops.upper[k] > 0 else -PROBE
        moved = (loops.matrix(step * np.eye(size)[k]) - nominal) / step
        slopes[:, k] = [np.sum(pole.weight * moved) for pole in poles]
    return list(slopes)


def _poles(matrix: np.ndarray) -> list[_Pole]:
    """Poles in the upper half plane that decay slowly enough; none of a matrix not finite."""
    if not np.all(np.isfinite(matrix)):
        return []
    z, left, right = eig(matrix, left=True, right=True)
    found = []
    for k in np.flatnonzero((z.imag >= 0) & (np.abs(z) > FASTEST)):
        w, v = left[:, k].conj(), right[:, k]
        size = w @ v * z[k]
        if abs(size) < 1e-12:  # defective: no derivative
            continue
        excess = float(np.log(np.abs(z[k])) - np.log1p(RADIUS_TOLERANCE))
        found.append(_Pole(excess, v, w, size))
    return found


def _on_plane(value: float, slope: np.ndarray, at: np.ndarray, loops: Loops) -> np.ndarray:
    """x of smallest norm within limits for which value + slope (x - at) = 0, by its multiplier.

    Without limits x = t slope; an entry at its limit stays there. Far away if there is none.
    """
    wanted = slope @ at - value
    direction = np.sign(wanted) * slope
    size = slope @ slope
    low, high = 0.0, abs(wanted) / max(size, 1e-300)
    if size == 0 or not np.isfinite(high):
        return np.full_like(at, np.inf)

    def reached(factor: float) -> float:
        return float(slope @ np.clip(factor * direction, loops.lower, loops.upper)) * np.sign(
            wanted
        )

    for _ in range(60):
        if reached(high) >= abs(wanted):
            break
        low, high = high, 2 * high
    else:
        return np.full_like(at, np.inf)
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (low, middle) if reached(middle) >= abs(wanted) else (middle, high)
    return np.clip(high * direction, loops.lower, loops.upper)


class _Start(NamedTuple):
    """A point on the way of one motion to its limit."""

    x: np.ndarray
    pole: _Pole  # the motion, at x
    slope: np.ndarray  # of its growth, (p,)
    distance: float  # of the limit from zero by this slope [tolerances]


def _begin(loops: Loops, pole: _Pole, slope: np.ndarray) -> _Start | None:
    """Follow a motion over a few steps of fixed length from zero, on which its slope changes.

    Poles that nearly coincide, as those of three equal links do, have slopes at zero that say
    nothing of how far they get.
    """
    x, aim = np.zeros(len(loops.lower)), np.zeros(0)
    for _ in range(BEGINNING):
        aim = _on_plane(pole.growth, slope, x, loops)
        size = float(np.linalg.norm(aim))
        if not np.isfinite(size) or size == 0:
            return None
        x = aim * min(RADIUS / size, _room(loops, aim))
        poles = _poles(loops.matrix(x))
        if not poles:
            return None
        pole = _next_pole(pole, poles)
        slope = loops.slope(x, pole.weight)
    distance = float(np.linalg.norm(_on_plane(pole.growth, slope, x, loops)))
    return _Start(x, pole, slope, distance)


def _chosen(begun: list[_Start]) -> list[_Start]:
    """The most promising starts: half by their linear distance, half by how near to 1 |z| is.

    Damping that shrinks by a factor never reaches zero, though its slope says where it would.
    """
    by_distance = _varied(sorted(begun, key=lambda one: one.distance))[: STARTS // 2]
    rest = [one for one in begun if not any(one is other for other in by_distance)]
    by_growth = _varied(sorted(rest, key=lambda one: -one.pole.growth))
    return by_distance + by_growth[: STARTS - len(by_distance)]


def _varied(starts: list[_Start]) -> list[_Start]:
    """The same in the same order, but of one frequency no more than `FIRST_ALIKE` at first."""
    first, later = list[_Start](), list[_Start]()
    for one in starts:
        turn = one.pole.turn
        alike = sum(abs(other.pole.turn - turn) <= SAME_FREQUENCY * turn for other in first)
        (first if alike < FIRST_ALIKE else later).append(one)
    return first + later


def _next_pole(pole: _Pole, poles: list[_Pole]) -> _Pole:
    """The most unstable pole if there is one, else the one that continues a motion."""
    worst = max(poles, key=lambda one: one.growth)
    return worst if worst.growth > 0 else max(poles, key=lambda one: _likeness(pole, one))


def _descend(loops: Loops, start: _Start) -> np.ndarray | None:
    """The nearest unstable point on the way of one motion to its limit; None: there is none.

    It stays with its motion where another one is unstable already: that one has its own start.
    """
    x, pole, slope, _ = start
    found = [x] if pole.growth > 0 else []
    for _ in range(STEPS):
        aim = _on_plane(pole.growth, slope, x, loops)
        distance = float(np.linalg.norm(aim))
        if not np.isfinite(distance):
            break
        step = aim - x
        length = float(np.linalg.norm(step))
        x = x + step * min(1.0, STRIDE * max(distance, 1.0) / max(length, 1e-300))
        poles = _poles(loops.matrix(x))
        if not poles:
            break
        pole = max(poles, key=partial(_likeness, pole))
        if max(one.growth for one in poles) > 0:
            found.append(x)
        if length < 0.05 * distance:
            break
        slope = loops.slope(x, pole.weight)
    if not found:
        beyond = x * min(1.2, _room(loops, x))
        if growth(loops.matrix(beyond)) > 0:
            found.append(beyond)
    return min(found, key=np.linalg.norm, default=None)


def _likeness(one: _Pole, other: _Pole) -> float:
    """Whether two poles of neighbouring loops belong to the same motion, at most 1."""
    both = abs(one.left @ other.right) * abs(other.left @ one.right)
    own = abs(one.left @ one.right) * abs(other.left @ other.right)
    return float(both / max(own, 1e-300))


def _back_to_limit(loops: Loops, x: np.ndarray, points: int) -> np.ndarray:
    """A crossing on the way from zero to an unstable point: the first that `points` show."""
    low = 0.0
    for high in np.linspace(0, 1, points + 1)[1:-1]:
        if growth(loops.matrix(high * x)) > 0:
            return _crossing(loops, x, low, float(high)) * x
        low = float(high)
    return _crossing(loops, x, low, 1.0) * x


def _crossing(loops: Loops, x: np.ndarray, low: float, high: float) -> float:
    """A factor on x at which the loop is just unstable, between a stable and an unstable one."""

    def excess(factor: float) -> float:
        return growth(loops.matrix(factor * x))

    found = float(brentq(excess, low, high, xtol=CLOSE, rtol=CLOSE))
    return min(found * (1 + 2 * CLOSE), high)


def _distinct(points: list[np.ndarray]) -> list[np.ndarray]:
    """The nearest first, without those that nearly repeat an earlier one."""
    kept: list[np.ndarray] = []
    for x in sorted(points, key=np.linalg.norm):
        if all(np.linalg.norm(x - other) > 0.1 * np.linalg.norm(x) for other in kept):
            kept.append(x)
    return kept


def _slide(loops: Loops, x: np.ndarray, steps: int) -> np.ndarray:
    """Along the limit of stability towards zero, from a point on it."""
    for _ in range(steps):
        pole = max(_poles(loops.matrix(x)), key=lambda one: one.growth)
        aim = _on_plane(pole.growth, loops.slope(x, pole.weight), x, loops)
        if not np.all(np.isfinite(aim)):
            return x
        pulled = (
            _pulled(loops, x + share * (aim - x), float(np.linalg.norm(x)))
            for share in (1.0, 0.5, 0.2)
        )
        nearer = next((there for there in pulled if there is not None), None)
        if nearer is None:
            return x
        is_last = np.linalg.norm(nearer) > (1 - ENOUGH) * np.linalg.norm(x)
        x = nearer
        if is_last:
            break
    return x


def _pulled(loops: Loops, x: np.ndarray, below: float) -> np.ndarray | None:
    """The limit on the ray through a point near it, None unless it is nearer than `below`."""
    high = min(below / float(np.linalg.norm(x)), _room(loops, x))
    if not growth(loops.matrix(high * x)) > 0:
        return None
    low = 0.95 * high
    while growth(loops.matrix(low * x)) > 0:
        high, low = low, 0.9 * low
    return _crossing(loops, x, low, high) * x


def _room(loops: Loops, x: np.ndarray) -> float:
    """Largest factor on x within the limits."""
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(x > 0, loops.upper / x, np.where(x < 0, loops.lower / x, np.inf))
    return float(room.min())
