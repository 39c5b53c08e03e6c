"""Elementwise steps over lanes, as traced kernels if available, otherwise in XLA's scan."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from threading import Lock
from typing import Any

import jax
import numpy as np

from studies.config import on_host
from studies.engine.plan import lane_unit
from studies.errors import NoKernelError, warn_of_scan
from studies.kernels import cpu
from studies.kernels.llvm import is_available
from studies.kernels.traced import InputLeaf, TracedLoop, trace_loop

#: Lanes that XLA compiles for.
BLOCK = 64


def run_steps(
    step: Callable[..., Any], constants: Any, inputs: Any, state: Any, n_steps: int
) -> Any:
    """Run all steps; arrays have lanes last, inputs also have steps first.

    Args:
        step: maps (constants, inputs of one step, state) to state; a module-level function.
        constants: what no step changes.
        inputs: of each step; those shared by all lanes have one axis.
        state: before the first step.
        n_steps: how many.

    Returns:
        State after the last one.
    """
    lanes = jax.tree.leaves(state)[0].shape[-1]
    if lanes == 0:
        return state
    parts = [jax.tree.flatten(part) for part in (constants, inputs, state)]
    varies = tuple(leaf.ndim > 1 for leaf in parts[1][0])
    with _TRACING:
        run = _runner(
            step,
            tuple(tree for _, tree in parts),
            tuple(leaf.shape[:-1] for leaf in parts[0][0]),
            varies,
            tuple(leaf.shape[:-1] for leaf in parts[2][0]),
        )
    # whole vectors; whole blocks for XLA, which compiles each size separately
    more = -lanes % (lane_unit() if is_available() else BLOCK)

    def filled(x: Any, is_wide: bool = True) -> np.ndarray:
        x = np.asarray(x)
        if is_wide and more:
            x = np.concatenate([x, np.repeat(x[..., -1:], more, axis=-1)], axis=-1)
        return np.array(x, order="C", copy=True)

    leaves = [
        *map(filled, parts[0][0]),
        *(filled(x, is_wide) for x, is_wide in zip(parts[1][0], varies, strict=True)),
        *map(filled, parts[2][0]),
    ]
    last = run(leaves, n_steps, lanes + more)
    return jax.tree.unflatten(parts[2][1], [x[..., :lanes] for x in last])


#: One thread builds a kernel, others wait for it.
_TRACING = Lock()


@lru_cache(maxsize=32)
def _runner(
    step: Callable[..., Any],
    trees: tuple[Any, ...],
    constants: tuple[Any, ...],
    varies: tuple[Any, ...],
    state: tuple[Any, ...],
) -> Callable[[list[Any], int, int], list[Any]]:
    """Runs the step on leaves of constants, inputs and state."""
    sizes = len(constants), len(varies), len(state)

    def flat(*parts: list[Any]) -> list[Any]:
        return jax.tree.leaves(step(*map(jax.tree.unflatten, trees, parts)))

    if is_available():
        real = jax.dtypes.canonicalize_dtype(np.float64)

        def make() -> TracedLoop:
            return trace_loop(
                flat,
                [InputLeaf(shape, True) for shape in constants],
                [InputLeaf((), is_wide) for is_wide in varies],
                [InputLeaf(shape, True) for shape in state],
                real,
                has_routines=True,  # compiles in a third of the time
            )

        name = f"{step.__name__} {real} {trees[0]} {constants} {varies} {state}"

        def run(kernel: cpu.Kernel, leaves: list[Any], n_steps: int, lanes: int) -> list[Any]:
            kernel.run(leaves, n_steps, lanes)
            return leaves[sizes[0] + sizes[1] :]

        try:
            return partial(run, cpu.kept_kernel(name, make))
        except NoKernelError as error:
            warn_of_scan(error)

    @partial(jax.jit, static_argnums=3)
    def scanned(
        constants: list[Any], inputs: list[Any], state: list[Any], n_steps: int
    ) -> list[Any]:
        def body(at: list[Any], row: list[Any] | None) -> tuple[list[Any], None]:
            return flat(constants, row or [], at), None

        return jax.lax.scan(body, state, inputs or None, length=n_steps)[0]

    def run_scan(leaves: list[Any], n_steps: int, lanes: int) -> list[Any]:
        constants, inputs = leaves[: sizes[0]], leaves[sizes[0] : sizes[0] + sizes[1]]
        with on_host():
            return list(map(np.asarray, scanned(constants, inputs, leaves[-sizes[2] :], n_steps)))

    return run_scan
