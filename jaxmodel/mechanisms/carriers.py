"""What carries the near joints B, as a workshop describes it: rails and cranks.

Plain numbers, for drawings and for other programs that build the machine. rho is the way of B along
its path, as in `contract`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxmodel.parameters import Array, Num


class Rail(NamedTuple):
    """A straight rail; B is on its slider, and C lies ahead of B."""

    start: Num[Array, "2"]  # where rho = 0 [m]
    direction: Num[Array, "2"]  # in which rho grows [1]
    length: Array  # [m]
    mass: Array  # of the slider [kg]

    def line(self, near: np.ndarray) -> np.ndarray:
        """Its ends [m], (2, 2), wherever B is."""
        return np.stack([self.start, self.start + self.length * self.direction])


class Crank(NamedTuple):
    """A rigid crank, turned by a motor at its pivot; B is at its end."""

    pivot: Num[Array, "2"]  # [m]
    length: Array  # a [m]
    zero_angle: Array  # its direction where rho = 0 [rad]
    # 1: C lies to its left and rho grows against the clock, -1: to its right, and with the clock
    elbow: Array
    inertia: Array  # of crank and motor about the pivot [kg m2]

    def line(self, near: np.ndarray) -> np.ndarray:
        """From its pivot to B [m], (2, 2).

        near: B [m], (2,).
        """
        return np.stack([self.pivot, near])


Carrier = Rail | Crank


def cranks(
    pivots: Array, length: Array, zero_angle: Array, elbow: Array, near_mass: Array, xp: Any
) -> tuple[Crank, ...]:
    """All cranks of a mechanism; J = m a^2.

    Args:
        pivots: [m], (n, 2).
        length: a [m], () or (n,).
        zero_angle, elbow: see `Crank`, () or (n,).
        near_mass: m, which turns with a crank as if it were at B [kg], () or (n,).
        xp: NumPy or `jax.numpy`.
    """
    lengths, angles, elbows, masses = (
        xp.broadcast_to(xp.asarray(x, float), len(pivots))
        for x in (length, zero_angle, elbow, near_mass)
    )
    return tuple(
        Crank(
            pivot=pivots[i],
            length=lengths[i],
            zero_angle=angles[i],
            elbow=elbows[i],
            inertia=masses[i] * lengths[i] ** 2,
        )
        for i in range(len(pivots))
    )
