"""A traced loop as LLVM instructions, completed by a writer for each processor.

llvmlite, which not every platform has, is imported only here and in `native`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

from studies.kernels.graph import Node, is_known
from studies.kernels.native import binding as binding
from studies.kernels.traced import Change, InputLeaf, TracedLoop

try:
    from llvmlite import ir as ir
except ImportError:  # not on this platform
    ir = None


def is_available() -> bool:
    """Whether llvmlite is installed."""
    return binding is not None


class Arguments(NamedTuple):
    """Arguments of the function; LLVM values."""

    bases: dict[str, list[Any]]  # address of every leaf, by kind; "result": of the last state
    n_steps: Any
    lanes: Any  # cases side by side in memory
    first: Any  # case, or first one of the vector


class Writer:
    """Writes one loop as a module with one function.

    Subclasses define the function's arguments (`open`, `close`) and can override how stores and
    known numbers are written.
    """

    def __init__(self, loop: TracedLoop, width: int) -> None:
        """
        Args:
            loop: what to write.
            width: cases in a vector; 1 for plain numbers.
        """
        self.loop, self.width = loop, width
        self.bytes = loop.dtype.itemsize
        self.scalar = ir.DoubleType() if self.bytes == 8 else ir.FloatType()
        self.vector = ir.VectorType(self.scalar, width) if width > 1 else self.scalar
        self.index = ir.IntType(64)
        self.module = ir.Module()
        self.builder: Any = None
        self.values: dict[int, Any] = {}  # LLVM value of a node, by identity

    def open(self) -> Arguments:
        """Begin the function, with `self.builder` in its first block."""
        raise NotImplementedError

    def close(self) -> None:
        """End it."""
        self.builder.ret_void()

    def write(self) -> Any:
        """The module."""
        frame = self.open()
        entry, function = self.builder.block, self.builder.function
        loop, leave = map(function.append_basic_block, ("loop", "leave"))
        changes, order, is_fixed = self.loop.changes, self.loop.order, self.loop.fixed()
        # the state lives on the stack, at constant offsets without overlap
        at_state = self._places("state", "state", frame)
        slots = self._slots(len(at_state))
        for slot, place in zip(slots, at_state, strict=True):
            self._keep(self._load(place, True), slot)
        at_constant = self._places("constant", "constant", frame)
        for node in order:
            if is_fixed[id(node)]:
                if node.operation == "read":
                    self.values[id(node)] = self._load(at_constant[node.place[1]], node.is_varying)
                else:
                    self._emit(node)
        self.builder.branch(loop)

        self.builder.position_at_end(loop)
        sample = self.builder.phi(self.index)
        sample.add_incoming(ir.Constant(self.index, 0), entry)
        row = self._row(sample, frame.n_steps)
        at_input = self._places("input", "input", frame, row)
        due = _due(order, is_fixed, changes)
        records = self._records(frame, row, is_fixed)
        for change in due[None]:
            self._store(change, slots[change.slot])
        self._record(records[None])
        for node in order:
            if is_fixed[id(node)]:
                continue
            if node.operation != "read":
                self._emit(node)
            elif node.place[0] == "input":
                self.values[id(node)] = self._load(at_input[node.place[1]], node.is_varying)
            else:
                self.values[id(node)] = self._kept(slots[node.place[1]])
            for change in due[id(node)]:
                self._store(change, slots[change.slot])
            self._record(records[id(node)])
        following = self.builder.add(sample, ir.Constant(self.index, 1))
        sample.add_incoming(following, self.builder.block)
        again = self.builder.icmp_signed("<", following, frame.n_steps)
        self.builder.cbranch(again, loop, leave)

        self.builder.position_at_end(leave)
        for slot, place in zip(slots, self._places("state", "result", frame), strict=True):
            self.builder.store(self._kept(slot), place, align=self.bytes)
        self.close()
        return self.module

    def _row(self, sample: Any, n_steps: Any) -> Any:
        """Row of a sample in inputs and records."""
        if not self.loop.is_reversed:
            return sample
        last = self.builder.sub(n_steps, ir.Constant(self.index, 1))
        return self.builder.sub(last, sample)

    def _records(
        self, frame: Arguments, row: Any, is_fixed: dict[int, bool]
    ) -> dict[Any, list[tuple[Any, Any]]]:
        """Numbers to keep from a sample, and where, by the node after which that can be done.

        None: before all of them.
        """
        records: dict[Any, list[tuple[Any, Any]]] = defaultdict(list)
        if self.loop.records:
            places = self._places("record", "record", frame, row)
            for x, place in zip(self.loop.records, places, strict=True):
                is_early = is_known(x) or is_fixed[id(x)]
                records[None if is_early else id(x)].append((x, place))
        return records

    def _record(self, records: list[tuple[Any, Any]]) -> None:
        for x, place in records:
            self.builder.store(self._broadcast(x), place, align=self.bytes)

    # --- memory -----------------------------------------------------------------------------------

    def _slots(self, count: int) -> list[Any]:
        stack = self.builder.alloca(self.vector, ir.Constant(self.index, count))
        stack.align = self.bytes * self.width
        return [
            self.builder.gep(stack, [ir.Constant(self.index, k)], source_etype=self.vector)
            for k in range(count)
        ]

    def _keep(self, value: Any, slot: Any) -> None:
        self.builder.store(value, slot, align=self.bytes * self.width)

    def _kept(self, slot: Any) -> Any:
        return self.builder.load(slot, align=self.bytes * self.width, typ=self.vector)

    def _store(self, change: Change, slot: Any) -> None:
        """Store a number where it changes."""
        value = self._broadcast(change.value)
        if not is_known(change.mask):
            value = self.builder.select(self._broadcast(change.mask), value, self._kept(slot))
        self._keep(value, slot)

    def _places(self, kind: str, base: str, frame: Arguments, sample: Any = None) -> list[Any]:
        """Address of every number, in this sample's row if there is one."""
        places = []
        leaves: list[InputLeaf] = self.loop.leaves[kind]
        for leaf, start_of_leaf in zip(leaves, frame.bases[base], strict=True):
            stride = frame.lanes if leaf.is_varying else ir.Constant(self.index, 1)
            start = frame.first if leaf.is_varying else ir.Constant(self.index, 0)
            if sample is not None:
                row = self.builder.mul(sample, ir.Constant(self.index, leaf.size))
                start = self.builder.add(start, self.builder.mul(row, stride))
            for k in range(leaf.size):
                offset = self.builder.mul(ir.Constant(self.index, k), stride)
                offset = self.builder.add(start, offset)
                place = self.builder.gep(start_of_leaf, [offset], source_etype=self.scalar)
                places.append(place)
        return places

    def _load(self, place: Any, is_varying: bool) -> Any:
        kind = self.vector if is_varying else self.scalar
        return self.builder.load(place, align=self.bytes, typ=kind)

    # --- operations -------------------------------------------------------------------------------

    def _emit(self, node: Node) -> None:
        widen = self._broadcast if node.is_varying else self._narrow
        args = [widen(x) for x in node.args]
        self.values[id(node)] = getattr(self, f"_{node.operation}", self._plain)(node, *args)

    def _narrow(self, x: Any) -> Any:
        if not is_known(x):
            return self.values[id(x)]
        if isinstance(x, bool):
            return ir.Constant(ir.IntType(1), int(x))
        return ir.Constant(self.scalar, float(x))

    def _broadcast(self, x: Any) -> Any:
        one = self._narrow(x)
        if self.width == 1 or isinstance(one.type, ir.VectorType):
            return one
        kind = ir.VectorType(one.type, self.width)
        if isinstance(x, bool) or (is_known(x) and x == 0):
            return ir.Constant(kind, [one.constant] * self.width)
        if is_known(x):
            one = self._number(x)
        nothing = ir.Constant(kind, ir.Undefined)
        start = self.builder.insert_element(nothing, one, ir.Constant(ir.IntType(32), 0))
        order = ir.Constant(ir.VectorType(ir.IntType(32), self.width), [0] * self.width)
        return self.builder.shuffle_vector(start, nothing, order)

    def _number(self, x: float) -> Any:
        """A known number, to be broadcast to a vector."""
        return ir.Constant(self.scalar, float(x))

    def _plain(self, node: Node, *args: Any) -> Any:
        name = node.operation
        if name in ("add", "sub", "mul"):
            return getattr(self.builder, f"f{name}")(*args)
        if name in _SIGNS:
            compare = self.builder.fcmp_unordered if name == "ne" else self.builder.fcmp_ordered
            return compare(_SIGNS[name], *args)
        if name in ("and", "or"):
            return getattr(self.builder, f"{name}_")(*args)
        return self._intrinsic({"abs": "fabs", "round": "rint"}.get(name, name), *args)

    def _fma(self, node: Node, *args: Any) -> Any:
        return self._intrinsic("fmuladd", *args)

    def _fnma(self, node: Node, a: Any, b: Any, c: Any) -> Any:
        return self._intrinsic("fmuladd", self.builder.fneg(a), b, c)

    def _reciprocal(self, node: Node, a: Any) -> Any:
        one = self._broadcast(1.0) if node.is_varying else self._narrow(1.0)
        return self.builder.fdiv(one, a)

    def _neg(self, node: Node, a: Any) -> Any:
        return self.builder.fneg(a)

    def _not(self, node: Node, a: Any) -> Any:
        return self.builder.not_(a)

    def _select(self, node: Node, which: Any, no: Any, yes: Any) -> Any:
        return self.builder.select(which, yes, no)

    def _max(self, node: Node, a: Any, b: Any) -> Any:
        return self._extreme(">", node, a, b)

    def _min(self, node: Node, a: Any, b: Any) -> Any:
        return self._extreme("<", node, a, b)

    def _extreme(self, sign: str, node: Node, a: Any, b: Any) -> Any:
        """The larger or smaller one; NaN if either is NaN."""
        # one instruction, which gives b if either is NaN
        chosen = self.builder.select(self.builder.fcmp_ordered(sign, a, b), a, b)
        if is_known(node.args[0]):
            return chosen
        return self.builder.select(self.builder.fcmp_unordered("uno", a, a), a, chosen)

    def _tanh(self, node: Node, a: Any) -> Any:
        """One number at a time, by the library."""
        name = "tanh" if self.bytes == 8 else "tanhf"
        if not isinstance(a.type, ir.VectorType):
            return self._call(name, self.scalar, a)
        result = ir.Constant(self.vector, ir.Undefined)
        for k in range(self.width):
            place = ir.Constant(ir.IntType(32), k)
            one = self._call(name, self.scalar, self.builder.extract_element(a, place))
            result = self.builder.insert_element(result, one, place)
        return result

    def _intrinsic(self, name: str, *args: Any) -> Any:
        kind = args[0].type
        lanes = f"v{self.width}" if isinstance(kind, ir.VectorType) else ""
        full = f"llvm.{name}.{lanes}f{8 * self.bytes}"
        return self._call(full, kind, *args)

    def _call(self, name: str, kind: Any, *args: Any) -> Any:
        """Call a function of LLVM or the library, declared at its first use."""
        function = self.module.globals.get(name) or ir.Function(
            self.module, ir.FunctionType(kind, [x.type for x in args]), name
        )
        return self.builder.call(function, args)


#: Comparisons in LLVM's notation.
_SIGNS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}


def _due(
    order: Sequence[Node], is_fixed: dict[int, bool], changes: Sequence[Change]
) -> dict[Any, list[Change]]:
    """After which node of the loop each change can be stored; None: before all of them.

    That is when it is computed and nothing reads the old number any more.
    """
    at = {id(node): k for k, node in enumerate(order)}
    read = {node.place[1]: node for node in order if node.place and node.place[0] == "state"}
    due: dict[Any, list[Change]] = defaultdict(list)
    for change in changes:
        needed = [change.mask, change.value, read.get(change.slot, True)]
        nodes = [x for x in needed if not is_known(x) and not is_fixed[id(x)]]
        last = max(nodes, key=lambda x: at[id(x)], default=None)
        due[None if last is None else id(last)].append(change)
    return due
