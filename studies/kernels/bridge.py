"""Kernels as part of JAX programs: XLA calls them through its foreign function interface.

XLA hands a call frame to a handler: a small function, written here as LLVM instructions, that takes
the arrays' addresses out of the frame and calls the kernel. Nothing passes through Python, so a
call costs microseconds and runs inside `jit`, `lax.map` and `shard_map`.
"""

from __future__ import annotations

import ctypes
import hashlib
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp

from studies.kernels import native
from studies.kernels.cpu import Kernel, kept_kernel
from studies.kernels.differentiable import LoopCall

#: Places in XLA's structures [bytes], for version 0 of its interface (xla/ffi/api/c_api.h).
_ARGUMENTS, _RESULTS, _DATA = 72, 112, 24
_EXTENSION, _KIND, _METADATA, _VERSION = 8, 8, 24, 24

#: What keeps a handler alive: its machine code and its kernel, by its name.
_HANDLERS: dict[str, tuple[Any, Kernel]] = {}
#: Kernels by their names; handlers for several sizes share one.
_KERNELS: dict[str, Kernel] = {}
#: XLA takes a name once.
_REGISTERING = Lock()


def is_available() -> bool:
    """Whether this version of jaxlib has the interface that handlers are written for."""
    return _version()[0] == 0


class CpuCall(LoopCall):
    """A call of a kernel for this processor."""

    #: Pieces whose records stay in the cache, each stepped again, cost less than all in memory.
    RECORD = 2 * 2**20

    @property
    def target(self) -> str:
        """Name under which XLA knows the handler, the same in every process."""
        key = f"{self.name} {self.n_steps} {self.lanes} {native.this_processor()}"
        return f"flexlink_{hashlib.sha256(key.encode()).hexdigest()[:24]}"

    @staticmethod
    def has_routines() -> bool:
        """Where instructions take numbers from memory only, small code is fast."""
        return not native.this_processor().has_masks

    def prepare(self) -> None:
        self.kernel()

    def kernel(self) -> Kernel:
        """The kernel, whose handler XLA now knows."""
        with _REGISTERING:
            if self.target not in _HANDLERS:
                _HANDLERS[self.target] = _register(self)
        return _HANDLERS[self.target][1]

    def note_run(self, seconds: float) -> None:
        self.kernel().note_run(seconds)  # those that run for long are compiled better

    def __call__(self, arrays: Sequence[Any]) -> list[Any]:
        self.kernel()
        call = jax.ffi.ffi_call(
            self.target,
            self.shapes,
            input_output_aliases={self.n_given + k: k for k in range(len(self.state))},
            vmap_method="sequential",
        )
        return list(call(*(jnp.asarray(x, self.dtype) for x in arrays)))


def _register(call: CpuCall) -> tuple[Any, Kernel]:
    """Make a handler known to XLA; returns what keeps it alive."""
    if call.name not in _KERNELS:
        _KERNELS[call.name] = kept_kernel(call.name, call.make)
    kernel = _KERNELS[call.name]
    if call.lanes % kernel.width:
        raise ValueError(f"lanes = {call.lanes}; allowed: multiples of {kernel.width}")
    text = _handler(
        kernel, call.n_given, len(call.state) + len(call.records), call.n_steps, call.lanes
    )
    processor = native.this_processor()
    engine = native.load_code(native.machine_code(text, processor, 0), processor)
    pointer = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    address = engine.get_function_address("handler")
    jax.ffi.register_ffi_target(call.target, jax.ffi.pycapsule(pointer(address)), platform="cpu")
    return engine, kernel


def _handler(kernel: Kernel, n_given: int, n_results: int, n_steps: int, lanes: int) -> str:
    """LLVM's text of `handler(frame)`, which returns no error.

    Args:
        kernel: what it calls.
        n_given: arrays that are read only.
        n_results: state, which begins as the arguments after those, and records.
        n_steps, lanes: as in `LoopCall.of_loop`.
    """
    major, minor = _version()
    arrays = [(_ARGUMENTS, k) for k in range(n_given)] + [(_RESULTS, k) for k in range(n_results)]
    lines = [
        f"""
  %list{n} = getelementptr i8, ptr %frame, i64 {kind}
  %array{n} = load ptr, ptr %list{n}
  %entry{n} = getelementptr ptr, ptr %array{n}, i64 {place}
  %buffer{n} = load ptr, ptr %entry{n}
  %field{n} = getelementptr i8, ptr %buffer{n}, i64 {_DATA}
  %data{n} = load ptr, ptr %field{n}
  %leaf{n} = getelementptr ptr, ptr %leaves, i64 {n}
  store ptr %data{n}, ptr %leaf{n}"""
        for n, (kind, place) in enumerate(arrays, 1)
    ]
    lines += [
        f"  call void %run(ptr %leaves, i64 {n_steps}, i64 {lanes}, i64 {first})"
        for first in range(0, lanes, kernel.width)
    ]
    body = "\n".join(lines)
    return f"""
define ptr @handler(ptr %frame) {{
  %at = getelementptr i8, ptr %frame, i64 {_EXTENSION}
  %extension = load ptr, ptr %at
  %is_plain = icmp eq ptr %extension, null
  br i1 %is_plain, label %execute, label %asked
asked:  ; XLA wants to know for which version of its interface this is
  %at_kind = getelementptr i8, ptr %extension, i64 {_KIND}
  %kind = load i32, ptr %at_kind
  %is_question = icmp eq i32 %kind, 1
  br i1 %is_question, label %told, label %execute
told:
  %at_metadata = getelementptr i8, ptr %extension, i64 {_METADATA}
  %metadata = load ptr, ptr %at_metadata
  %at_major = getelementptr i8, ptr %metadata, i64 {_VERSION}
  store i32 {major}, ptr %at_major
  %at_minor = getelementptr i8, ptr %metadata, i64 {_VERSION + 4}
  store i32 {minor}, ptr %at_minor
  ret ptr null
execute:
  %cell = inttoptr i64 {ctypes.addressof(kernel.cell)} to ptr
  %run = load ptr, ptr %cell
  %at_numbers = getelementptr ptr, ptr %cell, i64 1
  %numbers = load ptr, ptr %at_numbers
  %leaves = alloca ptr, i64 {1 + len(arrays)}
  store ptr %numbers, ptr %leaves
{body}
  ret ptr null
}}
"""


@cache
def _version() -> tuple[int, int]:
    """Version of XLA's interface, as its header says."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    text = header.read_text(encoding="utf-8")
    numbers = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", text))
    return int(numbers["MAJOR"]), int(numbers["MINOR"])
