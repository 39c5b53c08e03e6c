"""The reverse of a loop, which turns cotangents of its last state into those of its start.

One reverse gives the gradient of one number by everything that the loop was given, so its cost
does not grow with the parameters. It needs the states on the way, which the loop keeps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from studies.kernels.derivatives import pull_back
from studies.kernels.fusion import fuse_sums, in_order
from studies.kernels.graph import Graph, Node, is_known
from studies.kernels.traced import (
    InputLeaf,
    TracedLoop,
    arguments_of,
    changes_of,
    needed_by,
    numbers,
    reads_of,
)


class Adjoint(NamedTuple):
    """A loop and its reverse.

    The loop records those numbers of its state that the reverse reads, which are the last input of
    the reverse. The reverse's state: cotangents of the loop's state, then of its moving constants,
    to which every sample adds. It records the cotangents of the moving inputs.
    """

    forward: TracedLoop
    backward: TracedLoop

    @property
    def kept(self) -> int:
        """Numbers of a sample that the loop records."""
        return len(self.forward.records)


def trace_adjoint(
    step: Callable[..., Any],
    constants: Sequence[InputLeaf | np.ndarray],
    inputs: Sequence[InputLeaf],
    state: Sequence[InputLeaf],
    dtype: Any,
) -> Adjoint:
    """Trace a loop and its reverse; arguments and errors as `trace_loop`."""
    graph, real = Graph(), np.dtype(dtype)
    read = [leaf for leaf in constants if isinstance(leaf, InputLeaf)]
    leaves = {"constant": read, "input": list(inputs), "state": list(state)}
    reads = reads_of(graph, leaves)
    arguments = arguments_of(reads, (constants, inputs, state))
    results = [x for part in graph.trace(step, arguments, real) for x in part.flat]
    sums = [leaf._replace(is_varying=True) for leaf in read if leaf.is_moving]
    turned = [*state, *sums]
    adjoint_reads = reads_of(graph, {"state": turned})["state"]
    moving = {
        kind: [
            x
            for leaf, own in zip(leaves[kind], numbers(reads[kind], leaves[kind]), strict=True)
            for x in (own if leaf.is_moving else ())
        ]
        for kind in ("constant", "input")
    }
    sources = [*reads["state"], *moving["constant"], *moving["input"]]
    pulled = pull_back(graph, results, adjoint_reads[: len(results)], sources)
    before, n = pulled[: len(results)], len(adjoint_reads)
    added = zip(adjoint_reads[len(results) :], pulled[len(results) : n], strict=True)
    pulled = fuse_sums([*before, *(graph.operation("add")(x, y) for x, y in added), *pulled[n:]])

    read_back = {id(node) for node in in_order(pulled)}
    kept = [x for x in reads["state"] if id(x) in read_back]
    row = InputLeaf((len(kept),), True)
    places = {id(x): ("input", len(reads["input"]) + k) for k, x in enumerate(kept)}
    pulled = _relocate(pulled, places)
    records = [leaf._replace(is_varying=True) for leaf in inputs if leaf.is_moving]
    return Adjoint(
        _loop({**leaves, "record": [row]}, fuse_sums(results), kept, real),
        _loop(
            {**leaves, "input": [*inputs, row], "state": turned, "record": records},
            pulled[:n],
            pulled[n:],
            real,
        )._replace(is_reversed=True),
    )


def _loop(
    leaves: dict[str, list[InputLeaf]], results: list[Any], records: list[Any], dtype: np.dtype
) -> TracedLoop:
    changes = changes_of(results)
    order = needed_by(changes, records)
    return TracedLoop(
        leaves=leaves, changes=changes, order=order, dtype=dtype, bodies={}, records=tuple(records)
    )


def _relocate(results: Sequence[Any], places: dict[int, tuple[str, int]]) -> list[Any]:
    """Results that take some reads, by their identity, from other places."""
    moved: dict[int, Node] = {}
    for node in in_order(results):
        args = tuple(x if is_known(x) else moved[id(x)] for x in node.args)
        place = places.get(id(node), node.place)
        moved[id(node)] = Node(node.operation, args, node.is_varying, node.is_truth, place)
    return [x if is_known(x) else moved[id(x)] for x in results]
