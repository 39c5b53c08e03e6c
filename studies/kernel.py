"""The traced kernel: JAX's own step function as one vectorised machine-code loop over samples.

`studies.graph` turns one sample's step into a graph of operations on single numbers. Here each
operation becomes one LLVM instruction, a vector of cases wide; around them goes a loop over samples
with the state in memory. XLA cannot do this: it fuses the step into many loops that recompute what
they share (docs/performance.md has the measurements). llvmlite is optional (extra `fast`); without
it XLA runs the same step.
"""

from __future__ import annotations

import ctypes
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from studies.compilation import ObjectCache, compiling
from studies.fusion import count_operations, fused, in_order
from studies.graph import Graph, Node, is_known, objects
from studies.tangents import push_forward

try:
    from llvmlite import binding, ir
except ImportError:  # the extra is not installed
    binding = ir = None

#: Bytes of the vectors: what one register of the widest common instruction set holds.
VECTOR_BYTES = 64


def is_available() -> bool:
    """Whether llvmlite is installed."""
    return binding is not None


class Leaf(NamedTuple):
    """One input array of the step that is read from memory."""

    shape: tuple[int, ...]  # of one case (and of one sample)
    is_varying: bool  # one value per case, lanes last; else one for all
    is_moving: bool = False  # has tangents; so has every leaf of the state

    @property
    def size(self) -> int:
        """Numbers of one case."""
        return int(np.prod(self.shape))


class Kernel:
    """A compiled loop. Call it with arrays; it runs without Python's lock."""

    def __init__(
        self, code: Any, width: int, numbers: np.ndarray, operations: Counter[str]
    ) -> None:
        self._code = code  # keeps the machine code alive
        pointers = ctypes.POINTER(ctypes.c_void_p)
        prototype = ctypes.CFUNCTYPE(None, pointers, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
        self._function = prototype(code.get_function_address("run"))
        self.width, self._numbers = width, numbers
        #: operations of one sample by kind
        self.operations = operations

    def run(self, leaves: Sequence[np.ndarray], n_steps: int, lanes: int) -> None:
        """Step all lanes from begin to end; the state's arrays are changed in place.

        Args:
            leaves: arrays in the order of `build_kernel`, those known left out, contiguous; those
                of inputs have the samples first, varying ones the lanes last.
            n_steps: samples.
            lanes: cases side by side, a multiple of `width`.
        """
        arrays = [self._numbers, *leaves]
        addresses = (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))
        for first in range(0, lanes, self.width):
            self._function(addresses, n_steps, lanes, first)


def build_kernel(
    step: Callable[..., Any],
    constants: Sequence[Leaf | np.ndarray],
    inputs: Sequence[Leaf],
    state: Sequence[Leaf],
    dtype: Any,
    directions: int = 0,
) -> Kernel:
    """Compile a loop over `step(constants, inputs, state) -> state`, all lists of arrays.

    With directions, the state's tangents are carried along too: behind the constants, behind the
    inputs and behind the state the kernel then takes tangents of those that move, each varying and
    with the directions before the leaf's own shape.

    Args:
        step: elementwise JAX function of one case and one sample.
        constants: arrays that stay the same over a run; the known ones themselves.
        inputs: arrays of one sample; in memory one row per sample.
        state: arrays carried from sample to sample; always varying.
        dtype: float64 or float32, of all arrays.
        directions: tangents of each number.

    Raises:
        NotImplementedError: an operation of the step that the kernel does not know.
    """
    real, graph = np.dtype(dtype), Graph()
    read = [leaf for leaf in constants if isinstance(leaf, Leaf)]
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

    def array(kind: int, leaf: Leaf | np.ndarray) -> np.ndarray:
        if not isinstance(leaf, Leaf):
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
    results = fused([*results, *_tangents(graph, results, moving, rest, directions)])
    width = VECTOR_BYTES // real.itemsize
    writer = _Writer(real, width, *stored.values())
    engine = _compile(str(writer.write(results)))
    return Kernel(engine, width, np.array(writer.numbers, real), count_operations(results))


def _tangent(leaf: Leaf, directions: int) -> Leaf:
    """Where the tangents of a leaf are read from."""
    return Leaf((directions, *leaf.shape), True)


def _tangents(
    graph: Graph, results: list, moving: list[list], rest: list[Iterator], directions: int
) -> list:
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


def _elements(leaves: Sequence[Leaf]) -> list[Leaf]:
    """Its leaf for every number."""
    return [leaf for leaf in leaves for _ in range(leaf.size)]


@cache
def _initialise() -> None:
    for part in ("initialize_native_target", "initialize_native_asmprinter"):
        getattr(binding, part)()


def _compile(text: str) -> Any:
    _initialise()
    cpu, features = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    triple, version = binding.get_default_triple(), ".".join(map(str, binding.llvm_version_info))
    kept = ObjectCache(text, cpu, features, triple, version)
    with compiling():
        target = binding.Target.from_default_triple().create_target_machine(
            cpu=cpu, features=features, opt=3, jit=True
        )
        engine = binding.create_mcjit_compiler(binding.parse_assembly(text), target)
        engine.set_object_cache(kept.keep, kept.take)
        engine.finalize_object()
    return engine


class _Writer:
    """Writes one kernel as LLVM IR."""

    def __init__(
        self,
        real: np.dtype,
        width: int,
        constants: Sequence[Leaf],
        inputs: Sequence[Leaf],
        state: Sequence[Leaf],
    ) -> None:
        self.real, self.width = real, width
        self.leaves = {"constant": constants, "input": inputs, "state": state}
        self.scalar = ir.DoubleType() if real.itemsize == 8 else ir.FloatType()
        self.vector = ir.VectorType(self.scalar, width)
        self.index = ir.IntType(64)
        self.module = ir.Module()
        self.builder: Any = None
        self.values: dict[int, Any] = {}  # LLVM value of a node, by identity
        self.numbers: list[float] = [0.0]  # known ones, in the order of their use

    def write(self, results: Sequence[Any]) -> Any:
        """The module with one function `run(leaves, n_steps, lanes, first)`.

        Args:
            results: new state, node or number by number.
        """
        pointer = ir.PointerType()
        signature = ir.FunctionType(ir.VoidType(), [pointer, self.index, self.index, self.index])
        function = ir.Function(self.module, signature, "run")
        function.attributes.add("nounwind")
        table, n_steps, lanes, first = function.args
        entry, loop, leave = map(function.append_basic_block, ("entry", "loop", "leave"))
        self.builder = ir.IRBuilder(entry)
        rounding = self._flush_to_zero()
        changes = _changes(results)
        order = in_order(x for change in changes for x in (change.mask, change.value))
        is_fixed = _fixed(order)
        self.table = self._base(table, 0)
        bases = self._bases(table)
        # the state lives on the stack, at constant offsets and overlapping nothing
        at_state = self._places("state", bases, lanes, first)
        slots = self._slots(len(at_state))
        for slot, place in zip(slots, at_state, strict=True):
            self.builder.store(self._load(place, True), slot, align=VECTOR_BYTES)
        at_constant = self._places("constant", bases, lanes, first)
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
        at_input = self._places("input", bases, lanes, first, sample)
        due = _due(order, is_fixed, changes)
        for change in due[None]:
            self._store(change, slots[change.slot])
        for node in order:
            if is_fixed[id(node)]:
                continue
            if node.operation != "read":
                self._emit(node)
            elif node.place[0] == "input":
                self.values[id(node)] = self._load(at_input[node.place[1]], node.is_varying)
            else:
                slot = slots[node.place[1]]
                self.values[id(node)] = self.builder.load(slot, align=VECTOR_BYTES, typ=self.vector)
            for change in due[id(node)]:
                self._store(change, slots[change.slot])
        following = self.builder.add(sample, ir.Constant(self.index, 1))
        sample.add_incoming(following, self.builder.block)
        again = self.builder.icmp_signed("<", following, n_steps)
        self.builder.cbranch(again, loop, leave)

        self.builder.position_at_end(leave)
        for slot, place in zip(slots, at_state, strict=True):
            last = self.builder.load(slot, align=VECTOR_BYTES, typ=self.vector)
            self.builder.store(last, place, align=self.real.itemsize)
        if rounding is not None:
            self._control("ldmxcsr", rounding)
        self.builder.ret_void()
        return self.module

    def _flush_to_zero(self) -> Any:
        """Where the processor's old mode is kept, while numbers too small to be normal become 0.

        Working with them takes a hundred times as long, and sums in single precision meet them.
        """
        if not binding.get_default_triple().startswith("x86_64"):
            return None
        word = ir.IntType(32)
        old, new = self.builder.alloca(word), self.builder.alloca(word)
        self._control("stmxcsr", old)
        mode = self.builder.or_(self.builder.load(old, typ=word), ir.Constant(word, 0x8040))
        self.builder.store(mode, new)
        self._control("ldmxcsr", new)
        return old

    def _control(self, name: str, place: Any) -> None:
        self._call(f"llvm.x86.sse.{name}", ir.VoidType(), place)

    def _store(self, change: _Change, slot: Any) -> None:
        vector = self._widened(change.value)
        if is_known(change.mask):
            self.builder.store(vector, slot, align=VECTOR_BYTES)
            return
        name = f"llvm.masked.store.v{self.width}f{8 * self.real.itemsize}.p0"
        alignment = ir.Constant(ir.IntType(32), VECTOR_BYTES)
        self._call(name, ir.VoidType(), vector, slot, alignment, self._widened(change.mask))

    # --- memory -----------------------------------------------------------------------------------

    def _bases(self, table: Any) -> dict[str, list[Any]]:
        """Address of every leaf."""
        found, k = {}, 1
        for kind, leaves in self.leaves.items():
            found[kind] = [self._base(table, k + n) for n in range(len(leaves))]
            k += len(leaves)
        return found

    def _base(self, table: Any, k: int) -> Any:
        place = self.builder.gep(table, [ir.Constant(self.index, k)], source_etype=ir.PointerType())
        return self.builder.load(place, typ=ir.PointerType())

    def _slots(self, count: int) -> list[Any]:
        stack = self.builder.alloca(self.vector, ir.Constant(self.index, count))
        stack.align = VECTOR_BYTES
        return [
            self.builder.gep(stack, [ir.Constant(self.index, k)], source_etype=self.vector)
            for k in range(count)
        ]

    def _places(
        self, kind: str, bases: dict[str, list[Any]], lanes: Any, first: Any, sample: Any = None
    ) -> list[Any]:
        """Address of every number, of this sample's row where there is one."""
        found = []
        for leaf, base in zip(self.leaves[kind], bases[kind], strict=True):
            stride = lanes if leaf.is_varying else ir.Constant(self.index, 1)
            start = first if leaf.is_varying else ir.Constant(self.index, 0)
            if sample is not None:
                row = self.builder.mul(sample, ir.Constant(self.index, leaf.size))
                start = self.builder.add(start, self.builder.mul(row, stride))
            for k in range(leaf.size):
                offset = self.builder.mul(ir.Constant(self.index, k), stride)
                offset = self.builder.add(start, offset)
                found.append(self.builder.gep(base, [offset], source_etype=self.scalar))
        return found

    def _load(self, place: Any, is_varying: bool) -> Any:
        kind = self.vector if is_varying else self.scalar
        return self.builder.load(place, align=self.real.itemsize, typ=kind)

    # --- operations -------------------------------------------------------------------------------

    def _emit(self, node: Node) -> None:
        widen = self._widened if node.is_varying else self._narrow
        args = [widen(x) for x in node.args]
        self.values[id(node)] = getattr(self, f"_{node.operation}", self._plain)(node, *args)

    def _narrow(self, x: Any) -> Any:
        if not is_known(x):
            return self.values[id(x)]
        if isinstance(x, bool):
            return ir.Constant(ir.IntType(1), int(x))
        return ir.Constant(self.scalar, float(x))

    def _widened(self, x: Any) -> Any:
        one = self._narrow(x)
        if isinstance(one.type, ir.VectorType):
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
        """A known number, read anew at each use.

        LLVM would keep every one of them as a whole vector on the stack, more than the cache holds.
        One of its own in memory costs an instruction nothing: it is spread over the vector as it is
        read.
        """
        place = ir.Constant(self.index, len(self.numbers))
        self.numbers.append(x)
        place = self.builder.gep(self.table, [place], source_etype=self.scalar)
        return self.builder.load(place, align=self.real.itemsize, typ=self.scalar)

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
        return self._intrinsic("fma", *args)

    def _fnma(self, node: Node, a: Any, b: Any, c: Any) -> Any:
        return self._intrinsic("fma", self.builder.fneg(a), b, c)

    def _reciprocal(self, node: Node, a: Any) -> Any:
        one = self._widened(1.0) if node.is_varying else self._narrow(1.0)
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
        """The larger or smaller one; not a number if either is none."""
        # one instruction, which gives b where either is no number
        chosen = self.builder.select(self.builder.fcmp_ordered(sign, a, b), a, b)
        if is_known(node.args[0]):
            return chosen
        return self.builder.select(self.builder.fcmp_unordered("uno", a, a), a, chosen)

    def _tanh(self, node: Node, a: Any) -> Any:
        """One number at a time, by the library."""
        name = "tanh" if self.real.itemsize == 8 else "tanhf"
        if not node.is_varying:
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
        full = f"llvm.{name}.{lanes}f{8 * self.real.itemsize}"
        return self._call(full, kind, *args)

    def _call(self, name: str, kind: Any, *args: Any) -> Any:
        """Call a function of LLVM or the library, declared at its first use."""
        function = self.module.globals.get(name) or ir.Function(
            self.module, ir.FunctionType(kind, [x.type for x in args]), name
        )
        return self.builder.call(function, args)


#: Comparisons in LLVM's writing.
_SIGNS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}


class _Change(NamedTuple):
    """What a sample does to one number of the state."""

    slot: int
    mask: Any  # where it changes
    value: Any


def _changes(results: Sequence[Any]) -> list[_Change]:
    """The numbers of the state that change; a case that is frozen keeps its own."""
    changes = []
    for k, x in enumerate(results):
        if not is_known(x) and x.operation == "select" and _is_state(x.args[1], k):
            changes.append(_Change(k, x.args[0], x.args[2]))
        elif not _is_state(x, k):
            changes.append(_Change(k, True, x))
    return changes


def _due(
    order: Sequence[Node], is_fixed: dict[int, bool], changes: Sequence[_Change]
) -> dict[Any, list[_Change]]:
    """After which node of the loop each change can be stored; None: before all of them.

    That is when it is worked out and nothing reads the old number any more.
    """
    at = {id(node): k for k, node in enumerate(order)}
    read = {node.place[1]: node for node in order if node.place and node.place[0] == "state"}
    due: dict[Any, list[_Change]] = defaultdict(list)
    for change in changes:
        needed = [change.mask, change.value, read.get(change.slot, True)]
        nodes = [x for x in needed if not is_known(x) and not is_fixed[id(x)]]
        last = max(nodes, key=lambda x: at[id(x)], default=None)
        due[None if last is None else id(last)].append(change)
    return due


def _is_state(x: Any, k: int) -> bool:
    return not is_known(x) and x.place == ("state", k)


def _fixed(order: Sequence[Node]) -> dict[int, bool]:
    """Which nodes stay the same from sample to sample."""
    found: dict[int, bool] = {}
    for node in order:
        if node.operation == "read":
            found[id(node)] = node.place[0] == "constant"
        else:
            found[id(node)] = all(found[id(x)] for x in node.args if not is_known(x))
    return found
