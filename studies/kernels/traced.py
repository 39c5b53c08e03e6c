"""One sample of a step as scalar operations, and the arrays it reads.

Kernels for all processors are generated from it: the state is carried from sample to sample,
constants stay, inputs change with the sample.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from studies.kernels.derivatives import push_forward
from studies.kernels.fusion import count_operations, fuse_sums, in_order
from studies.kernels.graph import Graph, Node, is_known, objects
from studies.kernels.routines import Routine, RoutineGraph


class InputLeaf(NamedTuple):
    """One array that the step reads from memory."""

    shape: tuple[int, ...]  # of one case (and of one sample)
    is_varying: bool  # one value per case, lanes last; otherwise one for all
    is_moving: bool = False  # has tangents; so has every leaf of the state

    @property
    def size(self) -> int:
        """Numbers of one case."""
        return int(np.prod(self.shape))


class Change(NamedTuple):
    """Update of one number of the state by a sample."""

    slot: int
    mask: Any  # where it changes
    value: Any


class Body(NamedTuple):
    """A routine that is still to be written as code."""

    results: dict[int, Any]  # those that are wanted, by their numbers
    order: list[Node]  # what they need; a read's place: (its kind, number)
    fixed: list[Any]  # nodes of the loop that it reads as "fixed", the same at every sample
    n_parameters: int  # first arguments of a call, read as "parameter"; all calls share the others


class TracedLoop(NamedTuple):
    """A loop over samples, ready to be written as code."""

    leaves: dict[
        str, list[InputLeaf]
    ]  # "constant", "input", "state": arrays in the order they are read
    changes: list[Change]  # the numbers of the state that change
    order: list[Node]  # what they need, each after its arguments; a read's place: (kind, number)
    dtype: np.dtype  # of all arrays
    bodies: dict[int, Body]  # of the calls among the nodes, by the identity of their place
    records: tuple[Any, ...] = ()  # kept from every sample, in the arrays "record"
    is_reversed: bool = False  # the last row of inputs and records comes first

    def fixed(self) -> dict[int, bool]:
        """Which nodes stay the same from sample to sample, by identity."""
        is_fixed: dict[int, bool] = {}
        for node in self.order:
            if node.operation == "read":
                is_fixed[id(node)] = node.place[0] == "constant"
            elif node.operation == "call":
                is_fixed[id(node)] = False
            else:
                is_fixed[id(node)] = all(is_fixed[id(x)] for x in node.args if not is_known(x))
        return is_fixed

    def text(self) -> str:
        """All that the loop's code depends on."""
        numbers: dict[int, int] = {}
        routines = {name: k for k, name in enumerate(self.bodies)}

        def named(x: Any) -> str:
            return repr(x) if x is None or is_known(x) else f"#{numbers[id(x)]}"

        def lines(order: Sequence[Node]) -> Iterator[str]:
            for node in order:
                numbers[id(node)] = len(numbers)
                place = routines[id(node.place)] if node.operation == "call" else node.place
                kind = node.operation, place, node.is_varying, node.is_truth
                yield f"{kind} {' '.join(map(named, node.args))}"

        parts = [f"{self.leaves} {self.dtype} {self.is_reversed}", *lines(self.order)]
        parts += [f"{c.slot} {named(c.mask)} {named(c.value)}" for c in self.changes]
        parts += map(named, self.records)
        for body in self.bodies.values():
            parts += [f"routine {body.n_parameters} {' '.join(map(named, body.fixed))}"]
            parts += lines(body.order)
            parts += [f"{k} {named(x)}" for k, x in body.results.items()]
        return "\n".join(parts)

    def operations(self) -> Counter[str]:
        """Operations of one sample by kind."""
        total = count_operations(self.order)
        for node in self.order:
            if node.operation == "call":
                total += count_operations(self.bodies[id(node.place)].results.values())
        return total


def trace_loop(
    step: Callable[..., Any],
    constants: Sequence[InputLeaf | np.ndarray],
    inputs: Sequence[InputLeaf],
    state: Sequence[InputLeaf],
    dtype: Any,
    directions: int = 0,
    has_routines: bool = False,
) -> TracedLoop:
    """Trace a loop over `step(constants, inputs, state) -> state`, all lists of arrays.

    With directions, the state's tangents are carried along: constants, inputs and state are each
    followed by the tangents of their moving leaves, all varying and with the directions before the
    leaf's own shape.

    Args:
        step: elementwise JAX function of one case and one sample.
        constants: arrays that stay the same over a run; known ones as values.
        inputs: arrays of one sample; in memory one row per sample.
        state: arrays carried from sample to sample; always varying.
        dtype: float64 or float32, of all arrays.
        directions: tangents of each number.
        has_routines: keep functions that are called more than once.

    Raises:
        NoKernelError: the step uses what kernels do not support.
    """
    real = np.dtype(dtype)
    seeds: list[dict[int, Any]] = [{} for _ in range(directions)]
    graph = RoutineGraph(seeds) if has_routines else Graph()
    read = [leaf for leaf in constants if isinstance(leaf, InputLeaf)]
    state = [leaf._replace(is_moving=directions > 0) for leaf in state]
    stored = {
        kind: [*leaves, *(_tangent(leaf, directions) for leaf in leaves if leaf.is_moving)]
        for kind, leaves in (("constant", read), ("input", inputs), ("state", state))
    }
    reads = reads_of(graph, stored)
    arguments = arguments_of(reads, (constants, inputs, state))
    for kind, leaves in (("constant", read), ("input", inputs), ("state", state)):
        own, along = numbers(reads[kind], leaves), iter(reads[kind][sum(x.size for x in leaves) :])
        for leaf, mine in zip(leaves, own, strict=True):
            for seed in seeds if leaf.is_moving else ():
                seed.update((id(x), next(along)) for x in mine)
    results = [x for part in graph.trace(step, arguments, real) for x in part.flat]
    results += _tangents(graph, results, [leaf.size for leaf in state], seeds)
    results, bodies = close_routines(graph, results)
    changes = changes_of(results)
    order = needed_by(changes, (x for body in bodies.values() for x in body.fixed))
    return TracedLoop(leaves=stored, changes=changes, order=order, dtype=real, bodies=bodies)


def reads_of(graph: Graph, leaves: dict[str, list[InputLeaf]]) -> dict[str, list[Node]]:
    """A node for every number of some leaves, by kind."""
    return {
        kind: [
            graph.read((kind, k), is_varying)
            for k, is_varying in enumerate(
                leaf.is_varying for leaf in part for _ in range(leaf.size)
            )
        ]
        for kind, part in leaves.items()
    }


def arguments_of(
    reads: dict[str, list[Node]], leaves: Sequence[Sequence[InputLeaf | np.ndarray]]
) -> list[list[np.ndarray]]:
    """What the step is given: arrays of reads, and of known numbers."""
    arguments = []
    for nodes, part in zip(reads.values(), leaves, strict=True):
        rest = iter(nodes)
        arguments.append(
            [
                objects([next(rest) for _ in range(leaf.size)], leaf.shape)
                if isinstance(leaf, InputLeaf)
                else objects(leaf.ravel().tolist(), leaf.shape)
                for leaf in part
            ]
        )
    return arguments


def needed_by(changes: Sequence[Change], others: Iterable[Any]) -> list[Node]:
    """What changes and other numbers need, in order."""
    return in_order([*(x for change in changes for x in (change.mask, change.value)), *others])


def _tangent(leaf: InputLeaf, directions: int) -> InputLeaf:
    """The leaf from which the tangents of a leaf are read."""
    return InputLeaf((directions, *leaf.shape), True)


def _tangents(
    graph: Graph, results: list[Any], sizes: list[int], seeds: list[dict[int, Any]]
) -> list[Any]:
    """Tangents of the results in the order of the state's tangent leaves.

    Args:
        graph: of the results.
        results: the new state, leaf by leaf and number by number.
        sizes: numbers of each leaf.
        seeds: tangents of what moves, for each direction.
    """
    pushed = [push_forward(graph, results, seed) for seed in seeds]
    tangents, first = [], 0
    for size in sizes:
        tangents += [x for along in pushed for x in along[first : first + size]]
        first += size
    return tangents


def numbers(nodes: Sequence[Node], leaves: Sequence[InputLeaf]) -> list[list[Node]]:
    """The nodes of each leaf; there can be more after them."""
    rest = iter(nodes)
    return [[next(rest) for _ in range(leaf.size)] for leaf in leaves]


def changes_of(results: Sequence[Any]) -> list[Change]:
    """The numbers of the state that change; a frozen case keeps its own."""
    changes = []
    for k, x in enumerate(results):
        if not is_known(x) and x.operation == "select" and _is_state(x.args[1], k):
            changes.append(Change(k, x.args[0], x.args[2]))
        elif not _is_state(x, k):
            changes.append(Change(k, True, x))
    return changes


def _is_state(x: Any, k: int) -> bool:
    return not is_known(x) and x.place == ("state", k)


def close_routines(graph: Graph, results: list[Any]) -> tuple[list[Any], dict[int, Body]]:
    """Results with fused sums, and the bodies of the routines that they call.

    What nobody wants of a routine is left out, and so are parameters that the rest does not read.
    """
    if not isinstance(graph, RoutineGraph):
        return fuse_sums(results), {}
    calls: dict[int, list[Node]] = {}
    used: dict[int, set[int]] = {}
    routines: dict[int, Routine] = {}

    def collect() -> int:
        calls.clear()
        used.clear()
        for node in in_order(results):
            if node.operation == "result":
                used.setdefault(id(node.args[0].place), set()).add(node.place)
            elif node.operation == "call":
                routines[id(node.place)] = node.place
                calls.setdefault(id(node.place), []).append(node)
        return sum(map(len, used.values()))

    count, before = collect(), -1
    while count != before:
        for name, numbers in used.items():
            needed = {
                node.place[1]
                for node in in_order([routines[name].results[k] for k in numbers])
                if node.operation == "read" and node.place[0] == "parameter"
            } | set(range(len(routines[name].parameters), len(calls[name][0].args)))
            for call in calls[name]:
                # None where nothing is read, so that places stay
                call.args = tuple(x if k in needed else None for k, x in enumerate(call.args))
        before, count = count, collect()
    bodies, fixed = {}, []
    for name, numbers in used.items():
        outputs = [routines[name].results[k] for k in sorted(numbers)]
        body, own = _extract_body(graph, outputs, routines[name])
        body = fuse_sums(body)
        results_of = dict(zip(sorted(numbers), body, strict=True))
        n_parameters = len(routines[name].parameters)
        bodies[name] = Body(results_of, in_order(body), own, n_parameters)
        fixed += own
    whole = fuse_sums([*results, *fixed])
    rest = iter(whole[len(results) :])
    bodies = {name: b._replace(fixed=[next(rest) for _ in b.fixed]) for name, b in bodies.items()}
    return whole[: len(results)], bodies


def _extract_body(
    graph: RoutineGraph, results: list[Any], routine: Routine
) -> tuple[list[Any], list[Node]]:
    """Results with reads in place of what is the same in all calls.

    Returns:
        (results; of those numbers the ones that are also the same at every sample).
    """
    new_nodes: dict[int, Node] = {}
    fixed: list[Node] = []
    shared = {name: k for k, name in enumerate(routine.shared)}

    def is_outer(x: Node) -> bool:
        return (graph.is_fixed(x) and not x.is_truth) or id(x) in shared

    def replacement(x: Any) -> Any:
        if is_known(x):
            return x
        if id(x) not in new_nodes and id(x) in shared:
            new_nodes[id(x)] = Node("read", (), True, False, ("shared", shared[id(x)]))
        elif id(x) not in new_nodes and is_outer(x):
            new_nodes[id(x)] = Node("read", (), True, False, ("fixed", len(fixed)))
            fixed.append(x)
        return new_nodes[id(x)]

    own, left = set(), [x for x in results if not is_known(x)]
    while left:  # what leads to an outer number stays outside too
        x = left.pop()
        if id(x) not in own and not is_outer(x):
            own.add(id(x))
            left += (y for y in x.args if not is_known(y))
    for node in in_order(results):
        if id(node) in own and node.operation == "read":
            new_nodes[id(node)] = node
        elif id(node) in own:
            args = tuple(map(replacement, node.args))
            is_varying = any(not is_known(x) and x.is_varying for x in args)
            new_nodes[id(node)] = Node(node.operation, args, is_varying, node.is_truth, node.place)
    return [replacement(x) for x in results], fixed
