"""Shapes of arguments, with messages that name what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxmodel.lazy import jnp
from jaxmodel.table import PartError


def check_shape(name: str, value: Any, shape: Sequence[int]) -> None:
    """Raise PartError unless an argument has a shape, or one with more axes before it."""
    found = jnp.shape(jnp.asarray(value))
    if found[len(found) - len(shape) :] != tuple(shape):
        raise PartError(f"{name}: shape {found}; expected {tuple(shape)}")
