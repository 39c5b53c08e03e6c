"""Criteria for the place of a patch pair on a link, without closing the real loop.

Larger is better, in arbitrary units: only order and maximum count. A link here is its modes between
pinned ends, b_j = lambda_a Phi_a,j/m the acceleration of mode j by a volt, and s_j = lambda_s
Phi_s,j the sensor's voltage by a metre of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

#: Modes whose control or observation counts in the Gramians and in the quadratic cost.
COUNTED = 3
#: Damping ratio that the regulator of `least_effort` adds at the best place [1].
ADDED = 0.2


class LinkPlaces(NamedTuple):
    """One link with its pair at different places; leading axis: places."""

    omega: np.ndarray  # [rad/s], (n, R)
    zeta: np.ndarray  # [1], (n, R)
    actuator: np.ndarray  # b [m/(s2 V)], (n, R)
    sensor: np.ndarray  # s [V/m], (n, R)
    bending: np.ndarray  # of mid-span, static, exact [m/V], (n,)


def modal_force(link: LinkPlaces) -> np.ndarray:
    """|b_1|: force on mode 1 (n,)."""
    return np.abs(link.actuator[:, 0])


def host_deflection(link: LinkPlaces) -> np.ndarray:
    """Static deflection of mid-span by a volt (n,)."""
    return np.abs(link.bending)


def least_effort(link: LinkPlaces) -> np.ndarray:
    """1/J of the quadratic regulator J = int sum_j (w_j^2 q_j^2 + q_j'^2) + R V^2 dt (n,).

    All states are known, mode 1 starts with unit speed, and R is such that mode 1 gets `ADDED` at
    the best place.
    """
    first = np.abs(link.actuator[:, 0]).max()
    weight = np.array([[(first / (2 * ADDED * link.omega[0, 0])) ** 2]])
    return np.array([1 / _cost(link, k, weight) for k in range(len(link.omega))])


def _cost(link: LinkPlaces, k: int, weight: np.ndarray) -> float:
    omega, zeta = link.omega[k, :COUNTED], link.zeta[k, :COUNTED]
    zero, eye = np.zeros((COUNTED, COUNTED)), np.eye(COUNTED)
    state = np.block([[zero, eye], [-np.diag(omega**2), -np.diag(2 * zeta * omega)]])
    force = np.concatenate([np.zeros(COUNTED), link.actuator[k, :COUNTED]])[:, None]
    energy = np.diag(np.concatenate([omega**2, np.ones(COUNTED)]))
    return float(scipy.linalg.solve_continuous_are(state, force, energy, weight)[COUNTED, COUNTED])


def controllability(link: LinkPlaces) -> np.ndarray:
    """Least controlled mode: eigenvalues b_j^2/(4 zeta_j w_j) of the Gramian, in speeds (n,)."""
    modes = slice(0, COUNTED)
    gramian = link.actuator[:, modes] ** 2 / (4 * link.zeta[:, modes] * link.omega[:, modes])
    return np.asarray(gramian.min(axis=1))


def observability(link: LinkPlaces) -> np.ndarray:
    """Least observed mode: eigenvalues s_j^2/(4 zeta_j w_j^3) of the Gramian, in speeds (n,)."""
    modes = slice(0, COUNTED)
    gramian = link.sensor[:, modes] ** 2 / (4 * link.zeta[:, modes] * link.omega[:, modes] ** 3)
    return np.asarray(gramian.min(axis=1))


def least_spillover(link: LinkPlaces) -> np.ndarray:
    """|s_1 b_1/w_1| over the sum of |s_j b_j/w_j| of all modes that are not controlled (n,)."""
    loop = np.abs(link.sensor * link.actuator / link.omega)
    return np.asarray(loop[:, 0] / loop[:, 1:].sum(axis=1))


#: The review's six, in its order.
CRITERIA: dict[str, Callable[[LinkPlaces], np.ndarray]] = {
    "modal force": modal_force,
    "deflection of the host": host_deflection,
    "least effort": least_effort,
    "controllability": controllability,
    "observability": observability,
    "least spillover": least_spillover,
}
