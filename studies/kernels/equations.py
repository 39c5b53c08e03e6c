"""Structure of JAX's programs (jaxprs); no other module looks inside one.

JAX 0.10 has open and closed jaxprs and counts the operands of a scan (`num_consts`, `num_carry`);
since JAX 0.12 both are one class and trees (`ft_in`) describe the operands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np


class Function(NamedTuple):
    """A traced function."""

    inputs: Sequence[Any]  # variables
    outputs: Sequence[Any]  # variables and literals
    equations: Sequence[Any]
    constants: list[tuple[Any, np.ndarray]]  # variables with known values
    source: Any  # JAX's own object: one for all calls of a function

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Shapes of the results."""
        return [x.aval.shape for x in self.outputs]

    @property
    def is_real(self) -> bool:
        """Whether all results are floating-point numbers."""
        return all(np.issubdtype(x.aval.dtype, np.floating) for x in self.outputs)


class Scan(NamedTuple):
    """A loop over the leading axes of arrays."""

    body: Function  # of constants, carry and one row; returns carry and one row of results
    length: int
    n_constants: int
    n_carry: int
    is_reversed: bool


def trace(function: Callable[..., Any], *arguments: Any) -> tuple[Function, Any]:
    """Trace a function.

    Args:
        function: JAX function.
        arguments: arrays, or their shapes and types, in pytrees.

    Returns:
        The traced function, and shapes and types of its result in the result's own tree.
    """
    jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return _function_of(jaxpr), shapes


def literal(atom: Any) -> np.ndarray | None:
    """Value of a literal; None for a variable."""
    return np.asarray(atom.val) if hasattr(atom, "val") else None


def scan_of(equation: Any) -> Scan | None:
    """The loop that an equation stands for; None for other equations.

    Raises:
        NotImplementedError: this version of JAX describes loops in another way.
    """
    if equation.primitive.name != "scan":
        return None
    params = equation.params
    try:
        if "ft_in" in params:
            n_constants, n_carry, _ = map(len, params["ft_in"].unpack())
        else:
            n_constants, n_carry = params["num_consts"], params["num_carry"]
        return Scan(
            body=_function_of(params["jaxpr"]),
            length=params["length"],
            n_constants=n_constants,
            n_carry=n_carry,
            is_reversed=params["reverse"],
        )
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        raise NotImplementedError(
            f"scan as JAX {jax.__version__} describes it ({type(error).__name__}: {error})"
        ) from None


def call_of(equation: Any) -> Function | None:
    """The function that an equation calls (jit, custom derivatives, remat); None for others.

    A call hands its operands to the function as they are; loops and kernels do not.
    """
    params = equation.params
    inner = params.get("jaxpr") or params.get("call_jaxpr")
    if inner is None or equation.primitive.name == "scan":
        return None
    function = _function_of(inner)
    return function if len(function.inputs) == len(equation.invars) else None


def _function_of(jaxpr: Any) -> Function:
    body = getattr(jaxpr, "jaxpr", jaxpr)
    values = map(np.asarray, getattr(jaxpr, "consts", ()))
    constants = list(zip(body.constvars, values, strict=True))
    return Function(
        inputs=body.invars,
        outputs=body.outvars,
        equations=body.eqns,
        constants=constants,
        source=jaxpr,
    )
