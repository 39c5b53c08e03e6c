"""One sample of a step as scalar operations, and the arrays it reads.

Kernels for all processors are generated from it: the state is carried from sample to sample,
constants stay, inputs change with the sample.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from studies.kernels.fusion import count_operations, fused, in_order
from studies.kernels.graph import Graph, Node, is_known, objects
from studies.kernels.tangents import push_forward


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


class TracedLoop(NamedTuple):
    """A loop over samples, ready to be written as code."""

    leaves: dict[
        str, list[InputLeaf]
    ]  # "constant", "input", "state": arrays in the order they are read
    changes: list[Change]  # the numbers of the state that change
    order: list[Node]  # what they need, each after its arguments; a read's place: (kind, number)
    dtype: np.dtype  # of all arrays

    def fixed(self) -> dict[int, bool]:
        """Which nodes stay the same from sample to sample, by identity."""
        found: dict[int, bool] = {}
        for node in self.order:
            if node.operation == "read":
                found[id(node)] = node.place[0] == "constant"
            else:
                found[id(node)] = all(found[id(x)] for x in node.args if not is_known(x))
        return found

    def operations(self) -> Counter[str]:
        """Operations of one sample by kind."""
        return count_operations(self.order)


def trace_loop(
    step: Callable[..., Any],
    constants: Sequence[InputLeaf | np.ndarray],
    inputs: Sequence[InputLeaf],
    state: Sequence[InputLeaf],
    dtype: Any,
    directions: int = 0,
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

    Raises:
        NotImplementedError: an operation of the step that a graph does not support.
    """
    real, graph = np.dtype(dtype), Graph()
    read = [leaf for leaf in constants if isinstance(leaf, InputLeaf)]
    state = [leaf._replace(is_moving=directions > 0) for leaf in state]
    stored = {
        kind: [*leaves, *(_tangent(leaf, directions) for leaf in leaves if leaf.is_moving)]
        for kind, leaves in (("constant", read), ("input", inputs), ("state", state))
    }
    places = [
        [graph.read((kind, k), leaf.is_varying) for k, leaf in enumerate(_elements(leaves))]
        for kind, leaves in stored.items()
    ]
    rest = [iter(part) for part in places]

    def array(kind: int, leaf: InputLeaf | np.ndarray) -> np.ndarray:
        if not isinstance(leaf, InputLeaf):
            return objects(leaf.ravel().tolist(), leaf.shape)
        return objects([next(rest[kind]) for _ in range(leaf.size)], leaf.shape)

    arguments = [
        [array(kind, leaf) for leaf in leaves]
        for kind, leaves in enumerate((constants, inputs, state))
    ]
    results = [x for part in graph.trace(step, arguments, real) for x in part.flat]
    moving = [
        [array for leaf, array in zip(leaves, part, strict=True) if getattr(leaf, "is_moving", 0)]
        for leaves, part in zip((constants, inputs, state), arguments, strict=True)
    ]
    changes = _changes(fused([*results, *_tangents(graph, results, moving, rest, directions)]))
    order = in_order(x for change in changes for x in (change.mask, change.value))
    return TracedLoop(stored, changes, order, real)


def _tangent(leaf: InputLeaf, directions: int) -> InputLeaf:
    """The leaf from which the tangents of a leaf are read."""
    return InputLeaf((directions, *leaf.shape), True)


def _tangents(
    graph: Graph,
    results: list[Any],
    moving: list[list[Any]],
    rest: list[Iterator[Any]],
    directions: int,
) -> list[Any]:
    """Tangents of the results in the order of the state's tangent leaves.

    Args:
        graph: of the results.
        results: the new state, leaf by leaf and number by number.
        moving: arrays of nodes of the moving leaves, for constants, inputs and state.
        rest: the nodes that their tangents are read from, in the same order.
        directions: how many.
    """
    seeds: list[dict[int, Any]] = [{} for _ in range(directions)]
    for arrays, nodes in zip(moving, rest, strict=True):
        for array in arrays:
            for seed in seeds:
                seed.update((id(x), next(nodes)) for x in array.flat)
    pushed = [push_forward(graph, results, seed) for seed in seeds]
    found, first = [], 0
    for array in moving[-1]:
        span = slice(first, first + array.size)
        found += [x for along in pushed for x in along[span]]
        first += array.size
    return found


def _elements(leaves: Sequence[InputLeaf]) -> list[InputLeaf]:
    """The leaf of every number."""
    return [leaf for leaf in leaves for _ in range(leaf.size)]


def _changes(results: Sequence[Any]) -> list[Change]:
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
