"""JAX under its usual names, loaded on first use, so that reading tables does not wait for it."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar, cast


class _LazyModule:
    """A module that is imported on first attribute access."""

    def __init__(self, name: str) -> None:
        self.__name__ = name

    def __getattr__(self, name: str) -> Any:
        value = getattr(import_module(self.__name__), name)
        setattr(self, name, value)
        return value


_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(*static: str) -> Callable[[_F], _F]:
    """Have calls with numbers run as one program: step by step, the first one takes minutes.

    Within a transformation of JAX, which has a program of its own, nothing changes.

    static: names of the arguments that are part of the program.
    """

    def wrap(function: _F) -> _F:
        made: list[Callable[..., Any]] = []

        @wraps(function)
        def call(*arguments: Any, **named: Any) -> Any:
            leaves = jax.tree.leaves((arguments, named))
            if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
                return function(*arguments, **named)
            if not made:
                made.append(jax.jit(function, static_argnames=static))
            return made[0](*arguments, **named)

        return cast(_F, call)

    return wrap


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
else:
    jax, jnp = _LazyModule("jax"), _LazyModule("jax.numpy")

__all__ = ["compiled", "jax", "jnp"]
