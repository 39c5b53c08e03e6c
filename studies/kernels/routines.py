"""Functions that a step calls more than once, kept as routines instead of written at each call.

Code that is written once stays in the processor's instruction cache: the plant is evaluated four
times in a sample.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from studies.kernels.derivatives import push_forward
from studies.kernels.equations import Function, call_of, scan_of
from studies.kernels.fusion import in_order
from studies.kernels.graph import Graph, Node, is_known, objects

#: Functions of fewer equations are written at every call.
SHORTEST = 40


class Routine:
    """One function under `jax.jit`, as operations on its parameters.

    Numbers that differ between the calls are its parameters, reads of ("parameter", k). What all
    calls share is used as it is: what no sample changes, and `shared` numbers. With directions, the
    tangents of those parameters that move follow the parameters, and tangents of the results the
    results; nothing is `shared` then.
    """

    def __init__(self) -> None:
        self.positions: list[int] = []  # of the parameters among the numbers of a call
        self.moving: list[int] = []  # parameters that have tangents
        self.parameters: list[Node] = []
        self.shared: dict[int, Node] = {}  # numbers of a sample, by identity
        self.results: list[Any] = []
        self.size = 0  # how many results without tangents


class RoutineGraph(Graph):
    """A graph with operations "call" (its place: a `Routine`) and "result" (its place: which)."""

    def __init__(self, seeds: Sequence[dict[int, Any]] = ()) -> None:
        """
        Args:
            seeds: for each direction the tangents of what moves, as `push_forward` takes them.
        """
        super().__init__()
        self._seeds = seeds
        # numbers of all calls, by function
        self._pending_calls: dict[int, list[list[Any]]] | None = None
        self._routines: dict[int, Routine] = {}
        self._calls: dict[tuple[Any, ...], list[Any]] = {}  # results of each call
        self._is_fixed: dict[int, bool] = {}
        self._moves: dict[int, bool] = {}
        self._alive: list[Any] = []  # what is known by its identity

    def _survey(self, traced: Function, inputs: list[np.ndarray]) -> None:
        """Find the routines."""
        repeated = _find_repeated(traced)
        self._alive += repeated.values()
        # in the order of their first calls, so that each is given what the others before it return
        for name, inner in repeated.items():
            # what the calls are given, while the results of further routines are still unknown
            self._pending_calls = {x: [] for x in repeated if x not in self._routines}
            self._evaluate(traced, inputs)
            calls, self._pending_calls = self._pending_calls[name], None
            self._routines[name] = self._routine(inner, calls)

    def _inline(self, inner: Function, inputs: list[np.ndarray]) -> list[Any]:
        name = id(inner.source)
        numbers = [x for array in inputs for x in array.flat]
        if self._pending_calls is not None and name in self._pending_calls:
            self._pending_calls[name].append(numbers)
            call = self._new("call", (), None)
            count = sum(int(np.prod(shape)) for shape in inner.shapes)
            results = [self._new("result", (call,), k) for k in range(count)]
        elif name in self._routines:
            results = self._called(self._routines[name], numbers)
        else:
            return super()._inline(inner, inputs)
        return _arrays(results, inner.shapes)

    def _new(self, operation: str, args: tuple[Any, ...], place: Any) -> Node:
        node = Node(operation, args, True, False, place)
        self._alive.append(node)
        return node

    def _routine(self, inner: Function, calls: list[list[Any]]) -> Routine:
        """The routine of a function.

        Args:
            inner: its equations.
            calls: what each call is given.
        """
        routine, inputs = Routine(), []
        self._classify([x for numbers in calls for x in numbers])
        for position, column in enumerate(zip(*calls, strict=True)):
            if all(_is_same(x, column[0]) for x in column) and self._is_usable(column[0], routine):
                inputs.append(column[0])
                continue
            if self._seeds and any(not is_known(x) and self._moves[id(x)] for x in column):
                routine.moving.append(len(routine.parameters))
            routine.positions.append(position)
            routine.parameters.append(self._parameter(routine))
            inputs.append(routine.parameters[-1])
        outputs = super()._inline(inner, _arrays(inputs, [x.aval.shape for x in inner.inputs]))
        routine.results = [x for array in outputs for x in array.flat]
        routine.size = len(routine.results)
        own, primal = list(routine.parameters), list(routine.results)
        for seed in self._seeds:
            for k, node in enumerate(own):
                seed[id(node)] = 0.0
                if k in routine.moving:
                    seed[id(node)] = self._parameter(routine)
                    routine.parameters.append(seed[id(node)])
            routine.results += push_forward(self, primal, seed)
        self._classify(routine.results)
        return routine

    def _is_usable(self, x: Any, routine: Routine) -> bool:
        """Whether a number that all calls are given can be used inside the routine as it is."""
        if self.is_fixed(x):
            return True
        if self._seeds or x.is_truth:
            return False
        calls = (node for node in in_order([x]) if node.operation == "call")
        is_known_yet = all(call.place is not None for call in calls)
        if is_known_yet:
            routine.shared[id(x)] = x
        return is_known_yet

    def _parameter(self, routine: Routine) -> Node:
        return self._new("read", (), ("parameter", len(routine.parameters)))

    def _called(self, routine: Routine, numbers: list[Any]) -> list[Any]:
        """Results of a call without their tangents, which the seeds take in."""
        key = (id(routine), *((type(x), x) if is_known(x) else id(x) for x in numbers))
        if key not in self._calls:
            self._alive += numbers
            self._calls[key] = self._call(routine, numbers)
        return self._calls[key]

    def _call(self, routine: Routine, numbers: list[Any]) -> list[Any]:
        values = [numbers[k] for k in routine.positions]
        moving = [values[k] for k in routine.moving]
        for seed in self._seeds:
            values += push_forward(self, moving, seed)
        call = self._new("call", (*values, *routine.shared.values()), routine)
        arguments = {id(x): value for x, value in zip(routine.parameters, values, strict=True)}

        def result(k: int, x: Any) -> Any:
            if self.is_fixed(x) or id(x) in routine.shared:
                return x
            return arguments[id(x)] if id(x) in arguments else self._new("result", (call,), k)

        results = [result(k, x) for k, x in enumerate(routine.results)]
        primal = results[: routine.size]
        for n, seed in enumerate(self._seeds, 1):
            along = results[n * routine.size : (n + 1) * routine.size]
            for x, tangent in zip(primal, along, strict=True):
                if not is_known(x) and x.operation == "result":
                    seed[id(x)] = tangent
        return primal

    def _classify(self, numbers: Sequence[Any]) -> None:
        """Find out which numbers are the same at every sample, and which may have tangents."""
        for node in in_order(numbers):
            if id(node) in self._is_fixed:
                continue
            name, args = node.operation, [id(x) for x in node.args if not is_known(x)]
            if name == "read":
                self._is_fixed[id(node)] = node.place[0] == "constant"
                self._moves[id(node)] = any(id(node) in seed for seed in self._seeds[:1])
            else:
                is_call = name in ("call", "result")
                self._is_fixed[id(node)] = not is_call and all(self._is_fixed[x] for x in args)
                self._moves[id(node)] = is_call or any(self._moves[x] for x in args)

    def is_fixed(self, x: Any) -> bool:
        """Whether a number that has been classified is the same at every sample."""
        return is_known(x) or self._is_fixed[id(x)]


def _find_repeated(traced: Function) -> dict[int, Function]:
    """Functions of some length that are called more than once, by the identity of their source."""
    count: Counter[int] = Counter()
    inners = {}

    def count_calls(function: Function, times: int) -> None:
        for equation in function.equations:
            scan, inner = scan_of(equation), call_of(equation)
            if scan is not None:
                count_calls(scan.body, times * scan.length)
            elif inner is not None and len(inner.equations) >= SHORTEST:
                count[id(inner.source)] += times
                inners[id(inner.source)] = inner

    count_calls(traced, 1)
    return {name: inner for name, inner in inners.items() if count[name] > 1 and inner.is_real}


def _arrays(numbers: Sequence[Any], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    """Numbers in arrays of some shapes."""
    rest: Iterator[Any] = iter(numbers)
    return [objects([next(rest) for _ in range(int(np.prod(shape)))], shape) for shape in shapes]


def _is_same(x: Any, y: Any) -> bool:
    if is_known(x) and is_known(y):
        return type(x) is type(y) and x == y
    return x is y
