"""Poles of the closed loop, traced from those of the uncontrolled machine as gains rise.

With gains times k, the loop has its poles where det(1/k - L(s)) = 0. The modes of one order,
one per link, lie close together; their poles are found jointly by the Ehrlich-Aberth iteration,
which keeps them apart. det itself has poles where the uncontrolled machine has them: these are
found first, in the same way from those of links with held ends, and multiplied out. Elementwise
steps for the same executors as `loci.follow_loci`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from jaxmodel.lazy import jax, jnp
from jaxmodel.pairs import Pair
from jaxmodel.parameters import Array
from jaxmodel.return_difference import LoopResponse, characteristic_polynomial, evaluate_loop_gain

#: Largest step, as a share of the pole's own size.
STRIDE = 0.1
_TERMS = 8


class OrderPoles(NamedTuple):
    """Poles of one mode order being traced, one per link."""

    pole: Pair  # s [1/s], (n,)
    shift: Pair  # exp(-s T), (n,)
    step: Array  # size of the last step over that of the pole [1], (n,)


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
    response: LoopResponse,
    function: Callable[[Pair, Pair], Pair],
    poles: Pair,
    traced: OrderPoles,
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
