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
from typing import Any, NamedTuple

import jax
import numpy as np

from studies import sources
from studies.kernels.compilation import ObjectCache, compiling
from studies.kernels.llvm import binding
from studies.kernels.traced import TracedLoop
from studies.kernels.vectors import ALIGNMENT, CalledWriter, MaskedWriter, VectorWriter

#: Lanes come in multiples of this many bytes, which the vectors of every processor divide.
LANE_BYTES = ALIGNMENT
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


def build_kernel(loop: TracedLoop, processor: Processor | None = None) -> Kernel:
    """Compile a loop.

    Args:
        loop: from `trace_loop`.
        processor: what for; default: this one.
    """
    return _build(loop, processor or this_processor())[0]


def _build(loop: TracedLoop, processor: Processor) -> tuple[Kernel, bytes]:
    """The kernel, and its machine code."""
    writer = write_loop(loop, processor)
    engine, code = _compile(str(writer.module), processor)
    numbers = _aligned(writer.numbers, loop.dtype)
    return Kernel(engine, writer.width, numbers, loop.operations()), code


def write_loop(loop: TracedLoop, processor: Processor) -> VectorWriter:
    """The loop as LLVM's instructions, in the way that suits a processor."""
    kind = MaskedWriter if processor.has_masks else CalledWriter
    writer = kind(loop, processor.vector_bytes // loop.dtype.itemsize, processor.triple)
    writer.write()
    return writer


def _aligned(numbers: Sequence[float], dtype: Any) -> np.ndarray:
    """A copy at an address that any vector may have."""
    size = np.dtype(dtype).itemsize
    room = np.empty(len(numbers) + ALIGNMENT // size, dtype)
    first = -room.ctypes.data % ALIGNMENT // size
    room[first : first + len(numbers)] = numbers
    return room[first : first + len(numbers)]


def kept_kernel(name: str, make: Callable[[], TracedLoop]) -> Kernel:
    """The kernel of a loop that depends only on `name` and the code of model and kernels.

    If found in the cache folder, it is not even traced.

    Args:
        name: of the loop, with all sizes.
        make: traces it.
    """
    processor = this_processor()
    kept = ObjectCache("loop", name, _code(), jax.__version__, *_names(processor))
    found = kept.take(None)
    if found is None:
        kernel, code = _build(make(), processor)
        facts = [kernel.width, kernel.numbers.tolist(), kernel.operations]
        kept.keep(None, json.dumps(facts).encode() + b"\n" + code)
        return kernel
    head, code = found.split(b"\n", 1)
    width, numbers, operations = json.loads(head)
    initialise()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine(processor))
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    dtype = np.dtype(f"f{processor.vector_bytes // width}")
    return Kernel(engine, width, _aligned(numbers, dtype), Counter(operations))


@cache
def _code() -> str:
    """Hash of the code that a traced loop comes from."""
    return sources.digest(__name__, "jaxmodel")


@cache
def initialise() -> None:
    """Prepare LLVM for this processor."""
    for part in ("initialize_native_target", "initialize_native_asmprinter"):
        getattr(binding, part)()


def _effort() -> int:
    """LLVM's optimisation level; 0 compiles six times as fast as 3, and runs half as fast."""
    found = _LEVEL.search(os.environ.get("XLA_FLAGS", ""))
    return int(found[1]) if found else 3


class Processor(NamedTuple):
    """What machine code is for."""

    name: str
    features: str  # as LLVM writes them: "+avx2,-avx512f,..."
    triple: str

    @property
    def vector_bytes(self) -> int:
        """Size of a register: 64 with AVX-512, 32 with AVX2, 16 otherwise."""
        return 64 if self.has_masks else 32 if self._has("avx2") else 16

    @property
    def has_masks(self) -> bool:
        """Whether stores may leave lanes out and instructions spread numbers as they read them."""
        return self._has("avx512f")

    def without(self, *prefixes: str) -> Processor:
        """The same processor with fewer features, as older ones are."""
        features = self.features.split(",")
        kept = [f"-{x[1:]}" if x[1:].startswith(prefixes) else x for x in features]
        return self._replace(features=",".join(kept))

    def _has(self, feature: str) -> bool:
        return f"+{feature}" in self.features.split(",")


@cache
def this_processor() -> Processor:
    """The one that this program runs on."""
    features = binding.get_host_cpu_features().flatten()
    return Processor(binding.get_host_cpu_name(), features, binding.get_default_triple())


def _names(processor: Processor) -> tuple[str, ...]:
    """What machine code depends on besides its source."""
    return (*processor, ".".join(map(str, binding.llvm_version_info)), str(_effort()))


def _machine(processor: Processor) -> Any:
    return binding.Target.from_triple(processor.triple).create_target_machine(
        cpu=processor.name, features=processor.features, opt=_effort(), jit=True
    )


def _compile(text: str, processor: Processor) -> tuple[Any, bytes]:
    """The engine with the machine code of a module, and that code."""
    initialise()
    kept, code = ObjectCache(text, *_names(processor)), []

    def keep(module: Any, made: bytes) -> None:
        code.append(made)
        kept.keep(module, made)

    def take(module: Any) -> bytes | None:
        found = kept.take(module)
        if found is not None:
            code.append(found)
        return found

    with compiling():
        engine = binding.create_mcjit_compiler(binding.parse_assembly(text), _machine(processor))
        engine.set_object_cache(keep, take)
        engine.finalize_object()
    return engine, code[-1]
