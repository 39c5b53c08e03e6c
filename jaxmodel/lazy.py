"""JAX under its usual names, loaded on first use, so that reading tables does not wait for it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any


class _LazyModule:
    """A module that is imported on first attribute access."""

    def __init__(self, name: str) -> None:
        self.__name__ = name

    def __getattr__(self, name: str) -> Any:
        value = getattr(import_module(self.__name__), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
else:
    jax, jnp = _LazyModule("jax"), _LazyModule("jax.numpy")

__all__ = ["jax", "jnp"]
