"""Final pass over a graph before it becomes code: fewer operations, in a suitable order.

A processor multiplies and adds in one instruction (`fma`) and has 32 vector registers; any further
live values go to memory and back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from studies.kernels.graph import Node, is_known

_SUMS = ("add", "sub", "neg")


def fuse_sums(results: Sequence[Any]) -> list[Any]:
    """The same results with every sum as one chain of `fma`, each rounding once.

    Inner sums that nothing else reads become terms of the outer sum; products that nothing else
    reads are added as they are multiplied: `fma` is a b + c, `fnma` is c - a b.
    """
    order = in_order(results)
    reader: dict[int, Node | None] = {}  # the only node reading a number; None: several
    for node in order:
        for x in node.args:
            reader[id(x)] = None if id(x) in reader else node
    for x in results:
        reader[id(x)] = None

    def is_inner(x: Any) -> bool:
        """Whether only a sum reads it."""
        only = None if is_known(x) else reader[id(x)]
        return only is not None and only.operation in _SUMS

    new_nodes: dict[int, Any] = {}

    def terms(x: Any, sign: int, is_root: bool) -> list[tuple[int, Any]]:
        if is_known(x) or x.operation not in _SUMS or not (is_root or is_inner(x)):
            return [(sign, x)]
        signs: tuple[int, ...] = (sign, -sign) if x.operation == "sub" else (sign, sign)
        if x.operation == "neg":
            signs = (-sign,)
        return [t for s, a in zip(signs, x.args, strict=True) for t in terms(a, s, False)]

    def replacement(x: Any) -> Any:
        return x if is_known(x) else new_nodes[id(x)]

    for node in order:
        if node.operation == "read":
            new_nodes[id(node)] = node
        elif node.operation in _SUMS:
            if is_inner(node):
                continue
            products, plain = [], []
            for sign, x in terms(node, 1, True):
                if not is_known(x) and x.operation == "mul" and is_inner(x):
                    products.append((sign, replacement(x.args[0]), replacement(x.args[1])))
                else:
                    plain.append((sign, replacement(x)))
            new_nodes[id(node)] = _chain(products, plain)
        elif not (node.operation == "mul" and is_inner(node)):
            args = tuple(map(replacement, node.args))
            new_nodes[id(node)] = Node(
                node.operation, args, node.is_varying, node.is_truth, node.place
            )
    return [replacement(x) for x in results]


def _new_node(operation: str, *args: Any) -> Node:
    is_varying = any(not is_known(x) and x.is_varying for x in args)
    return Node(operation, args, is_varying, False)


def _chain(products: list[tuple[int, Any, Any]], plain: list[tuple[int, Any]]) -> Node:
    """Sum of signed products and signed numbers."""
    if all(sign < 0 for sign, *_ in (*products, *plain)):
        turned = [(1, a, b) for _, a, b in products], [(1, x) for _, x in plain]
        return _new_node("neg", _chain(*turned))
    plain.sort(key=lambda term: -term[0])
    products.sort(key=lambda term: -term[0])
    if plain and plain[0][0] > 0:
        total = plain.pop(0)[1]
    else:
        _, a, b = products.pop(0)
        total = _new_node("mul", a, b)
    for sign, x in plain:
        total = _new_node("add" if sign > 0 else "sub", total, x)
    for sign, a, b in products:
        total = _new_node("fma" if sign > 0 else "fnma", a, b, total)
    return total


def in_order(outputs: Iterable[Any]) -> list[Node]:
    """Nodes needed by some results, each after its arguments and as late as possible.

    Depth first, the argument with the longest history first, keeps few numbers in flight.

    Args:
        outputs: nodes; plain numbers are ignored.
    """
    outputs = list(outputs)
    height: dict[int, int] = {}
    for node in _depth_first(outputs):
        height[id(node)] = 1 + max([height.get(id(x), 0) for x in node.args], default=0)
    return _depth_first(outputs, lambda x: height.get(id(x), 0))


def _depth_first(outputs: list[Any], priority: Callable[[Any], int] | None = None) -> list[Node]:
    """Each node after its arguments, those with the highest priority first."""
    order: list[Node] = []
    seen: set[int] = set()
    stack: list[Any] = outputs[::-1]
    while stack:
        node = stack.pop()
        if type(node) is tuple:  # its arguments are done
            order.append(node[0])
        elif type(node) is Node and id(node) not in seen:
            seen.add(id(node))
            stack.append((node,))
            stack += sorted(node.args, key=priority) if priority else node.args
    return order


def count_operations(outputs: Iterable[Any]) -> Counter[str]:
    """Number of operations of each kind that some results need."""
    return Counter(node.operation for node in _depth_first(list(outputs)))
