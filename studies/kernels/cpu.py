"""The traced loop on this processor: compiled by LLVM, vectors of cases side by side.

XLA cannot do this: it fuses the step into many loops that recompute what they share. llvmlite is
optional (extra `fast`); without it, XLA runs the same step.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import jax
import numpy as np

from studies import sources
from studies.kernels.compilation import ObjectCache, compiling
from studies.kernels.graph import is_known
from studies.kernels.llvm import Arguments, Writer, binding, ir
from studies.kernels.traced import Change, TracedLoop

#: Bytes per vector: one register of the widest common instruction set.
VECTOR_BYTES = 64
#: Optimisation level of XLA's code generator in XLA_FLAGS; the kernels use the same.
_LEVEL = re.compile(r"--xla_backend_optimization_level=([0-3])")


class Kernel:
    """A compiled loop. Call it with arrays; it releases Python's lock."""

    def __init__(
        self, code: Any, width: int, numbers: np.ndarray, operations: Counter[str]
    ) -> None:
        self._code = code  # keeps the machine code alive
        pointers = ctypes.POINTER(ctypes.c_void_p)
        prototype = ctypes.CFUNCTYPE(None, pointers, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
        self._function = prototype(code.get_function_address("run"))
        self.width, self.numbers = width, numbers
        #: operations of one sample by kind
        self.operations = operations

    def run(self, leaves: Sequence[np.ndarray], n_steps: int, lanes: int) -> None:
        """Step all lanes from start to end; the state's arrays are changed in place.

        Args:
            leaves: contiguous arrays in the order of `build_kernel`, without known ones; inputs
                have samples first, varying arrays have lanes last.
            n_steps: samples.
            lanes: cases side by side, a multiple of `width`.

        Raises:
            ValueError: wrong number of lanes, which would write beyond the arrays.
        """
        if lanes % self.width:
            raise ValueError(f"lanes = {lanes}; allowed: multiples of {self.width}")
        arrays = [self.numbers, *leaves]
        addresses = (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))
        for first in range(0, lanes, self.width):
            self._function(addresses, n_steps, lanes, first)


def build_kernel(loop: TracedLoop) -> Kernel:
    """Compile a loop.

    Args:
        loop: from `trace_loop`.
    """
    return _build(loop)[0]


def _build(loop: TracedLoop) -> tuple[Kernel, bytes]:
    """The kernel, and its machine code."""
    writer = _VectorWriter(loop)
    engine, code = _compile(str(writer.write()))
    numbers = np.array(writer.numbers, loop.dtype)
    return Kernel(engine, writer.width, numbers, loop.operations()), code


def kept_kernel(name: str, make: Callable[[], TracedLoop]) -> Kernel:
    """The kernel of a loop that depends only on `name` and the code of model and kernels.

    If found in the cache folder, it is not even traced.

    Args:
        name: of the loop, with all sizes.
        make: traces it.
    """
    kept = ObjectCache("loop", name, _code(), jax.__version__, *_target())
    found = kept.take(None)
    if found is None:
        kernel, code = _build(make())
        facts = [kernel.width, kernel.numbers.tolist(), kernel.operations]
        kept.keep(None, json.dumps(facts).encode() + b"\n" + code)
        return kernel
    head, code = found.split(b"\n", 1)
    width, numbers, operations = json.loads(head)
    initialise()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    dtype = np.dtype(f"f{VECTOR_BYTES // width}")
    return Kernel(engine, width, np.array(numbers, dtype), Counter(operations))


@cache
def _code() -> str:
    """Hash of the code that a traced loop comes from."""
    return sources.digest(__name__, "jaxmodel")


class _VectorWriter(Writer):
    """Writes `run(leaves, n_steps, lanes, first)`; the first leaf holds the known numbers."""

    def __init__(self, loop: TracedLoop) -> None:
        super().__init__(loop, VECTOR_BYTES // loop.dtype.itemsize)
        self.numbers: list[float] = [0.0]  # known ones, in the order of their use

    def open(self) -> Arguments:
        pointer = ir.PointerType()
        signature = ir.FunctionType(ir.VoidType(), [pointer, self.index, self.index, self.index])
        function = ir.Function(self.module, signature, "run")
        function.attributes.add("nounwind")
        leaves, n_steps, lanes, first = function.args
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self._rounding = self._flush_to_zero()
        self._table = self._base(leaves, 0)
        bases, k = {}, 1
        for kind, part in self.loop.leaves.items():
            bases[kind] = [self._base(leaves, k + n) for n in range(len(part))]
            k += len(part)
        return Arguments({**bases, "result": bases["state"]}, n_steps, lanes, first)

    def close(self) -> None:
        if self._rounding is not None:
            self._control("ldmxcsr", self._rounding)
        super().close()

    def _base(self, leaves: Any, k: int) -> Any:
        place = self.builder.gep(
            leaves, [ir.Constant(self.index, k)], source_etype=ir.PointerType()
        )
        return self.builder.load(place, typ=ir.PointerType())

    def _flush_to_zero(self) -> Any:
        """Flush subnormal numbers to 0; returns where the processor's old mode is kept.

        Arithmetic with them is a hundred times slower, and sums in single precision produce them.
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

    def _store(self, change: Change, slot: Any) -> None:
        if is_known(change.mask):
            super()._store(change, slot)
            return
        name = f"llvm.masked.store.v{self.width}f{8 * self.bytes}.p0"
        alignment = ir.Constant(ir.IntType(32), VECTOR_BYTES)
        value, mask = self._widened(change.value), self._widened(change.mask)
        self._call(name, ir.VoidType(), value, slot, alignment, mask)

    def _number(self, x: float) -> Any:
        """A known number, reloaded at each use.

        LLVM would keep each one as a full vector on the stack, more than the cache holds. A scalar
        in memory costs nothing extra: it is broadcast over the vector as it is read.
        """
        place = ir.Constant(self.index, len(self.numbers))
        self.numbers.append(x)
        place = self.builder.gep(self._table, [place], source_etype=self.scalar)
        return self.builder.load(place, align=self.bytes, typ=self.scalar)


@cache
def initialise() -> None:
    """Prepare LLVM for this processor."""
    for part in ("initialize_native_target", "initialize_native_asmprinter"):
        getattr(binding, part)()


def _effort() -> int:
    """LLVM's optimisation level; 0 compiles six times as fast as 3, and runs half as fast."""
    found = _LEVEL.search(os.environ.get("XLA_FLAGS", ""))
    return int(found[1]) if found else 3


def _target() -> tuple[str, ...]:
    """What machine code depends on besides its source."""
    features, version = binding.get_host_cpu_features().flatten(), binding.llvm_version_info
    triple = binding.get_default_triple()
    return (
        binding.get_host_cpu_name(),
        features,
        triple,
        ".".join(map(str, version)),
        str(_effort()),
    )


def _machine() -> Any:
    cpu, features, *_ = _target()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=_effort(), jit=True
    )


def _compile(text: str) -> tuple[Any, bytes]:
    """The engine with the machine code of a module, and that code."""
    initialise()
    kept, code = ObjectCache(text, *_target()), []

    def keep(module: Any, made: bytes) -> None:
        code.append(made)
        kept.keep(module, made)

    def take(module: Any) -> bytes | None:
        found = kept.take(module)
        if found is not None:
            code.append(found)
        return found

    with compiling():
        engine = binding.create_mcjit_compiler(binding.parse_assembly(text), _machine())
        engine.set_object_cache(keep, take)
        engine.finalize_object()
    return engine, code[-1]
