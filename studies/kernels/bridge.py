"""Kernels as part of JAX programs: XLA calls them through its foreign function interface.

XLA hands a call frame to a handler: a small function, written here as LLVM instructions, that takes
the arrays' addresses out of the frame and calls the kernel. Nothing passes through Python, so a
call costs microseconds and runs inside `jit`, `lax.map` and `shard_map`.
"""

from __future__ import annotations

import ctypes
import hashlib
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from studies.kernels import native
from studies.kernels.adjoint import RECORD, Adjoint, trace_adjoint
from studies.kernels.cpu import Kernel, build_kernel
from studies.kernels.traced import InputLeaf, TracedLoop, trace_loop

#: Places in XLA's structures [bytes], for version 0 of its interface (xla/ffi/api/c_api.h).
_ARGUMENTS, _RESULTS, _DATA = 72, 112, 24
_EXTENSION, _KIND, _METADATA, _VERSION = 8, 8, 24, 24

#: What keeps a handler alive: its machine code and its kernel, by its name.
_HANDLERS: dict[str, tuple[Any, Kernel]] = {}
#: XLA takes a name once.
_REGISTERING = Lock()


def is_available() -> bool:
    """Whether this version of jaxlib has the interface that handlers are written for."""
    return _version()[0] == 0


def as_function(loop: TracedLoop, n_steps: int, lanes: int) -> Callable[[Sequence[Any]], list[Any]]:
    """A JAX function of a loop's arrays that returns the state after the last sample, and records.

    Args:
        loop: from `trace_loop`.
        n_steps: samples.
        lanes: cases side by side, a multiple of the vectors' width.

    Returns:
        A function of arrays as for `studies.kernels.cpu.Kernel.run`, without those for records; it
        can be part of a compiled program.
    """
    state = [(*leaf.shape, lanes) for leaf in loop.leaves["state"]]
    records = [(n_steps, *leaf.shape, lanes) for leaf in loop.leaves.get("record", ())]
    n_given = sum(len(loop.leaves[kind]) for kind in ("constant", "input", "state"))
    call = jax.ffi.ffi_call(
        _registered(loop, n_steps, lanes),
        [jax.ShapeDtypeStruct(shape, loop.dtype) for shape in (*state, *records)],
        input_output_aliases={n_given - len(state) + k: k for k in range(len(state))},
        vmap_method="sequential",
    )

    def run(arrays: Sequence[Any]) -> list[Any]:
        return list(call(*(jnp.asarray(x, loop.dtype) for x in arrays)))

    return run


def differentiable(
    step: Callable[..., Any],
    constants: Sequence[InputLeaf | np.ndarray],
    inputs: Sequence[InputLeaf],
    state: Sequence[InputLeaf],
    dtype: Any,
    n_steps: int,
    lanes: int,
) -> Callable[[list[Any]], list[Any]]:
    """A loop as a JAX function with derivatives in both modes, all by kernels.

    Args:
        step, constants, inputs, state, dtype: as for `trace_loop`; what is not marked as moving
            gets no derivatives.
        n_steps, lanes: as in `as_function`.

    Returns:
        The last state as a function of the arrays: constants without known ones, inputs, state.

    Raises:
        NoKernelError: the step uses what kernels do not support.
    """
    given = step, constants, inputs, state, dtype
    has_routines = not native.this_processor().has_masks
    still = (step, *map(_still, (constants, inputs, state)), dtype)
    plain = as_function(outside(trace_loop, *still, 0, has_routines), n_steps, lanes)
    tangent = cache(lambda: outside(trace_loop, *given, 1, has_routines))
    adjoint = cache(lambda: outside(trace_adjoint, *given))
    read = [leaf for leaf in constants if isinstance(leaf, InputLeaf)]
    kinds = [*read, *inputs, *(leaf._replace(is_moving=True) for leaf in state)]
    bounds = len(read), len(read) + len(inputs)

    @jax.custom_jvp
    def run(leaves: list[Any]) -> list[Any]:
        return plain(leaves)

    def push(moving: list[int], leaves: list[Any], tangents: list[Any]) -> list[Any]:
        along = {k: jnp.zeros_like(leaves[k]) for k, leaf in enumerate(kinds) if leaf.is_moving}
        along |= dict(zip(moving, tangents, strict=True))
        arrays: list[Any] = []
        for axis, first, last in ((0, 0, bounds[0]), (1, *bounds), (0, bounds[1], len(kinds))):
            turned = [jnp.expand_dims(along[k], axis) for k in range(first, last) if k in along]
            arrays += [*leaves[first:last], *turned]
        found = as_function(tangent(), n_steps, lanes)(arrays)
        return [x[0] for x in found[len(state) :]]

    def pull(moving: list[int], leaves: list[Any], cotangents: list[Any]) -> list[Any]:
        found = _pulled(adjoint(), leaves, cotangents, bounds, n_steps, lanes)
        order = [k for k, leaf in enumerate(kinds) if leaf.is_moving]
        by_leaf = dict(zip(order, found, strict=True))
        return [by_leaf[k] for k in moving]

    def rule(primals: tuple[list[Any]], tangents: tuple[list[Any]]) -> tuple[list[Any], list[Any]]:
        (leaves,), (along,) = primals, tangents
        moving = [k for k, x in enumerate(along) if not isinstance(x, SymbolicZero)]
        turned = [along[k] for k in moving]
        shapes = tuple(x.shape for x in leaves[bounds[1] :])
        linear = _Linear(
            push=partial(push, moving),
            pull=partial(pull, moving),
            n_leaves=len(leaves),
            shapes=shapes,
        )
        return run(leaves), list(_LINEAR.bind(*leaves, *turned, linear=linear))

    run.defjvp(rule, symbolic_zeros=True)
    return lambda leaves: run([jnp.asarray(x, dtype) for x in leaves])


def outside(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a thread of its own, where no caller's program is being traced."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function, *arguments).result()


class _Linear(NamedTuple):
    """A linear map of tangents at given leaves, and its transpose."""

    push: Callable[[list[Any], list[Any]], list[Any]]
    pull: Callable[[list[Any], list[Any]], list[Any]]
    n_leaves: int
    shapes: tuple[tuple[int, ...], ...]  # of its results


#: JAX's operation for such maps; its own one for the purpose cannot be batched.
_LINEAR = Primitive("kernel_tangents")
_LINEAR.multiple_results = True


def _pushed(*args: Any, linear: _Linear) -> list[Any]:
    return linear.push(list(args[: linear.n_leaves]), list(args[linear.n_leaves :]))


def _abstract(*args: Any, linear: _Linear) -> list[Any]:
    return [jax.core.ShapedArray(x, args[0].dtype) for x in linear.shapes]


def _turned_back(cotangents: list[Any], *args: Any, linear: _Linear) -> list[Any]:
    """Transpose: nothing for the leaves, and for tangents that are none."""
    leaves, tangents = args[: linear.n_leaves], args[linear.n_leaves :]
    given = [ad.instantiate_zeros(x) for x in cotangents]
    shapes = tuple(t.aval.shape if ad.is_undefined_primal(t) else t.shape for t in tangents)
    back = linear._replace(push=linear.pull, pull=linear.push, shapes=shapes)
    found = _LINEAR.bind(*leaves, *given, linear=back)
    kept = [x if ad.is_undefined_primal(t) else None for x, t in zip(found, tangents, strict=True)]
    return [*[None] * len(leaves), *kept]


def _no_second(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(
        "kernels have first derivatives only; for second ones, take jaxmodel.simulate"
    )


def _one_by_one(args: Any, axes: Any, *, linear: _Linear) -> Any:
    """Batching: one after the other, as for the kernel itself."""
    wide = [jnp.moveaxis(x, k, 0) for x, k in zip(args, axes, strict=True) if k is not None]

    def one(row: list[Any]) -> list[Any]:
        rest = iter(row)
        own = [x if k is None else next(rest) for x, k in zip(args, axes, strict=True)]
        return list(_LINEAR.bind(*own, linear=linear))

    found = jax.lax.map(one, wide)
    return found, [0] * len(found)


_LINEAR.def_impl(_pushed)
_LINEAR.def_abstract_eval(_abstract)
ad.primitive_jvps[_LINEAR] = _no_second
ad.primitive_transposes[_LINEAR] = _turned_back
batching.primitive_batchers[_LINEAR] = _one_by_one
mlir.register_lowering(_LINEAR, mlir.lower_fun(_pushed, multiple_results=True))


def _still(leaves: Sequence[Any]) -> list[Any]:
    """The same leaves without tangents."""
    return [x._replace(is_moving=False) if isinstance(x, InputLeaf) else x for x in leaves]


def _pulled(
    adjoint: Adjoint,
    leaves: list[Any],
    cotangents: list[Any],
    bounds: tuple[int, int],
    n_steps: int,
    lanes: int,
) -> list[Any]:
    """Cotangents of the moving leaves from those of the last state, piece by piece."""
    constants, inputs = leaves[: bounds[0]], leaves[bounds[0] : bounds[1]]
    length = _piece(n_steps, 8 * adjoint.kept * lanes)
    forward = as_function(adjoint.forward, length, lanes)
    backward = as_function(adjoint.backward, length, lanes)
    n_state = len(adjoint.forward.leaves["state"])
    rows = [x.reshape(-1, length, *x.shape[1:]) for x in inputs]

    def ahead(state: list[Any], row: list[Any]) -> tuple[list[Any], list[Any]]:
        return forward([*constants, *row, *state])[:n_state], state

    def back(turned: list[Any], piece: tuple[list[Any], list[Any]]) -> tuple[list[Any], list[Any]]:
        row, state = piece
        record = forward([*constants, *row, *state])[n_state]
        found = backward([*constants, *row, record, *turned])
        return found[: len(turned)], found[len(turned) :]

    starts = jax.lax.scan(ahead, leaves[bounds[1] :], rows)[1]
    sums = [jnp.zeros((*x.shape, lanes)) for x in adjoint.backward.leaves["state"][n_state:]]
    turned, by_input = jax.lax.scan(back, [*cotangents, *sums], (rows, starts), reverse=True)
    by_input = [x.reshape(n_steps, *x.shape[2:]) for x in by_input]
    return [*turned[n_state:], *by_input, *turned[:n_state]]


def _piece(n_steps: int, row: int) -> int:
    """Samples of a piece: the most that divide the run and whose record stays in the cache."""
    whole = (k for k in range(1, n_steps + 1) if n_steps % k == 0)
    return max(k for k in whole if k == 1 or k * row <= RECORD)


def _registered(loop: TracedLoop, n_steps: int, lanes: int) -> str:
    """Name under which XLA knows the handler of a loop's kernel, the same in every process."""
    key = f"{loop.text()} {n_steps} {lanes} {native.this_processor()}"
    name = f"flexlink_{hashlib.sha256(key.encode()).hexdigest()[:24]}"
    with _REGISTERING:
        if name not in _HANDLERS:
            _HANDLERS[name] = _register(name, loop, n_steps, lanes)
    return name


def _register(name: str, loop: TracedLoop, n_steps: int, lanes: int) -> tuple[Any, Kernel]:
    """Make a handler known to XLA; returns what keeps it alive."""
    kernel = build_kernel(loop)
    if lanes % kernel.width:
        raise ValueError(f"lanes = {lanes}; allowed: multiples of {kernel.width}")
    counts = [len(loop.leaves.get(x, ())) for x in ("constant", "input", "state", "record")]
    text = _handler(kernel, counts[0] + counts[1], counts[2] + counts[3], n_steps, lanes)
    processor = native.this_processor()
    engine = native.load_code(native.machine_code(text, processor, 0), processor)
    pointer = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    address = engine.get_function_address("handler")
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(pointer(address)), platform="cpu")
    return engine, kernel


def _handler(kernel: Kernel, n_given: int, n_results: int, n_steps: int, lanes: int) -> str:
    """LLVM's text of `handler(frame)`, which returns no error.

    Args:
        kernel: what it calls.
        n_given: arrays that are read only.
        n_results: state, which begins as the arguments after those, and records.
        n_steps, lanes: as in `as_function`.
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
