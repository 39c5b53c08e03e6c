"""Frequencies at which margins of loops are searched, and the loop gain there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.return_difference import NARROWEST
from jaxmodel.robustness import LOWEST_HZ
from jaxmodel.state_space import StateSpace
from studies.engine.diagonal_scaling import balanced, largest_singular
from studies.engine.loop_gain import LoopGains

#: Frequencies evenly on a logarithmic axis, and beside each mode that matters, in half-widths.
BACKGROUND, BESIDE = 40, np.tan(np.array([-1.35, -0.75, 0.75, 1.35]))
#: Shifts of the points at modes that coincide, at most six, in half-widths.
APART = np.array([0.0, 0.1, -0.1, 0.2, -0.2, 0.3])
#: A frequency matters if its L could move a singular value by this share of the largest move seen
#: at the strongest ones, which are this many.
MATTERS = 0.5
STRONGEST = 8


class GridGain(NamedTuple):
    """L at the frequencies of a search."""

    omega: np.ndarray  # rising [rad/s], (n, F)
    gain: np.ndarray  # (n, F, m, m)
    radius: np.ndarray  # largest that an eigenvalue of L can be, whatever its phases, (n, F)
    matters: np.ndarray  # where S can be large, (n, F)


def search_grid(loops: LoopGains, omega: np.ndarray, decay: np.ndarray) -> GridGain:
    """Choose frequencies and evaluate L there.

    Args:
        loops: n of them.
        omega: of the machine's modes [rad/s], (n, k).
        decay: zeta omega [1/s], (n, k).
    """
    top = loops.top[:, None]
    lowest = 2 * np.pi * LOWEST_HZ

    def folded(x: np.ndarray) -> np.ndarray:  # after aliasing
        return np.clip(np.abs((x + top) % (2 * top) - top), lowest, top * (1 - 1e-6))

    feedback = loops.response.controller.feedback
    if isinstance(feedback, StateSpace):
        pole = np.linalg.eigvals(feedback.state[loops.owner]).reshape(len(top), -1)
        rate = np.log(np.maximum(np.abs(pole), 1e-9)) * top / np.pi
        omega = np.concatenate([omega, np.abs(np.angle(pole)) * top / np.pi], axis=1)
        decay = np.concatenate([decay, np.abs(rate)], axis=1)
    order = np.argsort(omega, axis=1)
    omega, decay = (np.take_along_axis(x, order, axis=1) for x in (omega, decay))
    width = np.maximum(decay, NARROWEST * omega)
    # modes of equal links coincide: frequencies apart tell which way a singular value rises
    omega = omega + np.resize(APART, omega.shape[1]) * width
    background = lowest * (top / lowest) ** np.linspace(0, 1, BACKGROUND)
    first = np.concatenate([folded(omega), folded(background)], axis=1)
    gain = loops.searched(first)
    radius = perron_radius(gain)
    rows = np.argsort(-radius, axis=1)[:, :STRONGEST, None, None]
    some = excess(np.take_along_axis(gain, rows, axis=1))
    seen = largest_singular(balanced(some.reshape(-1, *some.shape[2:])))
    move = np.maximum(seen.reshape(len(gain), -1).max(axis=1) - 0.5, 0.0) * MATTERS
    size = radius[:, : omega.shape[1]]
    count = int(np.max(np.sum(could_exceed(size, move[:, None]), axis=1)))
    chosen = np.argsort(-size, axis=1)[:, :count]
    omega, width = (np.take_along_axis(x, chosen, axis=1) for x in (omega, width))
    beside = omega[..., None] + BESIDE * width[..., None]
    more = folded(beside.reshape(len(omega), -1))
    other = loops.searched(more)
    omega = np.concatenate([first, more], axis=1)
    order = np.argsort(omega, axis=1)
    gain = np.concatenate([gain, other], axis=1)
    radius = np.concatenate([radius, perron_radius(other)], axis=1)
    return GridGain(
        omega=np.take_along_axis(omega, order, axis=1),
        gain=np.take_along_axis(gain, order[..., None, None], axis=1),
        radius=np.take_along_axis(radius, order, axis=1),
        matters=np.take_along_axis(could_exceed(radius, move[:, None]), order, axis=1),
    )


def could_exceed(radius: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Whether mu(S - I/2) can be more than 1/2 + `move` where eigenvalues are below `radius`.

    S - I = L - L^2 + .. with moduli scaled by Perron's vectors is below r/(1 - r).
    """
    return radius > move / (1 + move)


def perron_radius(gain: np.ndarray) -> np.ndarray:
    """Largest eigenvalue of the moduli (Perron and Frobenius), from above, (...)."""
    power = np.abs(gain)
    log = np.zeros(power.shape[:-2])
    for _ in range(4):
        size = _row_sum(power)
        power = power / size[..., None, None]
        power, log = power @ power, 2 * (log + np.log(size))
    return np.exp((log + np.log(_row_sum(power))) / 2**4)


def _row_sum(power: np.ndarray) -> np.ndarray:
    return power.sum(axis=-1).max(axis=-1, initial=1e-300)


def excess(gain: np.ndarray) -> np.ndarray:
    """S - I/2 of L, (..., m, m)."""
    eye = np.eye(gain.shape[-1])
    return np.linalg.inv(eye + gain) - eye / 2
