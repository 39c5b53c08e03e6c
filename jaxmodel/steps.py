"""Elementwise steps over many lanes; how they run is up to the caller.

`studies` runs them as traced kernels, JAX alone as a scan; both can be part of a program.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, TypeVar

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array

_S = TypeVar("_S")


class Steps(Protocol):
    """Runs all steps; arrays have lanes last, inputs also have steps first."""

    def __call__(
        self, step: Callable[..., _S], constants: Any, inputs: Any, state: _S, n_steps: int
    ) -> _S:
        """State after the last step.

        Args:
            step: maps (constants, inputs of one step, state) to state; a module-level function.
            constants: what no step changes.
            inputs: of each step; those shared by all lanes have one axis.
            state: before the first step.
            n_steps: how many.
        """


def scan_steps(step: Callable[..., _S], constants: Any, inputs: Any, state: _S, n_steps: int) -> _S:
    """The steps as JAX's scan, see `Steps`."""

    def body(at: _S, row: Any) -> tuple[_S, None]:
        return step(constants, row, at), None

    return jax.lax.scan(body, state, inputs, length=n_steps)[0]


#: Lanes of a group at least, and groups of all lanes at most: a device with many threads wants
#: large ones.
GROUP, GROUPS = 8, 64


def lanes_of(tree: Any, at: Array) -> Any:
    """Some lanes of arrays."""
    return jax.tree.map(lambda x: jnp.take(x, at, axis=-1, mode="clip"), tree)


def in_groups(work: Callable[[Array], _S], chosen: Array, like: _S) -> _S:
    """Results of those lanes only that are chosen, group by group.

    Args:
        work: maps numbers of lanes, those of a group, to their results, lanes last.
        chosen: which lanes, (n,).
        like: results of all lanes, which the others keep, (..., n).
    """
    count, size = jnp.sum(chosen), max(GROUP, len(chosen) // GROUPS)
    order = jnp.argsort(~chosen, stable=True)
    order = jnp.concatenate([order, jnp.repeat(order[-1:], size)])

    def one(state: tuple[Array, _S]) -> tuple[Array, _S]:
        first, done = state
        results = work(jax.lax.dynamic_slice(order, (first,), (size,)))
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=first, axis=-1)
        return first + size, jax.tree.map(put, done, results)

    room = jax.tree.map(lambda x: jnp.repeat(x[..., :1], len(order), axis=-1), like)
    start = jnp.zeros((), int), room
    done = jax.lax.while_loop(lambda state: state[0] < count, one, start)[1]
    place = jnp.cumsum(chosen) - 1
    found: _S = jax.tree.map(lambda x, y: jnp.where(chosen, lanes_of(x, place), y), done, like)
    return found
