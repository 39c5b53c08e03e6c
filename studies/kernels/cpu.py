"""The traced loop on this processor: compiled by LLVM, vectors of cases side by side.

XLA cannot do this: it fuses the step into many loops that recompute what they share. llvmlite is
not there on every platform; without it, XLA runs the same step.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from threading import Lock, Thread
from typing import Any
from weakref import WeakSet

import jax
import numpy as np

from studies import sources
from studies.errors import NoKernelError
from studies.kernels import native
from studies.kernels.compilation import ObjectCache, compiling
from studies.kernels.native import (
    Processor,
    binding,
    load_code,
    machine_code,
    machine_code_apart,
)
from studies.kernels.traced import TracedLoop
from studies.kernels.vectors import ALIGNMENT, CalledWriter, MaskedWriter, VectorWriter

#: Lanes come in multiples of this many bytes, which the vectors of every processor divide.
LANE_BYTES = ALIGNMENT
#: Optimisation level of XLA's code generator in XLA_FLAGS; the kernels use the same.
_LEVEL = re.compile(r"--xla_backend_optimization_level=([0-3])")


#: Effort of a first version, which compiles six times as fast and runs half as fast.
QUICK = 0
#: Run time of all kernels after which they deserve all the effort [s].
UPGRADE_AFTER = 3.0
_patience = [0]


@contextmanager
def full_effort() -> Iterator[None]:
    """Compile kernels with all effort at once, and upgrade those that are used."""
    _patience[0] += 1
    try:
        yield
    finally:
        _patience[0] -= 1


class Kernel:
    """A compiled loop. Call it with arrays; it releases Python's lock.

    The first version compiles quickly. Once kernels have run for a while, another process makes
    faster ones, which replace them; both give the same numbers.
    """

    def __init__(
        self,
        engine: Any,
        width: int,
        numbers: np.ndarray,
        operations: Counter[str],
        better: Callable[[bool], bytes | None] | None = None,
    ) -> None:
        """
        Args:
            engine: holds the machine code.
            width: cases in a vector.
            numbers: known ones, the first leaf.
            operations: of one sample by kind.
            better: machine code with all effort, None if that failed; made in a process of its own
                if its argument is true. None: there is no better one.
        """
        self._engines: list[Any] = []  # keeps the machine code alive, for threads that still run it
        #: Addresses of the machine code and of the known numbers, for callers other than Python.
        self.cell = (ctypes.c_void_p * 2)(None, numbers.ctypes.data)
        self._use(engine)
        self.width, self.numbers, self.operations = width, numbers, operations
        self._better, self.spent = better, 0.0
        _UPGRADES.add(self)

    def _use(self, engine: Any) -> None:
        self._engines.append(engine)
        pointers = ctypes.POINTER(ctypes.c_void_p)
        prototype = ctypes.CFUNCTYPE(None, pointers, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
        address = engine.get_function_address("run")
        self._function, self.cell[0] = prototype(address), address

    @property
    def is_best(self) -> bool:
        """Whether no upgrade is to come."""
        return self._better is None

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
        if self._better is not None and _patience[0]:
            self.upgrade(False)
        arrays = [self.numbers, *leaves]
        addresses = (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))
        began = time.perf_counter()
        for first in range(0, lanes, self.width):
            self._function(addresses, n_steps, lanes, first)
        self.note_run(time.perf_counter() - began)

    def note_run(self, seconds: float) -> None:
        """Add to the time that this kernel has run, which decides whether it is upgraded."""
        self.spent += seconds
        if self._better is None:
            return
        if _patience[0]:
            self.upgrade(False)
        else:
            _UPGRADES.consider()

    def upgrade(self, is_apart: bool) -> None:
        """Replace the machine code by better one, made here or in a process of its own."""
        better, self._better = self._better, None
        code = better(is_apart) if better is not None else None
        if code is not None:
            self._use(load_code(code, native.this_processor()))


class _Upgrades:
    """All kernels in use, which one thread upgrades when they have run long enough."""

    def __init__(self) -> None:
        self._kernels: WeakSet[Kernel] = WeakSet()
        self._lock, self._thread = Lock(), Thread()

    def add(self, kernel: Kernel) -> None:
        with self._lock:
            self._kernels.add(kernel)

    def consider(self) -> None:
        """Start the upgrades if they are due."""
        with self._lock:
            is_due = sum(kernel.spent for kernel in self._kernels) > UPGRADE_AFTER
            if is_due and not self._thread.is_alive():
                self._thread = Thread(target=self._upgrade, daemon=True)
                self._thread.start()

    def _upgrade(self) -> None:
        with self._lock:
            waiting = [kernel for kernel in self._kernels if not kernel.is_best]
        for kernel in sorted(waiting, key=lambda x: -x.spent):
            kernel.upgrade(is_apart=True)


_UPGRADES = _Upgrades()


def build_kernel(loop: TracedLoop, processor: Processor | None = None) -> Kernel:
    """Compile a loop, or find it in the cache folder.

    Args:
        loop: from `trace_loop`.
        processor: what for; default: this one.
    """
    return kept_kernel(loop.text(), lambda: loop, processor)


def write_loop(loop: TracedLoop, processor: Processor) -> VectorWriter:
    """The loop as LLVM's instructions, in the way that suits a processor."""
    kind = MaskedWriter if processor.has_masks and not loop.bodies else CalledWriter
    writer = kind(loop, processor.vector_bytes // loop.dtype.itemsize, processor.triple)
    writer.write()
    return writer


def _align(numbers: Sequence[float], dtype: Any) -> np.ndarray:
    """A copy at an address that any vector may have."""
    size = np.dtype(dtype).itemsize
    room = np.empty(len(numbers) + ALIGNMENT // size, dtype)
    first = -room.ctypes.data % ALIGNMENT // size
    room[first : first + len(numbers)] = numbers
    return room[first : first + len(numbers)]


def kept_kernel(
    name: str, make: Callable[[], TracedLoop], processor: Processor | None = None
) -> Kernel:
    """The kernel of a loop that depends only on `name` and the code of model and kernels.

    If found in the cache folder, it is not even traced.

    Args:
        name: of the loop, with all sizes.
        make: traces it.
        processor: what for; default: this one.
    """
    at = processor or native.this_processor()

    def kept(effort: int) -> ObjectCache:
        return ObjectCache("kernel", name, _code(), jax.__version__, *_names(at, effort))

    @cache
    def written() -> tuple[bytes, str]:
        """What a kernel needs besides its machine code, and the text of that."""
        loop = make()
        writer = write_loop(loop, at)
        facts = [writer.width, writer.numbers, loop.operations()]
        return json.dumps(facts).encode(), str(writer.module)

    def compiled(effort: int, is_apart: bool = False) -> tuple[bytes, bytes] | None:
        head, text = written()
        code = (machine_code_apart if is_apart else _machine_code_here)(text, at, effort)
        if code is None:
            return None
        kept(effort).keep(head + b"\n" + code)
        return head, code

    def better(is_apart: bool) -> bytes | None:
        stored = kept(_effort()).take()
        if stored is not None:  # another process was faster
            return stored.split(b"\n", 1)[1]
        result = compiled(_effort(), is_apart)
        return None if result is None else result[1]

    for effort in _efforts():
        stored = kept(effort).take()
        if stored is not None:
            head, code = stored.split(b"\n", 1)
            break
    else:
        result = compiled(effort)
        assert result is not None
        head, code = result
    width, numbers, operations = json.loads(head)
    dtype = np.dtype(f"f{at.vector_bytes // width}")
    return Kernel(
        load_code(code, at),
        width,
        _align(numbers, dtype),
        Counter(operations),
        better=None if effort == _effort() else better,
    )


@cache
def _code() -> str:
    """Hash of the code that a traced loop comes from."""
    return sources.digest(__name__, "jaxmodel")


def _effort() -> int:
    """LLVM's optimisation level; 0 compiles six times as fast as 3, and runs half as fast."""
    match = _LEVEL.search(os.environ.get("XLA_FLAGS", ""))
    return int(match[1]) if match else 3


def _efforts() -> list[int]:
    """Efforts in the order of preference; the last one is what is compiled."""
    best = _effort()
    return [best] if _patience[0] or best == QUICK else [best, QUICK]


def _names(processor: Processor, effort: int) -> tuple[str, ...]:
    """What machine code depends on besides its source."""
    return (*processor, ".".join(map(str, binding.llvm_version_info)), str(effort))


def _machine_code_here(text: str, processor: Processor, effort: int) -> bytes:
    with compiling():
        try:
            return machine_code(text, processor, effort)
        except RuntimeError as error:
            reason = (str(error).splitlines() or [""])[0]
            raise NoKernelError(f"LLVM cannot compile the traced kernel: {reason}") from error
