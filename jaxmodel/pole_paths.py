"""Poles of the closed loop, traced from those of the uncontrolled machine as gains rise.

With gains times k, the loop has its poles where det(1/k - L(s)) = 0. The three modes of one order,
one per link, lie close together; their poles are found jointly by the Ehrlich-Aberth iteration,
which keeps them apart. det itself has poles where the uncontrolled machine has them: these are
found first, in the same way from those of links with held ends, and multiplied out. Elementwise
steps for the same executors as `loci.walk`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from jaxmodel.lazy import jax, jnp
from jaxmodel.pairs import Pair
from jaxmodel.parameters import Array
from jaxmodel.return_difference import LoopResponse, go_round, spectrum_polynomial

#: Largest step, as a share of the pole's own size.
STRIDE = 0.1
_TERMS = 8


class Trio(NamedTuple):
    """Three poles being traced."""

    pole: Pair  # s [1/s], (3,)
    shift: Pair  # exp(-s T), (3,)
    step: Array  # size of the last step over that of the pole [1], (3,)


def settle(response: LoopResponse, held: Pair, trio: Trio) -> Trio:
    """Refine three poles of the uncontrolled machine.

    Args:
        response: of the loop.
        held: poles of the links with held ends [1/s], (3,).
        trio: so far.
    """

    def wanted(s: Pair, shift: Pair) -> Pair:
        return go_round(response, s, shift).pose_inverse.inverse()

    return _improved(response, wanted, held, trio)


def follow(response: LoopResponse, own: Pair, trio: Trio, inverse: Array) -> Trio:
    """Refine three poles of the closed loop.

    Args:
        response: of the loop.
        own: poles without control [1/s], (3,).
        trio: so far.
        inverse: 1/k [1], ().
    """
    level = Pair(inverse * jnp.ones_like(trio.step[0]), jnp.zeros_like(trio.step[0]))

    def wanted(s: Pair, shift: Pair) -> Pair:
        return spectrum_polynomial(go_round(response, s, shift), level)

    return _improved(response, wanted, own, trio)


def _improved(
    response: LoopResponse, wanted: Callable[[Pair, Pair], Pair], poles: Pair, trio: Trio
) -> Trio:
    """One iteration towards zeros of a function with these poles."""
    one = jnp.ones_like(trio.step[0])
    zero = jnp.zeros_like(one)

    def improve(trio: Trio, _: None) -> tuple[Trio, None]:
        s, shift = trio.pole[0], trio.shift[0]
        found, change = jax.jvp(wanted, (s, shift), (Pair(one, zero), shift * -response.period))
        slope = change * found.inverse()
        for k in range(3):
            slope = slope + (s - poles[k]).inverse()
        for k in (1, 2):
            slope = slope - (s - trio.pole[k]).inverse()
        move = -slope.inverse()
        size = jnp.sqrt((move.re * move.re + move.im * move.im) / (s.re * s.re + s.im * s.im))
        move = move * (STRIDE / jnp.maximum(size, STRIDE))
        angle = move * -response.period
        turn = angle * (1 / _TERMS) + 1.0
        for n in range(_TERMS - 1, 0, -1):
            turn = turn * angle * (1 / n) + 1.0
        new = Trio(s + move, shift * turn, size)

        def turned(old: Array, last: Array) -> Array:
            return jnp.concatenate([old[1:], last[None]])

        return jax.tree.map(turned, trio, new), None

    return jax.lax.scan(improve, trio, None, length=3)[0]
