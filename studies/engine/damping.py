"""Damping ratios of the controlled modes of every case, from poles traced as gains rise.

See `jaxmodel.pole_paths`; poles that do not converge are traced again in finer steps.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxmodel.pairs import Pair
from jaxmodel.pole_paths import OrderPoles, refine_closed_loop_poles, refine_open_loop_poles
from jaxmodel.return_difference import AssembledModes, LoopResponse
from studies.engine.lanes import run_steps

#: Iterations to find the poles without control.
SETTLING = 6
#: Gain factors on the way to 1, one iteration each; the second path is for poles that did not
#: converge on the first.
WAYS = (
    np.concatenate([np.arange(1, 17) / 16, np.ones(6)]),
    np.concatenate([np.repeat(np.arange(1, 61) / 60, 2), np.ones(10)]),
)
#: A last step, as a share of the pole, that counts as converged.
AT_REST = 1e-4
#: Initial distance of poles from one another and from poles of the function [1].
ASIDE = 1e-4
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
    count = len(n_links)
    ratios = np.full((count, n_orders), np.nan)
    for order in range(min(n_orders, response.square.shape[1])):
        poles = _poles(response, modes, order)
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


def _poles(response: LoopResponse, modes: AssembledModes, order: int) -> np.ndarray:
    """The poles of an order [1/s], complex, NaN where they were not found, (l, n)."""
    square, decay = response.square[:, order], response.decay[:, order] / 2
    held = _pair(-decay + 1j * np.sqrt(square - decay**2))
    which = np.argsort(-modes.share[order + 1], axis=0)[: len(square)]
    omega, loss = (np.take_along_axis(x, which, axis=0) for x in (modes.omega, modes.decay))
    first = _poles_apart(-loss + 1j * np.sqrt(omega**2 - loss**2), response.period)
    own = run_steps(_refine_open_loop_poles, (response, held), (), first, SETTLING).pole
    poles, is_found = _follow(response, own, WAYS[0])
    again = np.flatnonzero(~is_found)
    if len(again):
        remaining, start = jax.tree.map(lambda x: x[..., again], (response, own))
        poles[:, again], is_found[again] = _follow(remaining, start, WAYS[1])
    return np.where(is_found, poles, np.nan)


def _follow(response: LoopResponse, own: Pair, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    start = _poles_apart(own.re + 1j * own.im, response.period)
    last = run_steps(_refine_closed_loop_poles, (response, own), 1 / way, start, len(way))
    is_found = np.all((last.step < AT_REST) & np.isfinite(last.pole.re), axis=0)
    return last.pole.re + 1j * last.pole.im, is_found


def _poles_apart(poles: np.ndarray, period: np.ndarray) -> OrderPoles:
    """Initial guesses, slightly apart."""
    poles = poles + ASIDE * np.abs(poles) * np.exp(1j * np.array(ANGLES[: len(poles)]))[:, None]
    return OrderPoles(_pair(poles), _pair(np.exp(-poles * period)), np.zeros(poles.shape))


def _pair(x: np.ndarray) -> Pair:
    return Pair(np.ascontiguousarray(x.real), np.ascontiguousarray(x.imag))


def _refine_open_loop_poles(
    constants: tuple[LoopResponse, Pair], _: tuple[Any, ...], traced: OrderPoles
) -> OrderPoles:
    return refine_open_loop_poles(*constants, traced)


def _refine_closed_loop_poles(
    constants: tuple[LoopResponse, Pair], inverse: Any, traced: OrderPoles
) -> OrderPoles:
    return refine_closed_loop_poles(*constants, traced, inverse)
