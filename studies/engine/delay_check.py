"""Delay margins checked by eigenvalues of the delayed loop, which know nothing of their search.

The search follows eigenvalues of the loop gain over frequency and delay. Where links are nearly
alike it can take one for another, or miss one, and a margin comes out wrong; the poles of the
closed loop at some delays, exact for held commands, show that.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from scipy.linalg import expm, matrix_balance
from scipy.optimize import minimize_scalar

from jaxmodel.case import Electronics
from jaxmodel.delay import LONGEST, true_delay
from jaxmodel.sampled_loop import RADIUS_TOLERANCE, DelayedParts
from studies.engine.eigenvalues import eigenvalues

#: Shares of a delay margin at which the loop must be stable, and one at which it must not be.
BEFORE, BEYOND = (0.35, 0.7, 0.98), 1.02
#: Delays at which the loop is looked at again if one of these is wrong, and steps of the false
#: position from there (Illinois).
LEVELS, STEPS = 24, 8


def checked_delays(loops: DelayedLoops, delay: np.ndarray) -> np.ndarray:
    """Delay margins, those that turn out wrong replaced by the edge that poles show.

    Args:
        loops: stable as they are, with the plant modes of margins.
        delay: as searched, NaN where there is none [samples], (n,).

    Returns:
        Delay margins, within 2 % or, where replaced, 1e-3 of them [samples], (n,). Delays beyond
        `jaxmodel.delay.LONGEST` in all are not looked at: a loop that is stable up to there has
        the margin that was searched, or the delay that leads there if that is larger.
    """
    return np.array([_checked(loops, k, x, LONGEST - loops.own[k]) for k, x in enumerate(delay)])


def _checked(loops: DelayedLoops, k: int, delay: float, room: float) -> float:
    end = min(delay, room)
    if not end > 0 or not loops.is_finite[k]:
        return delay
    is_stable = all(loops.growth(k, end * x) <= RADIUS_TOLERANCE for x in BEFORE)
    if is_stable and (delay >= room or loops.growth(k, min(delay * BEYOND, room)) > 0):
        return delay
    edge = _first_edge(loops, k, room if is_stable else end)
    if edge is not None:
        return edge
    return max(delay, room) if is_stable else delay


def _first_edge(loops: DelayedLoops, k: int, last: float) -> float | None:
    """Shortest delay up to `last` at which a loop is unstable [samples]; None: none is seen."""
    levels = last * np.arange(LEVELS + 1) / LEVELS
    growth = np.array([loops.growth(k, x) for x in levels])
    unstable = np.flatnonzero(growth > RADIUS_TOLERANCE)
    first = unstable[0] if len(unstable) else LEVELS
    # a peak between two levels may reach further
    for j in range(1, first):
        if growth[j] >= max(growth[j - 1], growth[j + 1]):
            found = minimize_scalar(
                lambda x: -loops.growth(k, x),
                bounds=(levels[j - 1], levels[j + 1]),
                method="bounded",
                options={"maxiter": STEPS},
            )
            if -found.fun > RADIUS_TOLERANCE:
                return _edge(loops, k, levels[j - 1], float(found.x))
    return _edge(loops, k, levels[first - 1], levels[first]) if len(unstable) else None


def _edge(loops: DelayedLoops, k: int, lower: float, upper: float) -> float:
    """Delay between two at which a loop becomes unstable [samples]."""
    at_lower, at_upper = loops.growth(k, lower), loops.growth(k, upper)
    for _ in range(STEPS):
        if at_upper <= at_lower:
            break
        middle = upper - at_upper * (upper - lower) / (at_upper - at_lower)
        now = loops.growth(k, middle)
        if now > 0:
            upper, at_upper, at_lower = middle, now, at_lower / 2
        else:
            lower, at_lower, at_upper = middle, now, at_upper / 2
    return lower


class DelayedLoops(NamedTuple):
    """Loops whose commands can come later, NumPy; n of them."""

    parts: DelayedParts  # with the transition of plant and electronics, without commands
    period: np.ndarray  # [s], (n,)
    own: np.ndarray  # delay of each [samples], (n,)
    held: np.ndarray  # response of plant and electronics to commands over a sample, (n, a, 3 K)
    is_finite: np.ndarray  # (n,)

    @classmethod
    def of(cls, parts: DelayedParts, electronics: Electronics) -> DelayedLoops:
        period, own = np.asarray(electronics.period), np.asarray(true_delay(electronics))
        parts = jax.tree.map(np.array, parts)
        both = zip(parts.matrix, parts.state, parts.enters, strict=True)
        is_finite = np.array([all(np.isfinite(x).all() for x in each) for each in both])
        n, n_commands = parts.state.shape[1], parts.commands.shape[1]
        held = np.zeros((len(period), n, n_commands))
        for k in map(int, np.flatnonzero(is_finite)):
            free, driven = held_response(parts.state[k], parts.enters[k], period[k])
            parts.matrix[k, :n, :n] += free
            held[k] = driven[:, :n_commands]
            if parts.forces is not None:
                parts.matrix[k][:n, parts.forces[k]] += driven[:, n_commands:]
        return cls(parts, period, own, held, is_finite)

    def growth(self, k: int, delay: float) -> float:
        """Logarithm of the spectral radius of loop k with a further delay [samples]."""
        matrix = self.parts.matrix[k].copy()
        matrix[: len(self.held[k])] += self._commanded(k, self.own[k] + delay)
        return float(np.log(np.abs(eigenvalues(matrix)).max()))

    def _commanded(self, k: int, delay: float) -> np.ndarray:
        """What commands, now or earlier, do to plant and electronics over a sample, (a, m)."""
        matrix, commands = self.parts.matrix[k], self.parts.commands[k]
        n, n_sensors = self.held[k].shape
        whole = max(int(np.ceil(delay)), 1)
        rest = (whole - delay) * self.period[k]  # of the sample, after the newer command
        enters = self.parts.enters[k][:, :n_sensors]
        after = held_response(self.parts.state[k], enters, rest)[1]
        before = self.held[k] - after
        places = [None, commands]  # of u_(k), u_(k-1) and those on their way
        places += [n + j * n_sensors + np.arange(n_sensors) for j in range(LONGEST - 1)]
        found = np.zeros((n, len(matrix)))
        for number, gain in ((whole, before), (whole - 1, after)):
            if number:
                found[:, places[number]] += gain
            else:
                found += gain @ matrix[commands]
        return found


def held_response(
    state: np.ndarray, enters: np.ndarray, time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Transition of a plant over a time [s], and its response to held inputs.

    A plant on a sampled drive has no eigenvectors for its free motion, so its exponential is not
    taken by modes.

    Returns:
        (n, n) and (n, inputs).
    """
    n, n_inputs = enters.shape
    whole = np.zeros((n + n_inputs,) * 2)
    whole[:n, :n], whole[:n, n:] = state, enters
    # velocities against positions: unbalanced, the exponential loses digits
    balanced, (scale, _) = matrix_balance(whole, permute=False, separate=True)
    exact = expm(balanced * time) * scale[:, None] / scale
    return exact[:n, :n], exact[:n, n:]
