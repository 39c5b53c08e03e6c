"""Elementwise steps over lanes as traced kernels, in programs that are kept with them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.steps import Steps, scan_steps
from studies.config import device_now, is_keeping, processor
from studies.engine.plan import lane_unit
from studies.engine.programs import kept_data, program, quick_options
from studies.errors import NoKernelError, warn_of_scan
from studies.kernels import bridge, gpu, llvm
from studies.kernels.differentiable import LoopCall, outside
from studies.kernels.traced import InputLeaf, trace_loop

#: Programs kept in memory; one thread makes them.
KEPT = 16
_PROGRAMS: dict[str, Callable[[Any], Any]] = {}
_MAKING = Lock()


def fastest_steps(calls: list[LoopCall]) -> Steps:
    """Steps as kernels of the device that programs are compiled for, a scan where it has none.

    Args:
        calls: where every call of a kernel is noted.
    """
    kind: type[LoopCall] = bridge.CpuCall if device_now().platform == "cpu" else gpu.GpuCall
    is_known = bridge.is_available() if kind is bridge.CpuCall else processor() == "cuda"
    return partial(kernel_steps, kind, calls) if llvm.is_available() and is_known else scan_steps


def kernel_steps(
    kind: type[LoopCall],
    calls: list[LoopCall],
    step: Callable[..., Any],
    constants: Any,
    inputs: Any,
    state: Any,
    n_steps: int,
) -> Any:
    """See `jaxmodel.steps.Steps`.

    Args:
        kind: of calls, for cores or a GPU.
        calls: where every one is noted.
        step, constants, inputs, state, n_steps: as there.
    """
    call = _call_of(kind, step, constants, inputs, state, n_steps)
    calls.append(call)
    leaves, tree = jax.tree.flatten(state)
    lanes = leaves[0].shape[-1]

    def filled(x: Any) -> Any:
        x, more = jnp.asarray(x, call.dtype), call.lanes - lanes
        width = [(0, 0)] * (x.ndim - 1) + [(0, more)]
        return jnp.pad(x, width, mode="edge") if more else x

    rows = [filled(x) if x.ndim > 1 else x for x in jax.tree.leaves(inputs)]
    arrays = [*map(filled, jax.tree.leaves(constants)), *rows, *map(filled, leaves)]
    return jax.tree.unflatten(tree, [x[..., :lanes] for x in call(arrays)])


def _call_of(
    kind: type[LoopCall],
    step: Callable[..., Any],
    constants: Any,
    inputs: Any,
    state: Any,
    n_steps: int,
) -> LoopCall:
    parts = [jax.tree.flatten(part) for part in (constants, inputs, state)]
    (given, _), (rows, _), (first, _) = parts
    dtype, lanes = jax.dtypes.canonicalize_dtype(np.float64), first[0].shape[-1]
    varies = tuple(x.ndim > 1 for x in rows)
    trees = tuple(part[1] for part in parts)
    shapes = tuple(tuple(x.shape[:-1] for x in part) for part in (given, first))

    def flat(*leaves: list[Any]) -> list[Any]:
        return jax.tree.leaves(step(*map(jax.tree.unflatten, trees, leaves)))

    def make() -> Any:
        constant, own = ([InputLeaf(shape, True) for shape in part] for part in shapes)
        row = [InputLeaf((), is_wide) for is_wide in varies]
        # for cores functions called more than once compile in a third of the time
        return outside(trace_loop, flat, constant, row, own, dtype, 0, kind is bridge.CpuCall)

    return kind(
        name=f"{step.__name__} {dtype} {trees[0]} {shapes} {varies}",
        make=make,
        n_given=len(given) + len(rows),
        state=shapes[1],
        records=(),
        dtype=dtype,
        n_steps=n_steps,
        lanes=lanes + -lanes % lane_unit(),
    )


def program_of_steps(
    function: Callable[..., Any], names: list[Any], example: Any
) -> Callable[[Any], Any]:
    """`_program_of_steps`, made once in this process."""
    shapes = jax.tree.map(jnp.shape, example)
    key = repr((function.__qualname__, names, shapes, is_keeping()))
    with _MAKING:
        if key not in _PROGRAMS:
            while len(_PROGRAMS) >= KEPT:
                del _PROGRAMS[next(iter(_PROGRAMS))]
            _PROGRAMS[key] = _program_of_steps(function, names, example)
        return _PROGRAMS[key]


def _program_of_steps(
    function: Callable[..., Any], names: list[Any], example: Any
) -> Callable[[Any], Any]:
    """The program of `function(*names, steps, example)`, whose kernels are those of the cores.

    Args:
        function: of a module; its last arguments are `steps` and what varies.
        names: its other arguments, by which the program is known.
        example: of what varies.

    Returns:
        A function of the latter, whose results are there when it returns.
    """
    calls: list[Any] = []
    steps = fastest_steps(calls)
    if steps is scan_steps:
        return _compiled(function, names, example, steps)

    def trace() -> list[Any]:
        """The calls of kernels, of which none is made."""
        found = []

        def noted(*given: Any) -> Any:
            found.append(_call_of(bridge.CpuCall, *given))
            return given[3]

        jax.eval_shape(partial(function, *names, noted), example)
        return found

    def facts() -> list[Any]:
        return [replace(call, make=_nothing) for call in trace()]

    def made(name: str) -> Any:
        return next(call.make() for call in trace() if call.name == name)

    try:
        if is_keeping():  # a program from disk is not traced, so nothing else makes its kernels
            shapes = str(jax.tree.map(jnp.shape, example))
            known = ["kernels of", function.__qualname__, *names, shapes]
            for call in kept_data(known, facts, function.__module__):
                calls.append(replace(call, make=partial(made, call.name)))
                calls[-1].kernel()
        run = _compiled(function, names, example, steps)
    except NoKernelError as error:
        warn_of_scan(error)
        return _compiled(function, names, example, scan_steps)
    kernels = {call.target: call.kernel() for call in calls}

    def timed(given: Any) -> Any:
        began = time.perf_counter()
        result = jax.block_until_ready(run(given))
        for kernel in kernels.values():  # those that run for long are compiled better
            kernel.note_run((time.perf_counter() - began) / len(kernels))
        return result

    return timed


def _nothing() -> Any:
    raise NotImplementedError


def _compiled(
    function: Callable[..., Any], names: list[Any], example: Any, steps: Any
) -> Callable[[Any], Any]:
    options = None if steps is scan_steps else quick_options()

    def lower() -> Any:
        whole = jax.jit(partial(function, *names, steps), compiler_options=options)
        return whole.lower(example)

    kind = "scan" if steps is scan_steps else "kernels"
    known = [function.__qualname__, kind, *names]
    run: Callable[[Any], Any] = program(known, [example], lower, function.__module__)
    return run
