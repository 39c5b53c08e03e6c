"""Executors: how the cases of a chunk are run. All call the same physics.

- `KernelExecutor`: the traced kernel of `studies.kernel` on all cores; CPU, needs the extra `fast`.
- `ScanExecutor`: `lax.scan` compiled by XLA; everywhere, and the reference.

`make_executor` takes the fastest one that can do the job.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxmodel.case import Case, Structure
from jaxmodel.loop import Inputs, State, step
from jaxmodel.simulate import Outline, Result, Start
from studies import kernel
from studies.runs import uncontrolled
from studies.sweeps.plan import Layout
from studies.sweeps.program import (
    Parts,
    Program,
    Split,
    chosen,
    conclude_all,
    find_parts,
    joined,
    lane_blocks,
    prepare,
    prepare_shared,
    split_cases,
)

#: How often a program was traced in this process; the tests count compilations with it.
TRACES: list[Structure] = []
#: More plant steps in a sample than this would make the kernel's code too long.
KERNEL_SUBSTEPS = 4


class Running(NamedTuple):
    """A chunk on its way."""

    wait: Callable[[], Result]  # until it is done; NumPy arrays
    cancel: Callable[[], None]  # give it up, as far as it has not begun


class Executor(Protocol):
    """Runs chunks of one group."""

    name: str
    compile_time: float  # [s], 0 before the first chunk

    def start(self, cases: Case) -> Running:
        """Start a chunk.

        Args:
            cases: from `chunk_cases`, `layout.size` of them.
        """
        ...


def make_executor(structure: Structure, layout: Layout, has_own_ratio: bool) -> Executor:
    """The fastest executor for a group.

    Args:
        structure: of the group.
        layout: of its chunks.
        has_own_ratio: gain ratios come from an uncontrolled pass for some cases.
    """
    if fits_kernel(structure):
        return KernelExecutor(structure, layout, has_own_ratio)
    return ScanExecutor(structure, layout, has_own_ratio)


def fits_kernel(structure: Structure) -> bool:
    """Whether the traced kernel can run a structure here."""
    fits = structure.substeps <= KERNEL_SUBSTEPS and not structure.is_smooth
    return kernel.is_available() and fits and jax.default_backend() == "cpu"


def own_ratios(executor: Executor, cases: Case) -> np.ndarray:
    """EMC ratios of the cases' own uncontrolled runs, (size, 3, C)."""
    return np.asarray(executor.start(uncontrolled(cases)).wait().energy_ratio)


# --- XLA ------------------------------------------------------------------------------------------


@partial(jax.jit, static_argnums=(0, 1))
def _run(program: Program, parts: Parts, varying: list, shared: list) -> Result:
    """Results of a chunk; what its cases share is computed once for all."""
    layout = program.layout
    TRACES.append(program.structure)

    def block(own: list, common: list) -> Result:
        """Cases side by side in the last axis; XLA fuses little of a step under `vmap`."""
        varies: Start = jax.tree.unflatten(parts.tree, parts.is_varying)
        own_parts = jax.vmap(partial(chosen, program, parts, True), (0, None), -1)(own, common)
        same = chosen(program, parts, False, [x[0] for x in own], common)
        shared_parts = [x[..., None] for x in same]
        start: Start = joined(parts.tree, parts.is_varying, own_parts, shared_parts)

        def whole(x: Any, is_wide: bool) -> Any:
            return x if is_wide else jnp.broadcast_to(x, (*x.shape[:-1], layout.lanes))

        state = jax.tree.map(whole, start.state, varies.state)
        outline = jax.tree.map(whole, start.outline, varies.outline)

        def body(at: State, inputs: Inputs) -> tuple[State, None]:
            return step(program.structure, start.loop, at, inputs)[0], None

        last, _ = jax.lax.scan(body, state, start.inputs)
        return conclude_all(outline, state.status, last)

    def device(own: list, common: list) -> Result:
        blocks = [x.reshape((layout.blocks, layout.lanes, *x.shape[1:])) for x in own]
        done = jax.lax.map(lambda lanes: block(lanes, common), blocks)
        return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), done)

    devices = np.array(jax.local_devices()[: layout.devices])
    each, all_same = PartitionSpec("cases"), PartitionSpec()
    return jax.shard_map(
        device, mesh=Mesh(devices, ("cases",)), in_specs=(each, all_same), out_specs=each,
        check_vma=False,
    )(varying, shared)  # fmt: skip


class ScanExecutor:
    """The reference step in a scan, vectorised over lanes and sharded over devices by XLA."""

    name = "XLA scan"

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0
        self._compiled: Any = None

    def start(self, cases: Case) -> Running:
        split = split_cases(cases, self.layout, self.structure, self.has_own_ratio)
        if self._compiled is None:
            program = Program(self.structure, self.layout, split.tree, split.is_varying)
            started = time.perf_counter()
            parts = find_parts(program, [leaf[0] for leaf in split.varying], split.shared)
            self._compiled = _run.lower(program, parts, split.varying, split.shared).compile()
            self.compile_time = time.perf_counter() - started
        running = self._compiled(split.varying, split.shared)
        return Running(lambda: jax.tree.map(np.asarray, running), lambda: None)


# --- the traced kernel ----------------------------------------------------------------------------


class Steps(NamedTuple):
    """Compiled for the numbers that all cases of a group share."""

    parts: Parts
    shared: list[np.ndarray]  # leaves of a Start that do not vary
    run: kernel.Kernel
    directions: int  # tangents that it carries along


_STEPS: dict[tuple, Steps] = {}
#: Kernels kept in memory.
KEPT_KERNELS = 8


class KernelExecutor:
    """Blocks of lanes on a pool of threads: XLA prepares them, the traced kernel steps them."""

    name = "traced kernel"

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0
        self._steps: Steps | None = None
        self._pool = ThreadPoolExecutor(layout.devices)

    @property
    def operations(self) -> Counter[str]:
        """Operations of one sample by kind; none before the first chunk."""
        return Counter() if self._steps is None else self._steps.run.operations

    def start(self, cases: Case) -> Running:
        split = split_cases(cases, self.layout, self.structure, self.has_own_ratio)
        program = Program(self.structure, self.layout, split.tree, split.is_varying)
        blocks = lane_blocks(split, self.layout)
        if self._steps is None:
            started = time.perf_counter()
            self._steps = compile_steps(program, split)
            prepare(program, self._steps.parts, blocks[0], split.shared)
            self.compile_time = time.perf_counter() - started
        steps = self._steps
        running = [self._pool.submit(_step_block, program, steps, b, split.shared) for b in blocks]
        return Running(lambda: _concluded(running), lambda: _cancel(running))


def _step_block(
    program: Program, steps: Steps, varying: list[np.ndarray], shared: list[np.ndarray]
) -> Start:
    """A Start whose state is that after the last step; state and outline lanes last."""
    ready = start_block(program, steps, varying, shared)
    code = ready.state.status.copy()
    leaves = [*ready.loop, *ready.inputs, *jax.tree.leaves(ready.state)]
    steps.run.run(leaves, program.structure.n_steps, program.layout.lanes)
    return Start((), code, ready.state, ready.outline)  # type: ignore[arg-type]


class Ready(NamedTuple):
    """A block of lanes before its first step, as the kernel reads it."""

    loop: list[np.ndarray]  # leaves that are not written into the code
    inputs: list[np.ndarray]
    state: State  # a copy, lanes last
    outline: Outline  # lanes last


def start_block(
    program: Program, steps: Steps, varying: list[np.ndarray], shared: list[np.ndarray]
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

    loop = zip(jax.tree.leaves(start.loop), jax.tree.leaves(varies.loop), strict=True)
    return Ready(
        [leaf for leaf, is_read in loop if is_read],
        jax.tree.leaves(start.inputs),
        widened(start.state, varies.state),
        widened(start.outline, varies.outline),
    )


def _cancel(running: list[Future]) -> None:
    for future in running:
        future.cancel()


def _concluded(running: list[Future]) -> Result:
    done = [future.result() for future in running]
    whole = jax.tree.map(lambda *x: np.concatenate(x, axis=-1), *done)
    return jax.tree.map(np.asarray, conclude_all(whole.outline, whole.inputs, whole.state))


def _wide(x: np.ndarray, is_varying: bool, lanes: int) -> np.ndarray:
    """A copy with one value per lane, lanes last."""
    whole = x if is_varying else np.broadcast_to(np.asarray(x)[..., None], (*np.shape(x), lanes))
    return np.array(whole, order="C", copy=True)


def compile_steps(program: Program, split: Split, directions: int = 0) -> Steps:
    """Compile the steps, once per process for the same program and shared numbers.

    Args:
        program: of the cases.
        split: their leaves.
        directions: tangents to carry along at once.
    """
    real = jax.dtypes.canonicalize_dtype(np.float64)
    numbers = tuple((leaf.shape, leaf.tobytes()) for leaf in split.shared)
    shapes = tuple(leaf.shape for leaf in split.varying)
    key = (program, shapes, numbers, real, directions)
    if key not in _STEPS:
        while len(_STEPS) >= KEPT_KERNELS:
            del _STEPS[next(iter(_STEPS))]
        one = [leaf[0] for leaf in split.varying]
        parts = find_parts(program, one, split.shared)
        found = prepare_shared(program, parts, one, split.shared)
        shared = [np.asarray(leaf, order="C") for leaf in found]
        TRACES.append(program.structure)
        code = _build(program.structure, parts, shared, real, directions)
        _STEPS[key] = Steps(parts, shared, code, directions)
    return _STEPS[key]


def _build(
    structure: Structure, parts: Parts, shared: list[np.ndarray], real: Any, directions: int
) -> Any:
    """The kernel of a structure, with what is shared written into it."""
    kinds = zip(parts.shapes, parts.is_varying, parts.is_moving, strict=True)
    leaves = [kernel.Leaf(*kind) for kind in kinds]
    start: Start = jax.tree.unflatten(parts.tree, range(len(leaves)))
    trees = [jax.tree.structure(part) for part in start[:3]]
    known = iter(shared)
    values = [leaf if leaf.is_varying else next(known) for leaf in leaves]
    loop = [values[k] for k in jax.tree.leaves(start.loop)]
    inputs = [leaves[k] for k in jax.tree.leaves(start.inputs)]
    state = [leaves[k] for k in jax.tree.leaves(start.state)]

    def sample(constants: list, row: list, carried: list) -> list:
        at_loop, at_inputs, at_state = (
            jax.tree.unflatten(t, x) for t, x in zip(trees, (constants, row, carried), strict=True)
        )
        return jax.tree.leaves(step(structure, at_loop, at_state, at_inputs)[0])

    return kernel.build_kernel(
        sample,
        loop,
        [leaf._replace(shape=leaf.shape[1:]) for leaf in inputs],
        [leaf._replace(is_varying=True) for leaf in state],
        real,
        directions,
    )
