"""The traced kernel: JAX's own step function as one vectorised machine-code loop over samples.

`jax.make_jaxpr` of one sample's step is straight-line elementwise code. Each equation is carried
out here on arrays of LLVM values, one instruction per element, a vector of cases wide; around it
goes a loop over samples with the state in memory. XLA cannot do this: it fuses the step into many
loops that recompute what they share (docs/performance.md has the measurements). llvmlite is
optional (extra `fast`); without it XLA runs the same step.

Every input is either *shared* (one number for all cases: loaded once as a scalar, and arithmetic on
it stays scalar) or *varying* (lanes last in memory: loaded as a vector).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np

try:
    from llvmlite import binding, ir
except ImportError:  # the extra is not installed
    binding = ir = None

#: Bytes of the vectors: what one register of the widest common instruction set holds.
VECTOR_BYTES = 64
_BOOL = 1  # width of a truth value


def is_available() -> bool:
    """Whether llvmlite is installed."""
    return binding is not None


class Leaf(NamedTuple):
    """One input array of the step, by element."""

    shape: tuple[int, ...]  # of one case (and of one sample)
    is_varying: bool  # one value per case, lanes last; else one for all


class Kernel:
    """A compiled loop. Call it with arrays; it runs without Python's lock."""

    def __init__(self, code: Any, address: int, width: int, n_leaves: int) -> None:
        self._code = code  # keeps the machine code alive
        pointers = ctypes.POINTER(ctypes.c_void_p)
        prototype = ctypes.CFUNCTYPE(None, pointers, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
        self._function = prototype(address)
        self.width, self._n_leaves = width, n_leaves

    def run(self, leaves: Sequence[np.ndarray], n_steps: int, lanes: int) -> None:
        """Step all lanes from begin to end; the state's arrays are changed in place.

        Args:
            leaves: arrays in the order of `build_kernel`, contiguous; those of inputs have the
                samples first, varying ones the lanes last.
            n_steps: samples.
            lanes: cases side by side, a multiple of `width`.
        """
        addresses = (ctypes.c_void_p * self._n_leaves)(*(leaf.ctypes.data for leaf in leaves))
        for first in range(0, lanes, self.width):
            self._function(addresses, n_steps, lanes, first)


def build_kernel(
    step: Callable[..., Any],
    constants: Sequence[Leaf],
    inputs: Sequence[Leaf],
    state: Sequence[Leaf],
    dtype: Any,
) -> Kernel:
    """Compile a loop over `step(constants, inputs, state) -> state`, all lists of arrays.

    Args:
        step: elementwise JAX function of one case and one sample.
        constants: arrays that stay the same over a run.
        inputs: arrays of one sample; in memory one row per sample.
        state: arrays carried from sample to sample; always varying.
        dtype: float64 or float32, of all arrays.

    Raises:
        NotImplementedError: an operation of the step that the kernel does not know.
    """
    real = np.dtype(dtype)

    def examples(leaves: Sequence[Leaf]) -> list[jax.ShapeDtypeStruct]:
        return [jax.ShapeDtypeStruct(leaf.shape, real) for leaf in leaves]

    traced = jax.make_jaxpr(step)(examples(constants), examples(inputs), examples(state))
    width = VECTOR_BYTES // real.itemsize
    module = _Writer(real, width).write(traced, constants, inputs, state)
    engine = _compile(str(module))
    address = engine.get_function_address("run")
    return Kernel(engine, address, width, len(constants) + len(inputs) + len(state))


@cache
def _initialise() -> None:
    for part in ("initialize_native_target", "initialize_native_asmprinter"):
        getattr(binding, part)()


def _compile(text: str) -> Any:
    _initialise()
    module = binding.parse_assembly(text)
    target = binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(), features=binding.get_host_cpu_features().flatten(),
        opt=3, jit=True,
    )  # fmt: skip
    options = binding.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization = False
    passes = binding.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    engine = binding.create_mcjit_compiler(module, target)
    engine.finalize_object()
    return engine


class _Writer:
    """Writes one kernel as LLVM IR.

    An element of an array is a Python number (known while writing), a scalar LLVM value (shared) or
    a vector LLVM value (varying).
    """

    def __init__(self, real: np.dtype, width: int) -> None:
        self.real, self.width = real, width
        self.scalar = ir.DoubleType() if real.itemsize == 8 else ir.FloatType()
        self.vector = ir.VectorType(self.scalar, width)
        self.index = ir.IntType(64)
        self.module = ir.Module()
        self.builder: Any = None

    # --- the loop ---------------------------------------------------------------------------------

    def write(
        self, traced: Any, constants: Sequence[Leaf], inputs: Sequence[Leaf], state: Sequence[Leaf]
    ) -> Any:
        pointer = ir.PointerType()
        signature = ir.FunctionType(ir.VoidType(), [pointer, self.index, self.index, self.index])
        function = ir.Function(self.module, signature, "run")
        function.attributes.add("nounwind")
        table, n_steps, lanes, first = function.args
        entry = function.append_basic_block("entry")
        loop = function.append_basic_block("loop")
        leave = function.append_basic_block("leave")
        self.builder = ir.IRBuilder(entry)
        leaves = [*constants, *inputs, *state]
        bases = [self._base(table, k) for k in range(len(leaves))]
        # the state lives on the stack, where it is known to overlap nothing
        count = sum(int(np.prod(leaf.shape)) for leaf in state)
        stack = self.builder.alloca(self.vector, ir.Constant(self.index, count))
        stack.align = VECTOR_BYTES
        slots = [self._slot(stack, k) for k in range(count)]
        at = len(constants) + len(inputs)
        places = self._places(state, bases[at:], lanes, first, None)
        for slot, place in zip(slots, places, strict=True):
            self.builder.store(self._load(place, True), slot, align=VECTOR_BYTES)
        fixed = [
            self._array(leaf, base, lanes, first, None)
            for leaf, base in zip(constants, bases, strict=False)
        ]
        self.builder.branch(loop)

        self.builder.position_at_end(loop)
        sample = self.builder.phi(self.index)
        sample.add_incoming(ir.Constant(self.index, 0), entry)
        rows = [
            self._array(leaf, base, lanes, first, sample)
            for leaf, base in zip(inputs, bases[len(constants) : at], strict=True)
        ]
        loaded = [self.builder.load(slot, align=VECTOR_BYTES, typ=self.vector) for slot in slots]
        carried = self._shaped(state, loaded)
        results = self.evaluate(traced.jaxpr, traced.consts, [*fixed, *rows, *carried])
        flat = [self._widened(value) for array in results for value in array.flat]
        for slot, old, new in zip(slots, loaded, flat, strict=True):
            if new is not old:
                self.builder.store(new, slot, align=VECTOR_BYTES)
        following = self.builder.add(sample, ir.Constant(self.index, 1))
        sample.add_incoming(following, self.builder.block)
        again = self.builder.icmp_signed("<", following, n_steps)
        self.builder.cbranch(again, loop, leave)

        self.builder.position_at_end(leave)
        for slot, place in zip(slots, places, strict=True):
            last = self.builder.load(slot, align=VECTOR_BYTES, typ=self.vector)
            self.builder.store(last, place, align=self.real.itemsize)
        self.builder.ret_void()
        return self.module

    def _base(self, table: Any, k: int) -> Any:
        place = self.builder.gep(table, [ir.Constant(self.index, k)], source_etype=ir.PointerType())
        return self.builder.load(place, typ=ir.PointerType())

    def _slot(self, stack: Any, k: int) -> Any:
        return self.builder.gep(stack, [ir.Constant(self.index, k)], source_etype=self.vector)

    def _places(
        self, leaves: Sequence[Leaf], bases: Sequence[Any], lanes: Any, first: Any, sample: Any
    ) -> list[Any]:
        """Address of every element, of this sample's row where there is one."""
        found = []
        for leaf, base in zip(leaves, bases, strict=True):
            size = int(np.prod(leaf.shape))
            stride = lanes if leaf.is_varying else ir.Constant(self.index, 1)
            start = first if leaf.is_varying else ir.Constant(self.index, 0)
            if sample is not None:
                row = self.builder.mul(sample, ir.Constant(self.index, size))
                start = self.builder.add(start, self.builder.mul(row, stride))
            for k in range(size):
                offset = self.builder.mul(ir.Constant(self.index, k), stride)
                offset = self.builder.add(start, offset)
                found.append(self.builder.gep(base, [offset], source_etype=self.scalar))
        return found

    def _load(self, place: Any, is_varying: bool) -> Any:
        kind = self.vector if is_varying else self.scalar
        return self.builder.load(place, align=self.real.itemsize, typ=kind)

    def _array(self, leaf: Leaf, base: Any, lanes: Any, first: Any, sample: Any) -> np.ndarray:
        places = self._places([leaf], [base], lanes, first, sample)
        return _objects([self._load(place, leaf.is_varying) for place in places], leaf.shape)

    def _shaped(self, leaves: Sequence[Leaf], values: list[Any]) -> list[np.ndarray]:
        arrays, at = [], 0
        for leaf in leaves:
            size = int(np.prod(leaf.shape))
            arrays.append(_objects(values[at : at + size], leaf.shape))
            at += size
        return arrays

    # --- the equations ----------------------------------------------------------------------------

    def evaluate(self, jaxpr: Any, consts: Sequence[Any], arguments: list[np.ndarray]) -> list:
        """Carry out all equations of a jaxpr on arrays of LLVM values."""
        known: dict[Any, np.ndarray] = {}

        def read(atom: Any) -> np.ndarray:
            if hasattr(atom, "val"):
                return _objects(np.asarray(atom.val).ravel().tolist(), np.shape(atom.val))
            return known[atom]

        for variable, value in zip(jaxpr.constvars, consts, strict=True):
            known[variable] = _objects(np.asarray(value).ravel().tolist(), np.shape(value))
        known |= dict(zip(jaxpr.invars, arguments, strict=True))
        for equation in jaxpr.eqns:
            given = [read(atom) for atom in equation.invars]
            inner = equation.params.get("jaxpr") or equation.params.get("call_jaxpr")
            if equation.primitive.name == "scan":
                results = self._unrolled(equation, given)
            elif inner is not None:
                closed = inner if hasattr(inner, "consts") else None
                body = closed.jaxpr if closed is not None else inner
                results = self.evaluate(body, closed.consts if closed is not None else (), given)
            else:
                results = [self._apply(equation, given)]
            for variable, value in zip(equation.outvars, results, strict=True):
                known[variable] = value
        return [read(atom) for atom in jaxpr.outvars]

    def _unrolled(self, equation: Any, given: list[np.ndarray]) -> list[np.ndarray]:
        """The plant steps of one sample, one after the other."""
        p = equation.params
        body, n_consts, n_carry = p["jaxpr"], p["num_consts"], p["num_carry"]
        constants, carry = given[:n_consts], given[n_consts : n_consts + n_carry]
        stacked = given[n_consts + n_carry :]
        kept = []
        for k in range(p["length"]):
            rows = [_cell(x[k]) for x in stacked]
            results = self.evaluate(body.jaxpr, body.consts, [*constants, *carry, *rows])
            carry = results[:n_carry]
            kept.append(results[n_carry:])
        return [*carry, *(np.stack(parts) for parts in zip(*kept, strict=True))]

    def _apply(self, equation: Any, given: list[np.ndarray]) -> np.ndarray:
        name, params = equation.primitive.name, equation.params
        shape = equation.outvars[0].aval.shape
        structural = _STRUCTURAL.get(name)
        if structural is not None:
            return structural(params, shape, *given)
        if name.startswith("reduce_"):
            return self._reduce(name.removeprefix("reduce_"), given[0], params["axes"], shape)
        if name == "integer_pow":
            return self._each(lambda x: self._power(x, params["y"]), given, shape)
        if name == "convert_element_type":
            return self._each(lambda x: self._converted(x, params["new_dtype"]), given, shape)
        if name in _SIGNS:
            return self._each(partial(self._compared, _SIGNS[name]), given, shape)
        operation = getattr(self, f"_op_{name}", None)
        if operation is None:
            raise NotImplementedError(f"operation {name!r} of the step")
        return self._each(operation, given, shape)

    def _each(
        self, operation: Callable[..., Any], given: list[np.ndarray], shape: tuple[int, ...]
    ) -> np.ndarray:
        wide = [np.broadcast_to(array, shape) for array in given]
        values = [operation(*row) for row in zip(*(array.flat for array in wide), strict=True)]
        return _objects(values, shape)

    def _reduce(
        self, name: str, array: np.ndarray, axes: tuple[int, ...], shape: tuple[int, ...]
    ) -> np.ndarray:
        join = getattr(self, "_op_" + {"sum": "add"}.get(name, name))
        kept = [k for k in range(array.ndim) if k not in axes]
        rows = np.transpose(array, [*kept, *axes]).reshape(int(np.prod(shape)), -1)
        return _objects([self._tree(join, list(row)) for row in rows], shape)

    def _tree(self, join: Callable[..., Any], values: list[Any]) -> Any:
        while len(values) > 1:
            pairs = [join(a, b) for a, b in zip(values[::2], values[1::2], strict=False)]
            values = pairs + values[len(values) - len(values) % 2 :]
        return values[0]

    # --- operations on elements -------------------------------------------------------------------

    def _pair(self, *values: Any) -> list[Any]:
        """LLVM values of one type: vectors if any is one."""
        is_vector = any(_is_vector(value) for value in values)
        return [self._widened(v) if is_vector else self._constant(v) for v in values]

    def _constant(self, value: Any) -> Any:
        if isinstance(value, (bool, np.bool_)):
            return ir.Constant(ir.IntType(_BOOL), int(value))
        return ir.Constant(self.scalar, float(value)) if _is_known(value) else value

    def _widened(self, value: Any) -> Any:
        if _is_vector(value):
            return value
        if _is_known(value):
            one = self._constant(value)
            kind = ir.VectorType(one.type, self.width)
            return ir.Constant(kind, [one.constant] * self.width)
        kind = ir.VectorType(value.type, self.width)
        start = self.builder.insert_element(
            ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
        )
        order = ir.Constant(ir.VectorType(ir.IntType(32), self.width), [0] * self.width)
        return self.builder.shuffle_vector(start, ir.Constant(kind, ir.Undefined), order)

    def _op_add(self, a: Any, b: Any) -> Any:
        if _is_zero(a):
            return b
        if _is_zero(b):
            return a
        return self._binary("fadd", a, b, lambda x, y: x + y)

    def _op_sub(self, a: Any, b: Any) -> Any:
        return a if _is_zero(b) else self._binary("fsub", a, b, lambda x, y: x - y)

    def _op_mul(self, a: Any, b: Any) -> Any:
        if _is_one(a):
            return b
        if _is_one(b):
            return a
        return self._binary("fmul", a, b, lambda x, y: x * y)

    def _op_div(self, a: Any, b: Any) -> Any:
        if _is_known(b) and b != 0 and not isinstance(b, bool) and np.log2(abs(b)) % 1 == 0:
            return self._op_mul(a, 1 / b)  # by a power of two: exact
        return self._binary("fdiv", a, b, lambda x, y: x / y)

    def _binary(self, name: str, a: Any, b: Any, on_numbers: Callable[..., Any]) -> Any:
        if _is_known(a) and _is_known(b):
            return on_numbers(a, b)
        # a*b + c may be rounded once, and several divisions by one number share its reciprocal
        return getattr(self.builder, name)(*self._pair(a, b), flags=("contract", "arcp"))

    def _op_neg(self, a: Any) -> Any:
        return -a if _is_known(a) else self.builder.fneg(a)

    def _op_square(self, a: Any) -> Any:
        return self._op_mul(a, a)

    def _power(self, a: Any, y: int) -> Any:
        if y < 0:
            return self._op_div(1.0, self._power(a, -y))
        return self._tree(self._op_mul, [a] * y) if y else 1.0

    def _converted(self, a: Any, dtype: Any) -> Any:
        if np.dtype(dtype) == bool:
            return self._compared("!=", a, 0.0)
        if _is_known(a):
            return float(a)
        return self._op_select_n(a, 0.0, 1.0) if _is_truth(a) else a

    def _compared(self, sign: str, a: Any, b: Any) -> Any:
        if _is_known(a) and _is_known(b):
            return bool(_COMPARE[sign](a, b))
        compare = self.builder.fcmp_unordered if sign == "!=" else self.builder.fcmp_ordered
        return compare(sign, *self._pair(a, b))

    def _op_and(self, a: Any, b: Any) -> Any:
        if _is_known(a) or _is_known(b):
            known, other = (a, b) if _is_known(a) else (b, a)
            return other if known else False
        return self.builder.and_(*self._pair(a, b))

    def _op_or(self, a: Any, b: Any) -> Any:
        if _is_known(a) or _is_known(b):
            known, other = (a, b) if _is_known(a) else (b, a)
            return True if known else other
        return self.builder.or_(*self._pair(a, b))

    def _op_not(self, a: Any) -> Any:
        return not a if _is_known(a) else self.builder.not_(a)

    def _op_select_n(self, which: Any, no: Any, yes: Any) -> Any:
        if _is_known(which):
            return yes if which else no
        if no is yes:
            return no
        return self.builder.select(*self._pair(which, yes, no))

    def _op_max(self, a: Any, b: Any) -> Any:
        return self._extreme(">", a, b)

    def _op_min(self, a: Any, b: Any) -> Any:
        return self._extreme("<", a, b)

    def _extreme(self, sign: str, a: Any, b: Any) -> Any:
        """The larger or smaller one; not a number if either is none."""
        if _is_known(a) and _is_known(b):
            return a if _COMPARE[sign](a, b) else b
        a, b = self._pair(*((b, a) if _is_known(a) else (a, b)))
        # unordered: a is chosen where either is no number; then b, where that is none
        chosen = self.builder.select(self.builder.fcmp_unordered(sign, a, b), a, b)
        if isinstance(b, ir.Constant):
            return chosen
        return self.builder.select(self.builder.fcmp_unordered("uno", b, b), b, chosen)

    def _op_clamp(self, low: Any, x: Any, high: Any) -> Any:
        return self._op_min(self._op_max(x, low), high)

    def _op_sign(self, a: Any) -> Any:
        up = self._op_select_n(self._compared(">", a, 0.0), 0.0, 1.0)
        return self._op_select_n(self._compared("<", a, 0.0), up, -1.0)

    def _op_is_finite(self, a: Any) -> Any:
        return self._compared("<", self._op_abs(a), np.inf)

    def _op_abs(self, a: Any) -> Any:
        return abs(a) if _is_known(a) else self._intrinsic("fabs", a)

    def _op_sqrt(self, a: Any) -> Any:
        return float(np.sqrt(a)) if _is_known(a) else self._intrinsic("sqrt", a)

    def _op_round(self, a: Any) -> Any:
        return float(np.round(a)) if _is_known(a) else self._intrinsic("rint", a)

    def _op_tanh(self, a: Any) -> Any:
        """One number at a time, by the library."""
        if _is_known(a):
            return float(np.tanh(a))
        name = "tanh" if self.real.itemsize == 8 else "tanhf"
        function = self.module.globals.get(name) or ir.Function(
            self.module, ir.FunctionType(self.scalar, [self.scalar]), name
        )
        if not _is_vector(a):
            return self.builder.call(function, [a])
        result = ir.Constant(self.vector, ir.Undefined)
        for k in range(self.width):
            place = ir.Constant(ir.IntType(32), k)
            one = self.builder.call(function, [self.builder.extract_element(a, place)])
            result = self.builder.insert_element(result, one, place)
        return result

    def _intrinsic(self, name: str, a: Any) -> Any:
        lanes = f"v{self.width}" if _is_vector(a) else ""
        full = f"llvm.{name}.{lanes}f{8 * self.real.itemsize}"
        function = self.module.globals.get(full) or ir.Function(
            self.module, ir.FunctionType(a.type, [a.type]), full
        )
        return self.builder.call(function, [a])


#: Names of comparisons among JAX's operations.
_SIGNS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
}


def _objects(values: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    array = np.empty(len(values), object)
    array[:] = values
    return array.reshape(shape)


def _cell(value: Any) -> np.ndarray:
    return value if isinstance(value, np.ndarray) else _objects([value], ())


def _is_known(value: Any) -> bool:
    return isinstance(value, (bool, int, float, np.generic))


def _is_vector(value: Any) -> bool:
    return not _is_known(value) and isinstance(value.type, ir.VectorType)


def _is_truth(value: Any) -> bool:
    kind = value.type.element if _is_vector(value) else value.type
    return isinstance(kind, ir.IntType)


def _is_zero(value: Any) -> bool:
    return _is_known(value) and not isinstance(value, bool) and value == 0


def _is_one(value: Any) -> bool:
    return _is_known(value) and not isinstance(value, bool) and value == 1


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
