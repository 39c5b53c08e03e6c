"""The steps of a group as a traced loop: which numbers it reads, and its code for this processor.

Numbers that all cases of a chunk share are embedded in the code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel.case import Structure
from jaxmodel.loop import State, step
from jaxmodel.simulate import Outline, Start
from studies.engine.program import (
    TRACES,
    Program,
    Split,
    StartParts,
    find_parts,
    joined,
    prepare,
    prepare_shared,
)
from studies.kernels import cpu, llvm, native
from studies.kernels.adjoint import trace_adjoint
from studies.kernels.traced import InputLeaf, TracedLoop, trace_loop

#: More plant steps per sample than this would make the kernel's code too long.
KERNEL_SUBSTEPS = 4


def fits_kernel(structure: Structure) -> bool:
    """Whether a structure can be compiled to a kernel here."""
    return llvm.is_available() and structure.substeps <= KERNEL_SUBSTEPS


class Traced(NamedTuple):
    """The loop of a group of cases, with the numbers they share."""

    parts: StartParts
    shared: list[np.ndarray]  # leaves of a Start that do not vary
    loop: TracedLoop


class Steps(NamedTuple):
    """The same, compiled for this processor."""

    parts: StartParts
    shared: list[np.ndarray]
    run: cpu.Kernel
    directions: int  # tangents carried along


class AdjointSteps(NamedTuple):
    """The steps and their reverse, compiled for this processor (`studies.kernels.adjoint`)."""

    parts: StartParts
    shared: list[np.ndarray]
    forward: cpu.Kernel
    backward: cpu.Kernel
    kept: int  # numbers recorded per sample


_STEPS: dict[tuple[Any, ...], Any] = {}
#: Kernels kept in memory.
KEPT_KERNELS = 8


def compile_steps(program: Program, split: Split, directions: int = 0) -> Steps:
    """Compile the steps, once per process for the same program and shared numbers.

    Args:
        program: of the cases.
        split: their leaves.
        directions: tangents to carry along at once.
    """

    def build() -> Steps:
        # where instructions take numbers from memory only, small code is fast
        has_routines = not native.this_processor().has_masks
        parts, shared, loop = trace_steps(program, split, directions, has_routines)
        return Steps(parts, shared, cpu.build_kernel(loop), directions)

    found: Steps = _once(program, split, directions, build)
    return found


def compile_adjoint(program: Program, split: Split) -> AdjointSteps:
    """Compile the steps and their reverse; arguments as `compile_steps`."""

    def build() -> AdjointSteps:
        parts, shared = start_parts(program, split)
        TRACES.append(program.structure)
        made = trace_adjoint(*given_loop(program.structure, parts, shared), _real())
        forward, backward = map(cpu.build_kernel, made[:2])
        return AdjointSteps(
            parts=parts, shared=shared, forward=forward, backward=backward, kept=made.kept
        )

    found: AdjointSteps = _once(program, split, "adjoint", build)
    return found


def _once(program: Program, split: Split, kind: Any, build: Callable[[], Any]) -> Any:
    """What was built before for the same program and shared numbers, or is now.

    Raises:
        NoKernelError: the steps use what kernels do not support.
    """
    numbers = tuple((leaf.shape, leaf.tobytes()) for leaf in split.shared)
    shapes = tuple(leaf.shape for leaf in split.varying)
    key = (program, shapes, numbers, _real(), kind, native.this_processor())
    if key not in _STEPS:
        while len(_STEPS) >= KEPT_KERNELS:
            del _STEPS[next(iter(_STEPS))]
        _STEPS[key] = build()
    return _STEPS[key]


def trace_steps(
    program: Program, split: Split, directions: int = 0, has_routines: bool = False
) -> Traced:
    """Trace the steps of a group.

    Args:
        program, split, directions: as in `compile_steps`.
    """
    parts, shared = start_parts(program, split)
    TRACES.append(program.structure)
    given = given_loop(program.structure, parts, shared)
    return Traced(parts, shared, trace_loop(*given, _real(), directions, has_routines))


def start_parts(program: Program, split: Split) -> tuple[StartParts, list[np.ndarray]]:
    """Parts of a case's start, and the leaves that all cases share."""
    one = [leaf[0] for leaf in split.varying]
    parts = find_parts(program, one, split.shared)
    found = prepare_shared(program, parts, one, split.shared)
    return parts, [np.asarray(leaf, order="C") for leaf in found]


def _real() -> Any:
    return jax.dtypes.canonicalize_dtype(np.float64)


def given_loop(
    structure: Structure, parts: StartParts, shared: list[np.ndarray]
) -> tuple[Callable[..., Any], list[Any], list[InputLeaf], list[InputLeaf]]:
    """Step, constants, inputs and state of a structure, with shared numbers as known ones."""
    kinds = zip(parts.shapes, parts.is_varying, parts.is_moving, strict=True)
    leaves = [InputLeaf(*kind) for kind in kinds]
    start: Start = jax.tree.unflatten(parts.tree, range(len(leaves)))
    trees = [jax.tree.structure(part) for part in start[:3]]
    known = iter(shared)
    values = [leaf if leaf.is_varying else next(known) for leaf in leaves]
    loop = [values[k] for k in jax.tree.leaves(start.loop)]
    inputs = [leaves[k] for k in jax.tree.leaves(start.inputs)]
    state = [leaves[k] for k in jax.tree.leaves(start.state)]

    def sample(constants: list[Any], row: list[Any], carried: list[Any]) -> list[Any]:
        at_loop, at_inputs, at_state = (
            jax.tree.unflatten(t, x) for t, x in zip(trees, (constants, row, carried), strict=True)
        )
        return jax.tree.leaves(step(structure, at_loop, at_state, at_inputs)[0])

    return (
        sample,
        loop,
        [leaf._replace(shape=leaf.shape[1:]) for leaf in inputs],
        [leaf._replace(is_varying=True) for leaf in state],
    )


class Ready(NamedTuple):
    """A block of lanes before its first step, as the kernel reads it."""

    loop: list[np.ndarray]  # leaves not embedded in the code
    inputs: list[np.ndarray]
    state: State  # a copy, lanes last
    outline: Outline  # lanes last


def start_block(
    program: Program,
    steps: Steps | AdjointSteps,
    varying: list[np.ndarray],
    shared: list[np.ndarray],
) -> Ready:
    """Prepare a block of lanes.

    Args:
        program: of the cases.
        steps: compiled for it.
        varying, shared: leaves of the block's cases.
    """
    lanes, parts = program.layout.lanes, steps.parts
    own = [np.asarray(x, order="C") for x in prepare(program, parts, varying, shared)]
    start: Start = joined(parts.tree, parts.is_varying, own, steps.shared)
    varies: Start = jax.tree.unflatten(parts.tree, parts.is_varying)

    def widened(tree: Any, variation: Any) -> Any:
        return jax.tree.map(lambda x, v: _wide(x, v, lanes), tree, variation)

    return Ready(
        read_leaves(start, parts),
        jax.tree.leaves(start.inputs),
        widened(start.state, varies.state),
        widened(start.outline, varies.outline),
    )


def read_leaves(start: Start, parts: StartParts) -> list[Any]:
    """Leaves of the loop's constants that are not embedded in the code."""
    varies: Start = jax.tree.unflatten(parts.tree, parts.is_varying)
    loop = zip(jax.tree.leaves(start.loop), jax.tree.leaves(varies.loop), strict=True)
    return [leaf for leaf, is_read in loop if is_read]


def _wide(x: np.ndarray, is_varying: bool, lanes: int) -> np.ndarray:
    """A copy with one value per lane, lanes last."""
    whole = x if is_varying else np.broadcast_to(np.asarray(x)[..., None], (*np.shape(x), lanes))
    return np.array(whole, order="C", copy=True)
