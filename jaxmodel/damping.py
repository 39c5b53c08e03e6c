"""Damping of the controlled modes, from poles of the closed loop traced as gains rise.

With gains times k, the loop has its poles where det(1/k - L(s)) = 0. The modes of one order,
one per link, lie close together; their poles are found jointly by the Ehrlich-Aberth iteration,
which keeps them apart. det itself has poles where the uncontrolled machine has them: these are
found first, in the same way from those of links with held ends, and multiplied out. Elementwise
steps like those of `jaxmodel.loci`; poles that do not converge are traced again in finer ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.pairs import Pair
from jaxmodel.parameters import Array, Num
from jaxmodel.return_difference import (
    AssembledModes,
    LoopResponse,
    characteristic_polynomial,
    evaluate_loop_gain,
)
from jaxmodel.steps import Steps, in_groups, lanes_of

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
#: Largest step, as a share of the pole's own size.
STRIDE = 0.1
_TERMS = 8


def damping_ratios(
    response: LoopResponse, modes: AssembledModes, n_links: Array, n_orders: int, steps: Steps
) -> Array:
    """Least damping ratio of the controlled modes of each order [1], (n, n_orders).

    Of the modes of an order, only the most damped count, as many as there are controlled
    links. NaN if no link is controlled, or the poles were not found.

    Args:
        response: of the loops, lanes last.
        modes: of the machines without control, lanes last.
        n_links: controlled ones of each case, (n,).
        n_orders: number of mode orders.
        steps: runs elementwise steps.
    """
    known = min(n_orders, response.square.shape[1])

    def one(order: Array) -> Array:
        poles = _poles(response, modes, order, steps)
        return least_controlled(-poles.re / jnp.hypot(poles.re, poles.im), n_links, jnp)

    found = jax.lax.map(one, jnp.arange(known)).T
    return jnp.pad(found, [(0, 0), (0, n_orders - known)], constant_values=jnp.nan)


def least_controlled(ratio: Array, n_links: Array, xp: Any = np) -> Array:
    """Least damping ratio of the most damped modes, one per controlled link [1], (n,).

    Args:
        ratio: of the modes of an order [1], (l, n).
        n_links: controlled ones, (n,).
        xp: NumPy or `jax.numpy`.
    """
    falling = xp.sort(ratio, axis=0)[::-1]
    least = falling[xp.maximum(n_links, 1) - 1, xp.arange(len(n_links))]
    return xp.where(n_links > 0, least, xp.nan)


def _poles(response: LoopResponse, modes: AssembledModes, order: Array, steps: Steps) -> Pair:
    """The poles of an order [1/s], NaN where they were not found, (l, n)."""
    own = _open_loop_poles(response, modes, order, steps)
    found = _follow(response, own, WAYS[0], steps)

    def again(at: Array) -> Pair:
        return _follow(lanes_of(response, at), lanes_of(own, at), WAYS[1], steps)

    is_lost = jnp.isnan(found.re[0]) & ~jnp.isnan(own.re[0])
    return in_groups(again, is_lost, found)


def _open_loop_poles(
    response: LoopResponse, modes: AssembledModes, order: Array, steps: Steps
) -> Pair:
    """The poles of an order without control [1/s], NaN where they were not found, (l, n)."""
    share = modes.share[order + 1]
    which = jnp.argsort(-share, axis=0)[: len(response.square)]
    omega, loss, share = (
        jnp.take_along_axis(x, which, axis=0) for x in (modes.omega, modes.decay, share)
    )
    square, decay = response.square[:, order], response.decay[:, order] / 2
    held = Pair(-decay, jnp.sqrt(square - decay**2))
    guess = Pair(-loss, jnp.sqrt(omega**2 - loss**2))
    own = _settle(response, held, _poles_apart(guess, response), SETTLING, steps)

    def further(at: Array) -> OrderPoles:
        mine, apart, start = lanes_of((response, held, own), at)
        return _settle(mine, apart, start, 2 * SETTLING, steps)

    own = in_groups(further, jnp.any(own.step > SETTLED, axis=0), own)
    is_there = jnp.all(own.step <= SETTLED, axis=0) & (jnp.min(share, axis=0) > CLEAR)
    return Pair(jnp.where(is_there, own.pole.re, jnp.nan), own.pole.im)


def _settle(
    response: LoopResponse, held: Pair, start: OrderPoles, count: int, steps: Steps
) -> OrderPoles:
    return steps(refine_open_loop_poles, (response, held), (), start, count)


def _follow(response: LoopResponse, own: Pair, way: np.ndarray, steps: Steps) -> Pair:
    start = _poles_apart(own, response)
    last = steps(refine_closed_loop_poles, (response, own), 1 / way, start, len(way))
    is_found = jnp.all((last.step < AT_REST) & jnp.isfinite(last.pole.re), axis=0)
    return Pair(jnp.where(is_found, last.pole.re, jnp.nan), last.pole.im)


def _poles_apart(poles: Pair, response: LoopResponse) -> OrderPoles:
    """Initial guesses, slightly apart."""
    angle = np.array(ANGLES[: len(poles.re)])[:, None]
    aside = ASIDE * jnp.hypot(poles.re, poles.im)
    pole = poles + Pair(aside * np.cos(angle), aside * np.sin(angle))
    size, turn = jnp.exp(-pole.re * response.period), pole.im * response.period
    return OrderPoles(pole, Pair(size * jnp.cos(turn), -size * jnp.sin(turn)), 0 * size)


class OrderPoles(NamedTuple):
    """Poles of one mode order being traced, one per link."""

    pole: Pair  # s [1/s], (n,)
    shift: Pair  # exp(-s T), (n,)
    step: Num[Array, "n"]  # size of the last step over that of the pole [1]


def refine_open_loop_poles(
    constants: tuple[LoopResponse, Pair], _: tuple[()], traced: OrderPoles
) -> OrderPoles:
    """Refine the poles of an order of the uncontrolled machine.

    Args:
        constants: response of the loop; poles of the links with held ends [1/s], (n,).
        traced: so far.
    """
    response, held = constants

    def function(s: Pair, shift: Pair) -> Pair:
        return evaluate_loop_gain(response, s, shift).assembled

    return _improved(response, function, held, traced)


def refine_closed_loop_poles(
    constants: tuple[LoopResponse, Pair], inverse: Array, traced: OrderPoles
) -> OrderPoles:
    """Refine the poles of an order of the closed loop.

    Args:
        constants: response of the loop; poles without control [1/s], (n,).
        inverse: 1/k [1], ().
        traced: so far.
    """
    response, own = constants
    level = Pair(inverse * jnp.ones_like(traced.step[0]), jnp.zeros_like(traced.step[0]))

    def function(s: Pair, shift: Pair) -> Pair:
        return characteristic_polynomial(evaluate_loop_gain(response, s, shift), level)

    return _improved(response, function, own, traced)


def _improved(
    response: LoopResponse, function: Callable[[Pair, Pair], Pair], poles: Pair, traced: OrderPoles
) -> OrderPoles:
    """One iteration towards zeros of a function with these poles."""
    count, one = len(traced.step), jnp.ones_like(traced.step[0])
    zero = jnp.zeros_like(one)

    def improve(traced: OrderPoles, _: None) -> tuple[OrderPoles, None]:
        s, shift = traced.pole[0], traced.shift[0]
        value, change = jax.jvp(function, (s, shift), (Pair(one, zero), shift * -response.period))
        slope = change * value.inverse()
        for k in range(count):
            slope = slope + (s - poles[k]).inverse()
        for k in range(1, count):
            slope = slope - (s - traced.pole[k]).inverse()
        move = -slope.inverse()
        size = jnp.sqrt((move.re * move.re + move.im * move.im) / (s.re * s.re + s.im * s.im))
        move = move * (STRIDE / jnp.maximum(size, STRIDE))
        angle = move * -response.period
        growth = angle * (1 / _TERMS) + 1.0
        for n in range(_TERMS - 1, 0, -1):
            growth = growth * angle * (1 / n) + 1.0
        new = OrderPoles(s + move, shift * growth, size)

        def turned(old: Array, last: Array) -> Array:
            return jnp.concatenate([old[1:], last[None]])

        return jax.tree.map(turned, traced, new), None

    return jax.lax.scan(improve, traced, None, length=count)[0]
