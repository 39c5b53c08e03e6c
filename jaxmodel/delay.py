"""When commands reach the actuators: delays of any length between a sample and its command.

A delay of d samples, n = ceil(d) - 1 whole ones and a rest 0 < f <= 1, puts a change of command
inside every sample: until t_k + f T the actuators have u_(k-n-1), from then on u_(k-n). The plant
takes its steps before and after the change, so that it stays exact for held commands; the linear
models compose both parts (docs/theory.md, "Delays").
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Electronics
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num

#: Longest delay [samples].
LONGEST = 4


class CommandChange(NamedTuple):
    """Which commands u_(k-j), j = 0 to `LONGEST`, a sample has, and when they change."""

    before: Num[Array, "J"]  # 1 for the one until the change, else 0
    after: Num[Array, "J"]  # the same from the change on
    share: Num[Array, ""]  # of the sample until the change, 0 to 1 [1]


def command_change(delay: Array) -> CommandChange:
    """The change of command within every sample.

    Differentiable by the delay, at whole numbers by that of shorter delays.

    Args:
        delay: d, 0 to `LONGEST` [samples], ().

    Returns:
        CommandChange; without delay the change is at the start of the sample.
    """
    whole = jnp.maximum(jnp.ceil(jax.lax.stop_gradient(delay)), 1.0)
    order = jnp.arange(LONGEST + 1.0)
    one, zero = jnp.ones_like(order), jnp.zeros_like(order)
    return CommandChange(
        before=jnp.where(order == whole, one, zero),
        after=jnp.where(order == whole - 1, one, zero),
        share=delay - (whole - 1),
    )


def true_delay(electronics: Electronics) -> Array:
    """Delay of the machine, whether the controller knows it or not [samples], ()."""
    return electronics.delay + electronics.unmodelled_delay
