"""Poles of the closed loop, traced from those of the uncontrolled machine as gains rise.

With gains times k, the loop has its poles where det(1/k - L(s)) = 0. The three modes of one order,
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


class PoleTriplet(NamedTuple):
    """Three poles being traced."""

    pole: Pair  # s [1/s], (3,)
    shift: Pair  # exp(-s T), (3,)
    step: Array  # size of the last step over that of the pole [1], (3,)


def refine_open_loop_poles(response: LoopResponse, held: Pair, triplet: PoleTriplet) -> PoleTriplet:
    """Refine three poles of the uncontrolled machine.

    Args:
        response: of the loop.
        held: poles of the links with held ends [1/s], (3,).
        triplet: so far.
    """

    def function(s: Pair, shift: Pair) -> Pair:
        return evaluate_loop_gain(response, s, shift).pose_inverse.inverse()

    return _improved(response, function, held, triplet)


def refine_closed_loop_poles(
    response: LoopResponse, own: Pair, triplet: PoleTriplet, inverse: Array
) -> PoleTriplet:
    """Refine three poles of the closed loop.

    Args:
        response: of the loop.
        own: poles without control [1/s], (3,).
        triplet: so far.
        inverse: 1/k [1], ().
    """
    level = Pair(inverse * jnp.ones_like(triplet.step[0]), jnp.zeros_like(triplet.step[0]))

    def function(s: Pair, shift: Pair) -> Pair:
        return characteristic_polynomial(evaluate_loop_gain(response, s, shift), level)

    return _improved(response, function, own, triplet)


def _improved(
    response: LoopResponse,
    function: Callable[[Pair, Pair], Pair],
    poles: Pair,
    triplet: PoleTriplet,
) -> PoleTriplet:
    """One iteration towards zeros of a function with these poles."""
    one = jnp.ones_like(triplet.step[0])
    zero = jnp.zeros_like(one)

    def improve(triplet: PoleTriplet, _: None) -> tuple[PoleTriplet, None]:
        s, shift = triplet.pole[0], triplet.shift[0]
        value, change = jax.jvp(function, (s, shift), (Pair(one, zero), shift * -response.period))
        slope = change * value.inverse()
        for k in range(3):
            slope = slope + (s - poles[k]).inverse()
        for k in (1, 2):
            slope = slope - (s - triplet.pole[k]).inverse()
        move = -slope.inverse()
        size = jnp.sqrt((move.re * move.re + move.im * move.im) / (s.re * s.re + s.im * s.im))
        move = move * (STRIDE / jnp.maximum(size, STRIDE))
        angle = move * -response.period
        growth = angle * (1 / _TERMS) + 1.0
        for n in range(_TERMS - 1, 0, -1):
            growth = growth * angle * (1 / n) + 1.0
        new = PoleTriplet(s + move, shift * growth, size)

        def turned(old: Array, last: Array) -> Array:
            return jnp.concatenate([old[1:], last[None]])

        return jax.tree.map(turned, triplet, new), None

    return jax.lax.scan(improve, triplet, None, length=3)[0]
