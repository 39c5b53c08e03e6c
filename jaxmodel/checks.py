"""Checks of arguments, with messages that name argument, value and range."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.table import PartError


def check_shape(name: str, value: Any, shape: Sequence[int]) -> None:
    """Raise PartError unless an argument has a shape."""
    found = jnp.shape(jnp.asarray(value))
    if found != tuple(shape):
        raise PartError(f"{name}: shape {found}; expected {tuple(shape)}")


def check_below(name: str, value: Any, low: float, high: float, unit: str) -> None:
    """Raise PartError unless low <= value < high, if the value is known and not traced."""
    if isinstance(value, jax.core.Tracer):
        return
    wrong = np.ravel(value)[~((low <= np.ravel(value)) & (np.ravel(value) < high))]
    if wrong.size:
        raise PartError(f"{name} = {wrong[0]:g}; allowed: {low:g} <= {name} < {high:g} [{unit}]")
