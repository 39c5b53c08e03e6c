"""Metrics of a chunk and their derivatives by parameters of each case.

Forward mode: tangents are carried along with the state, so all metrics are differentiated in one
pass, no step is stored, and the kernel of `studies.kernels` can do it.

- `KernelGradients`: the traced kernel, `DIRECTIONS` tangents at once.
- `ScanGradients`: `jax.jvp` of the reference; everywhere.
- `reverse_gradients`: one number's gradient by reverse mode, whose cost does not grow with the
  parameters; `is_forward_cheaper` says when it pays off (docs/performance.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.metrics import Metrics
from jaxmodel.parameters import Array
from jaxmodel.simulate import Result, Start, simulate
from studies.config import processor
from studies.engine.plan import Layout
from studies.engine.program import (
    TRACES,
    Place,
    Program,
    Split,
    conclude_slopes,
    joined,
    lane_blocks,
    prepare,
    prepare_tangents,
    split_cases,
)
from studies.engine.steps import Ready, Steps, compile_steps, fits_kernel, start_block

#: Tangents per pass of the kernel. More of them share the state's own arithmetic (1: 31 gradients/s
#: by 9 numbers on a core, 3: 49) but take longer to compile (3 s, 5 s).
DIRECTIONS = 3
#: Number of parameters from which reverse mode costs less than forward mode, by executor.
REVERSE_FROM = {"traced kernel": 48, "XLA scan": 3}


class ChunkSlopes(NamedTuple):
    """A chunk and its derivatives; NumPy arrays."""

    result: Result  # cases first
    metrics: Metrics  # derivatives, (cases, p, ...); 0 if a run did not finish


class Gradients(Protocol):
    """Differentiates chunks of one group."""

    name: str
    compile_time: float  # [s], 0 before the first chunk

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> ChunkSlopes:
        """Run a chunk.

        Args:
            cases: `layout.size` of them; fields set by the parameters are overwritten.
            parameters: (layout.size, p).
            is_used: requested derivatives; others can be anything, (layout.size, p).
        """
        ...


def make_gradients(structure: Structure, layout: Layout, place: Place) -> Gradients:
    """The fastest way to differentiate a group's metrics by a few parameters.

    Args:
        structure: of the group.
        layout: of its chunks.
        place: puts parameters into a case.
    """
    if processor() == "cpu" and fits_kernel(structure):
        return KernelGradients(structure, layout, place)
    return ScanGradients(structure, layout, place)


def is_forward_cheaper(n_parameters: int, executor: str) -> bool:
    """Whether forward mode computes one number's gradient faster than reverse mode.

    Args:
        n_parameters: p.
        executor: name of the forward-mode executor.
    """
    return n_parameters < REVERSE_FROM[executor]


def _split(cases: Case, parameters: np.ndarray, layout: Layout, structure: Structure) -> Split:
    split = split_cases(cases, layout, structure, False)
    real = jax.dtypes.canonicalize_dtype(np.float64)
    return split._replace(varying=[*split.varying, np.asarray(parameters, real)])


def _program(made: KernelGradients | ScanGradients, split: Split) -> Program:
    """What gradients are taken of."""
    return Program(
        structure=made.structure,
        layout=made.layout,
        tree=split.tree,
        is_varying=split.is_varying,
        place=made.place,
    )


class KernelGradients:
    """Blocks of lanes on a pool of threads, each stepped once for every few directions."""

    name = "traced kernel"

    def __init__(self, structure: Structure, layout: Layout, place: Place) -> None:
        self.structure, self.layout, self.place = structure, layout, place
        self.compile_time = 0.0
        self._steps: Steps | None = None
        self._pool = ThreadPoolExecutor(layout.devices)

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> ChunkSlopes:
        split = _split(cases, parameters, self.layout, self.structure)
        program = _program(self, split)
        blocks = lane_blocks(split, self.layout)
        if self._steps is None:
            started = time.perf_counter()
            self._steps = compile_steps(program, split, min(DIRECTIONS, parameters.shape[1]))
            given = program, self._steps.parts, blocks[0], split.shared
            prepare(*given)
            prepare_tangents(*given, np.eye(self._steps.directions, parameters.shape[1]))
            self.compile_time = time.perf_counter() - started
        one = partial(_slopes, program, self._steps, shared=split.shared)
        used = np.ones_like(parameters, bool) if is_used is None else is_used
        done = list(self._pool.map(one, blocks, np.split(used, len(blocks))))
        whole = jax.tree.map(lambda *x: np.concatenate(x, axis=-1), *done)
        return ChunkSlopes(*jax.tree.map(np.asarray, conclude_slopes(*whole)))


def _slopes(
    program: Program, steps: Steps, block: list[Any], used: Array, shared: list[Any]
) -> tuple[Any, ...]:
    """(outline, status at the start, last state, tangents of outline and state), lanes last."""
    ready, n = start_block(program, steps, block, shared), block[-1].shape[1]
    passes = [k for k in range(0, n, steps.directions) if used[:, k : k + steps.directions].any()]
    slope, turn, state = (_zeros(n, x) for x in (ready.state, ready.outline, ready.state))
    for k in passes or [0]:
        state = jax.tree.map(np.copy, ready.state)
        outline, along = _pass(program, steps, block, shared, ready, state, k)
        for whole, part in ((slope, along), (turn, outline)):
            for x, y in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
                x[k : k + steps.directions] = y[: n - k]
    return ready.outline, ready.state.status, state, turn, slope


def _pass(
    program: Program,
    steps: Steps,
    block: list[Any],
    shared: list[Any],
    ready: Ready,
    state: Any,
    k: int,
) -> tuple[Any, ...]:
    """Step a block once, `state` in place; tangents of outline and state from direction k on."""
    count = steps.directions
    directions = np.eye(count, block[-1].shape[1], k, dtype=block[-1].dtype)
    turning = iter(prepare_tangents(program, steps.parts, block, shared, directions))
    found = [next(turning) if moves else None for moves in steps.parts.is_moving]
    turn: Start = jax.tree.unflatten(steps.parts.tree, [_Tangent(x) for x in found])
    along = jax.tree.map(partial(_filled, count), ready.state, turn.state)
    steps.run.run(
        [
            *ready.loop,
            *_moving(turn.loop),
            *ready.inputs,
            *_by_sample(turn.inputs),
            *jax.tree.leaves(state),
            *jax.tree.leaves(along),
        ],
        program.structure.n_steps,
        program.layout.lanes,
    )
    return jax.tree.map(partial(_filled, count), ready.outline, turn.outline), along


class _Tangent:
    """Tangents of a leaf, or None: a leaf of a tree even if it is None."""

    def __init__(self, array: Any) -> None:
        self.array = None if array is None else np.asarray(array, order="C")


def _zeros(n: int, tree: Any) -> Any:
    return jax.tree.map(lambda x: np.zeros((n, *x.shape), x.dtype), tree)


def _filled(n: int, x: np.ndarray, tangent: _Tangent) -> np.ndarray:
    """Tangents along all directions of a pass, zeros where a leaf does not move."""
    return np.zeros((n, *x.shape), x.dtype) if tangent.array is None else tangent.array.copy()


def _moving(tree: Any) -> list[np.ndarray]:
    found = (tangent.array for tangent in jax.tree.leaves(tree))
    return [array for array in found if array is not None]


def _by_sample(tree: Any) -> list[np.ndarray]:
    """The same for inputs, of which the kernel reads one row per sample."""
    return [np.asarray(x.swapaxes(0, 1), order="C") for x in _moving(tree)]


# --- XLA ------------------------------------------------------------------------------------------


def _metrics(
    program: Program, own: list[Any], common: list[Any], parameters: Array
) -> tuple[Any, ...]:
    case = joined(program.tree, program.is_varying, own, common)
    assert program.place is not None
    result = simulate(program.structure, program.place(case, parameters))
    return result.metrics, result


@partial(jax.jit, static_argnums=0)
def _forward(
    program: Program, own: list[Any], parameters: Array, common: list[Any]
) -> tuple[Any, ...]:
    TRACES.append(program.structure)

    def one(case: tuple[Any, ...]) -> tuple[Any, ...]:
        own, parameters = case

        def along(direction: Array) -> tuple[Any, ...]:
            function = partial(_metrics, program, own, common)
            _, tangent, result = jax.jvp(function, (parameters,), (direction,), has_aux=True)
            return result, tangent

        unit = jnp.eye(parameters.size, dtype=parameters.dtype)
        return jax.vmap(along, out_axes=(None, 0))(unit)

    return jax.lax.map(one, (own, parameters), batch_size=program.layout.lanes)


class ScanGradients:
    """Forward mode through the reference, one block of lanes after another."""

    name = "XLA scan"

    def __init__(self, structure: Structure, layout: Layout, place: Place) -> None:
        self.structure, self.layout, self.place = structure, layout, place
        self.compile_time = 0.0
        self._compiled: Any = None

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> ChunkSlopes:
        split = _split(cases, parameters, self.layout, self.structure)
        *own, parameters = split.varying
        if self._compiled is None:
            program = _program(self, split)
            started = time.perf_counter()
            self._compiled = _forward.lower(program, own, parameters, split.shared).compile()
            self.compile_time = time.perf_counter() - started
        return ChunkSlopes(*jax.tree.map(np.asarray, self._compiled(own, parameters, split.shared)))


@partial(jax.jit, static_argnums=(0, 1, 2))
def reverse_gradients(
    structure: Structure,
    place: Place,
    objective: Callable[..., Any],
    cases: Case,
    parameters: Array,
) -> tuple[Array, Array]:
    """An objective and its gradients by reverse mode with checkpoints.

    Args:
        structure: with `is_smooth`, which keeps checkpoints instead of every step.
        place: puts parameters into a case.
        objective: number of a case's Metrics; the same object every time.
        cases: leaves with the cases first.
        parameters: (cases, p).

    Returns:
        (objective (cases,), gradient (cases, p)).
    """

    def value(parameters: Array, case: Case) -> Array:
        return objective(simulate(structure, place(case, parameters)).metrics)

    return jax.vmap(jax.value_and_grad(value))(parameters, cases)
