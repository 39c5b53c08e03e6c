"""The analogue chain of a sensor, stepped exactly for an input that is linear over each step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from studies.twin.plan import SignalPath


class FilterStep(NamedTuple):
    """One step of (s, z, z'/omega_f): x <- state x + before u_k + after u_(k+1)."""

    state: np.ndarray  # (3, 3)
    before: np.ndarray  # of the input at the start of the step, (3,)
    after: np.ndarray  # of that at its end, (3,)


def filter_step(electronics: SignalPath, step: float) -> FilterStep:
    """A patch drained by its amplifier's input, and the anti-alias filter behind it.

    s' = omega_h (u - s), z'' = omega_f^2 (u - s - z) - sqrt(2) omega_f z'; the exponential of it
    together with u and u', of which u' is constant over a step.

    Args:
        electronics: corners.
        step: h [s].
    """
    drain, corner = electronics.highpass, electronics.antialias
    whole = np.zeros((5, 5))  # s, z, z'/omega_f, u, h u'
    whole[0, [0, 3]] = -drain, drain
    whole[1, 2] = corner
    whole[2, :4] = -corner, -corner, -np.sqrt(2.0) * corner, corner
    whole[3, 4] = 1 / step
    over = scipy.linalg.expm(whole * step)
    held, rising = over[:3, 3], over[:3, 4]
    return FilterStep(over[:3, :3], held - rising, rising)


class SensorFilter:
    """All sensors' analogue chains, from rest."""

    def __init__(self, electronics: SignalPath, step: float, shape: tuple[int, ...]) -> None:
        self._step = filter_step(electronics, step)
        self._state = np.zeros((3, *shape))
        self._last = np.zeros(shape)

    def settle(self, voltage: np.ndarray) -> None:
        """Start settled on a voltage [V]; a drained patch has lost it."""
        has_drain = self._step.state[0, 0] < 1
        self._state[0] = voltage if has_drain else 0.0
        self._state[1] = 0.0 if has_drain else voltage
        self._state[2] = 0.0
        self._last = voltage

    @property
    def present(self) -> np.ndarray:
        """Filtered voltages [V]."""
        return np.array(self._state[1])

    def advance(self, voltage: np.ndarray) -> np.ndarray:
        """Filtered voltages [V] at the end of a step, from those of the patches there."""
        own = self._step
        self._state = np.tensordot(own.state, self._state, 1)
        self._state += np.multiply.outer(own.before, self._last)
        self._state += np.multiply.outer(own.after, voltage)
        self._last = voltage
        return self.present
