"""A traced function as a graph of scalar operations, simplified while it is built.

`Graph.trace` executes a function's equations on arrays of nodes. A node is a number of one case:
*known* (a Python number, folded immediately), *shared* (the same for all cases) or *varying*. Equal
operations on equal nodes are one node, and unused results are never visited, so the graph holds
only the necessary arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from studies.errors import NoKernelError
from studies.kernels.equations import Function, Scan, call_of, literal, scan_of, trace


class Node:
    """One operation, or one number read from memory (`read`)."""

    __slots__ = ("args", "is_truth", "is_varying", "operation", "place")

    def __init__(
        self,
        operation: str,
        args: tuple[Any, ...],
        is_varying: bool,
        is_truth: bool,
        place: Any = None,
    ) -> None:
        self.operation, self.args = operation, args
        self.is_varying, self.is_truth = is_varying, is_truth
        self.place = place  # of a `read`: its identification by the reader


class Graph:
    """Creates nodes; one instance per traced function."""

    def __init__(self) -> None:
        self._nodes: dict[tuple[Any, ...], Node] = {}

    def read(self, place: Any, is_varying: bool) -> Node:
        """A number from memory."""
        return Node("read", (), is_varying, False, place)

    def trace(
        self, function: Callable[..., Any], arguments: Sequence[Any], dtype: Any
    ) -> list[np.ndarray]:
        """Trace a function of lists of arrays.

        Args:
            function: elementwise JAX function, `function(*arguments)`.
            arguments: lists of arrays of nodes and numbers.
            dtype: of all of them.

        Returns:
            Arrays of nodes and numbers, flat in the order of the function's result.

        Raises:
            NoKernelError: the function uses what a graph does not support, or this version of JAX
                describes it in an unknown way.
        """
        shapes = [[jax.ShapeDtypeStruct(x.shape, dtype) for x in part] for part in arguments]
        traced, _ = trace(function, *shapes)  # runs the function: its errors are its own
        inputs = [x for part in arguments for x in part]
        try:
            self._survey(traced, inputs)
            return self._evaluate(traced, inputs)
        except NotImplementedError as error:
            raise NoKernelError(f"the traced kernel does not support {error}") from None
        except Exception as error:  # a structure of JAX's that is not expected
            reason = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
            raise NoKernelError(
                f"JAX {jax.__version__} gives no traced kernel of the step ({reason})"
            ) from error

    def _survey(self, traced: Function, inputs: list[np.ndarray]) -> None:
        """What is to be known of a function before its equations are carried out; here nothing."""

    # --- equations --------------------------------------------------------------------------------

    def _evaluate(self, function: Function, inputs: list[np.ndarray]) -> list[Any]:
        values: dict[Any, np.ndarray] = {}

        def value(atom: Any) -> np.ndarray:
            number = literal(atom)
            return values[atom] if number is None else _numbers(number)

        values |= {variable: _numbers(x) for variable, x in function.constants}
        values |= dict(zip(function.inputs, inputs, strict=True))
        for equation in function.equations:
            arguments = [value(atom) for atom in equation.invars]
            scan, inner = scan_of(equation), call_of(equation)
            if scan is not None:
                results = self._unroll(scan, arguments)
            elif inner is not None:
                results = self._inline(inner, arguments)
            else:
                results = [self._apply(equation, arguments)]
            values |= dict(zip(equation.outvars, results, strict=True))
        return [value(atom) for atom in function.outputs]

    def _inline(self, inner: Function, inputs: list[np.ndarray]) -> list[Any]:
        """A function that is called."""
        return self._evaluate(inner, inputs)

    def _unroll(self, scan: Scan, inputs: list[np.ndarray]) -> list[np.ndarray]:
        first = scan.n_constants + scan.n_carry
        constants, carry, stacked = (
            inputs[: scan.n_constants],
            inputs[scan.n_constants : first],
            inputs[first:],
        )
        kept = []
        order = range(scan.length)[:: -1 if scan.is_reversed else 1]
        for k in order:
            rows = [x[k : k + 1].reshape(x.shape[1:]) for x in stacked]
            results = self._evaluate(scan.body, [*constants, *carry, *rows])
            carry = results[: scan.n_carry]
            kept.append(results[scan.n_carry :])
        kept = kept[:: order.step]
        return [*carry, *(np.stack(parts) for parts in zip(*kept, strict=True))]

    def _apply(self, equation: Any, inputs: list[np.ndarray]) -> np.ndarray:
        name, params = equation.primitive.name, equation.params
        shape = equation.outvars[0].aval.shape
        if name in _STRUCTURAL:
            return _STRUCTURAL[name](params, shape, *inputs)
        if name.startswith("reduce_"):
            return self._reduce(name.removeprefix("reduce_"), inputs[0], params["axes"], shape)
        if name == "integer_pow":
            return self._each(lambda x: self._power(x, params["y"]), inputs, shape)
        if name == "convert_element_type":
            is_truth = np.dtype(params["new_dtype"]) == bool
            return self._each(lambda x: self._convert(x, is_truth), inputs, shape)
        return self._each(self.operation(name), inputs, shape)

    def _each(
        self, operation: Callable[..., Any], inputs: list[np.ndarray], shape: tuple[int, ...]
    ) -> np.ndarray:
        wide = [np.broadcast_to(array, shape) for array in inputs]
        values = [operation(*row) for row in zip(*(array.flat for array in wide), strict=True)]
        return objects(values, shape)

    def _reduce(
        self, name: str, array: np.ndarray, axes: tuple[int, ...], shape: tuple[int, ...]
    ) -> np.ndarray:
        join = getattr(self, "_op_" + {"sum": "add"}.get(name, name))
        kept = [k for k in range(array.ndim) if k not in axes]
        rows = np.transpose(array, [*kept, *axes]).reshape(int(np.prod(shape)), -1)
        return objects([_tree(join, list(row)) for row in rows], shape)

    # --- operations on single numbers -------------------------------------------------------------

    def operation(self, name: str) -> Callable[..., Any]:
        """JAX's operation `name`, on nodes and numbers.

        Raises:
            NotImplementedError: not supported here.
        """
        if name in _COMPARE:
            return partial(self._compare, name)
        method = getattr(self, f"_op_{name}", None)
        if method is None:
            raise NotImplementedError(f"operation {name!r} of the step")
        return method

    def _node(self, operation: str, *args: Any, is_truth: bool = False) -> Node:
        names = [id(x) if type(x) is Node else (type(x), x) for x in args]
        if operation in _SYMMETRIC:
            names.sort(key=hash)
        key = (operation, *names)
        node = self._nodes.get(key)
        if node is None:
            is_varying = any(
                [type(x) is Node and x.is_varying for x in args]  # noqa: C419 (faster)
            )
            node = self._nodes[key] = Node(operation, args, is_varying, is_truth)
        return node

    def _op_add(self, a: Any, b: Any) -> Any:
        if is_known(a) and is_known(b):
            return a + b
        if _is(a, 0) or _is(b, 0):
            return b if _is(a, 0) else a
        return self._node("add", a, b)

    _op_add_any = _op_add  # of tangents

    def _op_sub(self, a: Any, b: Any) -> Any:
        if is_known(a) and is_known(b):
            return a - b
        if _is(b, 0):
            return a
        return self._op_neg(b) if _is(a, 0) else self._node("sub", a, b)

    def _op_mul(self, a: Any, b: Any) -> Any:
        if is_known(a) and is_known(b):
            return a * b
        for one, other in ((a, b), (b, a)):
            if _is(one, 1):
                return other
            if _is(one, -1):
                return self._op_neg(other)
            if _is(one, 0):
                return 0.0  # a non-finite number shows in the state itself
        return self._node("mul", a, b)

    def _op_div(self, a: Any, b: Any) -> Any:
        # several divisions by one number share its reciprocal: a division costs 16 cycles
        if is_known(b):
            return self._op_mul(a, float(np.divide(1.0, b)))
        return self._op_mul(a, self._node("reciprocal", b))

    def _op_neg(self, a: Any) -> Any:
        return -a if is_known(a) else self._node("neg", a)

    def _op_square(self, a: Any) -> Any:
        return self._op_mul(a, a)

    def _power(self, a: Any, y: int) -> Any:
        if y < 0:
            return self._op_div(1.0, self._power(a, -y))
        return _tree(self._op_mul, [a] * y) if y else 1.0

    def _convert(self, a: Any, is_truth: bool) -> Any:
        if is_truth:
            return self._compare("ne", a, 0.0)
        if is_known(a):
            return float(a)
        return self._op_select_n(a, 0.0, 1.0) if a.is_truth else a

    def _compare(self, sign: str, a: Any, b: Any) -> Any:
        if is_known(a) and is_known(b):
            return bool(_COMPARE[sign](a, b))
        return self._node(sign, a, b, is_truth=True)

    def _op_and(self, a: Any, b: Any) -> Any:
        if is_known(a) or is_known(b):
            constant, other = (a, b) if is_known(a) else (b, a)
            return other if constant else False
        return self._node("and", a, b, is_truth=True)

    def _op_or(self, a: Any, b: Any) -> Any:
        if is_known(a) or is_known(b):
            constant, other = (a, b) if is_known(a) else (b, a)
            return True if constant else other
        return self._node("or", a, b, is_truth=True)

    def _op_not(self, a: Any) -> Any:
        return not a if is_known(a) else self._node("not", a, is_truth=True)

    def _op_select_n(self, which: Any, no: Any, yes: Any) -> Any:
        if is_known(which):
            return yes if which else no
        if no is yes or (is_known(no) and is_known(yes) and no == yes):
            return no
        is_truth = any(isinstance(x, bool) or getattr(x, "is_truth", False) for x in (no, yes))
        return self._node("select", which, no, yes, is_truth=is_truth)

    def _op_max(self, a: Any, b: Any) -> Any:
        return self._extreme("max", a, b, np.maximum, -np.inf)

    def _op_min(self, a: Any, b: Any) -> Any:
        return self._extreme("min", a, b, np.minimum, np.inf)

    def _extreme(
        self, name: str, a: Any, b: Any, extreme: Callable[..., Any], no_limit: float
    ) -> Any:
        """The larger or smaller one; NaN if either is NaN."""
        if is_known(b):
            a, b = b, a
        if is_known(b):
            return float(extreme(a, b))
        return b if _is(a, no_limit) else self._node(name, a, b)

    def _op_clamp(self, low: Any, x: Any, high: Any) -> Any:
        return self._op_min(self._op_max(x, low), high)

    def _op_sign(self, a: Any) -> Any:
        up = self._op_select_n(self._compare("gt", a, 0.0), 0.0, 1.0)
        return self._op_select_n(self._compare("lt", a, 0.0), up, -1.0)

    def _op_is_finite(self, a: Any) -> Any:
        return self._compare("lt", self._op_abs(a), np.inf)

    def _op_abs(self, a: Any) -> Any:
        return abs(a) if is_known(a) else self._node("abs", a)

    def _op_sqrt(self, a: Any) -> Any:
        return float(np.sqrt(a)) if is_known(a) else self._node("sqrt", a)

    def _op_round(self, a: Any) -> Any:
        return float(np.round(a)) if is_known(a) else self._node("round", a)

    def _op_tanh(self, a: Any) -> Any:
        return float(np.tanh(a)) if is_known(a) else self._node("tanh", a)


def objects(values: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    """An array of nodes and numbers."""
    array = np.empty(len(values), object)
    array[:] = values
    return array.reshape(shape)


def _numbers(array: np.ndarray) -> np.ndarray:
    return objects(array.ravel().tolist(), array.shape)


def is_known(value: Any) -> bool:
    """Whether a value is a number, not a node."""
    return not isinstance(value, Node)


def _is(value: Any, number: float) -> bool:
    return is_known(value) and not isinstance(value, bool) and value == number


def _tree(join: Callable[..., Any], values: list[Any]) -> Any:
    while len(values) > 1:
        pairs = [join(a, b) for a, b in zip(values[::2], values[1::2], strict=False)]
        values = pairs + values[len(values) - len(values) % 2 :]
    return values[0]


_SYMMETRIC = ("add", "mul")
#: Comparisons by their names among JAX's operations.
_COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "gt": lambda a, b: a > b,
    "ge": lambda a, b: a >= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
}


def _broadcast(params: Any, shape: tuple[int, ...], array: np.ndarray, *_: Any) -> np.ndarray:
    places = params["broadcast_dimensions"]
    lined = [1] * len(shape)
    for place, size in zip(places, array.shape, strict=True):
        lined[place] = size
    return np.broadcast_to(array.reshape(lined), shape)


def _slice(params: Any, shape: tuple[int, ...], array: np.ndarray) -> np.ndarray:
    starts, limits = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(starts)
    return array[tuple(map(slice, starts, limits, strides))]


#: Operations that only move elements.
_STRUCTURAL: dict[str, Callable[..., np.ndarray]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda p, shape, a: a.reshape(shape),
    "squeeze": lambda p, shape, a: a.reshape(shape),
    "expand_dims": lambda p, shape, a: a.reshape(shape),
    "transpose": lambda p, shape, a: np.transpose(a, p["permutation"]),
    "slice": _slice,
    "concatenate": lambda p, shape, *a: np.concatenate(a, axis=p["dimension"]),
    "stack": lambda p, shape, *a: np.stack(a, axis=p.get("axis", p.get("dimension", 0))),
    "copy": lambda p, shape, a: a,
    "stop_gradient": lambda p, shape, a: a,
}
