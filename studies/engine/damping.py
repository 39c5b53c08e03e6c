"""Damping ratios of the controlled modes of every case, from poles traced as gains rise.

See `jaxmodel.pole_paths`; poles that do not converge are traced again in finer steps.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxmodel.frequency_response import assembled
from jaxmodel.pairs import Pair
from jaxmodel.pole_paths import OrderPoles, refine_closed_loop_poles, refine_open_loop_poles
from jaxmodel.return_difference import AssembledModes, LoopResponse, pose_coupling
from studies.engine.host_loop import link_poles
from studies.engine.lanes import run_steps

#: Iterations to find the poles without control; twice as many more for those not `SETTLED`.
SETTLING = 12
#: Gain factors on the way to 1, one iteration each; the second path is for poles that did not
#: converge on the first.
WAYS = (
    np.concatenate([np.arange(1, 17) / 16, np.ones(6)]),
    np.concatenate([np.repeat(np.arange(1, 61) / 60, 2), np.ones(10)]),
)
#: A last step, as a share of the pole, that counts as converged.
AT_REST = 1e-4
#: The same for poles without control: beside one that is not multiplied out exactly lies a root
#: that is none of the loop. Equal poles, as at home, halve their distance in each iteration.
SETTLED = 1e-6
#: Initial distance of poles from one another and from poles of the function [1].
ASIDE = 1e-4
#: Share of an order in the energy of its undamped modes above which its poles are beside them;
#: below it, drives are as quick as the links, and damping decides which of the modes are theirs.
CLEAR = 0.9
#: In which directions [rad].
ANGLES = (0.3, 2.4, 4.4)


def damping_ratios(
    response: LoopResponse, modes: AssembledModes, n_links: np.ndarray, n_orders: int
) -> np.ndarray:
    """Least damping ratio of the controlled modes of each order [1], (n, n_orders).

    Of the modes of an order, only the most damped count, as many as there are controlled
    links. NaN if no link is controlled, or the poles were not found.

    Args:
        response: of the loops, lanes last.
        modes: of the machines without control, lanes last.
        n_links: controlled ones of each case, (n,).
        n_orders: number of mode orders.
    """
    ratios = np.full((len(n_links), n_orders), np.nan)
    for order, first in enumerate(_open_loop_poles(response, modes, n_orders)):
        poles = _poles(response, order, first)
        ratios[:, order] = least_controlled(-poles.real / np.abs(poles), n_links)
    return ratios


def least_controlled(ratio: np.ndarray, n_links: np.ndarray) -> np.ndarray:
    """Least damping ratio of the most damped modes, one per controlled link [1], (n,).

    Args:
        ratio: of the modes of an order [1], (l, n).
        n_links: controlled ones, (n,).
    """
    falling = np.sort(ratio, axis=0)[::-1]
    least = falling[np.maximum(n_links, 1) - 1, np.arange(len(n_links))]
    return np.where(n_links > 0, least, np.nan)


def _open_loop_poles(response: LoopResponse, modes: AssembledModes, n_orders: int) -> np.ndarray:
    """About the poles of each order without control [1/s], NaN if overdamped, (orders, l, n)."""
    n_links, found = len(response.square), []
    is_clear = np.ones(response.square.shape[2], bool)
    for order in range(min(n_orders, response.square.shape[1])):
        share = modes.share[order + 1]
        which = np.argsort(-share, axis=0)[:n_links]
        omega, loss, share = (
            np.take_along_axis(x, which, axis=0) for x in (modes.omega, modes.decay, share)
        )
        found.append(-loss + 1j * np.sqrt(omega**2 - loss**2))
        is_clear &= share.min(axis=0) > CLEAR
    poles = np.array(found)
    n_rigid = response.mass.shape[0] + (0 if response.longer is None else n_links)
    for k in np.flatnonzero(~is_clear & np.isfinite(modes.omega).all(axis=0)):
        poles[:, :, k] = link_poles(_state(response, k), n_links, len(poles), n_rigid)
    return poles


def _state(response: LoopResponse, k: Any) -> np.ndarray:
    """A of the plant of lane k in (y, y', q, q'), by the equations of `assembled_modes`.

    y are the pose and the links' elongations.
    """
    response = jax.tree.map(lambda x: x[..., k], response)
    rigid = assembled(response, np)
    drag = pose_coupling(rigid, np)
    pose, modes = drag.shape
    n, none = pose + modes, np.zeros_like(drag)
    mass = np.block([[rigid.mass, drag], [drag.T, np.eye(modes)]])

    def per_mass(own: np.ndarray, links: np.ndarray) -> np.ndarray:
        whole = np.block([[own, none], [none.T, np.diag(np.ravel(links))]])
        return np.asarray(np.linalg.solve(mass, whole))

    stiffness = per_mass(rigid.stiffness, response.square)
    damping = per_mass(rigid.damping, response.decay)
    state = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -damping]])
    order = np.r_[:pose, n : n + pose, pose:n, n + pose : 2 * n]
    return state[np.ix_(order, order)]


def _poles(response: LoopResponse, order: int, guess: np.ndarray) -> np.ndarray:
    """The poles of an order [1/s], complex, NaN where they were not found, (l, n)."""
    square, decay = response.square[:, order], response.decay[:, order] / 2
    held = _pair(-decay + 1j * np.sqrt(square - decay**2))
    own = jax.tree.map(np.array, _poles_apart(guess, response.period))
    moving: Any = slice(None)
    for steps in (SETTLING, 2 * SETTLING):
        at = jax.tree.map(lambda x, at=moving: x[..., at], (response, held, own))
        settled = run_steps(refine_open_loop_poles, at[:2], (), at[2], steps)
        for old, new in zip(jax.tree.leaves(own), jax.tree.leaves(settled), strict=True):
            old[..., moving] = new
        moving = np.flatnonzero(np.any(own.step > SETTLED, axis=0))
    own.pole.re[:, moving] = np.nan
    poles, is_found = _follow(response, own.pole, WAYS[0])
    again = np.flatnonzero(~is_found)
    if len(again):
        remaining, start = jax.tree.map(lambda x: x[..., again], (response, own.pole))
        poles[:, again], is_found[again] = _follow(remaining, start, WAYS[1])
    return np.where(is_found, poles, np.nan)


def _follow(response: LoopResponse, own: Pair, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    start = _poles_apart(own.re + 1j * own.im, response.period)
    last = run_steps(refine_closed_loop_poles, (response, own), 1 / way, start, len(way))
    is_found = np.all((last.step < AT_REST) & np.isfinite(last.pole.re), axis=0)
    return last.pole.re + 1j * last.pole.im, is_found


def _poles_apart(poles: np.ndarray, period: np.ndarray) -> OrderPoles:
    """Initial guesses, slightly apart."""
    poles = poles + ASIDE * np.abs(poles) * np.exp(1j * np.array(ANGLES[: len(poles)]))[:, None]
    return OrderPoles(_pair(poles), _pair(np.exp(-poles * period)), np.zeros(poles.shape))


def _pair(x: np.ndarray) -> Pair:
    return Pair(np.ascontiguousarray(x.real), np.ascontiguousarray(x.imag))
