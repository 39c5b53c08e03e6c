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
from jaxmodel.simulate import Result, Start, begin, conclude
from studies import kernel
from studies.runs import uncontrolled, with_ratio
from studies.sweeps.plan import Layout

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
    fits = structure.substeps <= KERNEL_SUBSTEPS and not structure.is_smooth
    if kernel.is_available() and fits and jax.default_backend() == "cpu":
        return KernelExecutor(structure, layout, has_own_ratio)
    return ScanExecutor(structure, layout, has_own_ratio)


def own_ratios(executor: Executor, cases: Case) -> np.ndarray:
    """EMC ratios of the cases' own uncontrolled runs, (size, 3, C)."""
    return np.asarray(executor.start(uncontrolled(cases)).wait().energy_ratio)


class _Split(NamedTuple):
    """Leaves of a Case, those that vary apart from those that all cases share."""

    tree: Any
    is_varying: tuple[bool, ...]
    varying: list[np.ndarray]  # cases first
    shared: list[np.ndarray]


def _split(cases: Case, layout: Layout, structure: Structure, has_own_ratio: bool) -> _Split:
    if has_own_ratio:  # the same program for both passes, which differ in ratios and links
        shape = (layout.size, 3, structure.n_controlled)
        cases = with_ratio(cases, np.broadcast_to(cases.control.ratio, shape))
        links = np.broadcast_to(cases.control.link_mask, shape[:2])
        cases = cases._replace(control=cases.control._replace(link_mask=links))
    leaves, tree = jax.tree.flatten(cases)
    leaves = [np.asarray(leaf) for leaf in leaves]
    is_varying = tuple(len(leaf) == layout.size for leaf in leaves)
    return _Split(
        tree,
        is_varying,
        [leaf for leaf, varies in zip(leaves, is_varying, strict=True) if varies],
        [leaf[0] for leaf, varies in zip(leaves, is_varying, strict=True) if not varies],
    )


def _joined(tree: Any, is_varying: tuple[bool, ...], varying: list, shared: list) -> Case:
    sources = {True: iter(varying), False: iter(shared)}
    return jax.tree.unflatten(tree, [next(sources[varies]) for varies in is_varying])


# --- before and after the steps, for both executors ----------------------------------------------


class _Program(NamedTuple):
    """What a compiled program depends on; hashable."""

    structure: Structure
    layout: Layout
    tree: Any  # of a Case
    is_varying: tuple[bool, ...]


class _Parts(NamedTuple):
    """A Start leaf by leaf: which leaves vary from case to case, and their shapes."""

    tree: Any
    is_varying: tuple[bool, ...]
    shapes: tuple[tuple[int, ...], ...]  # of one case


def _begin(program: _Program, own: list, common: list) -> Start:
    return begin(program.structure, _joined(program.tree, program.is_varying, own, common))


def _chosen(program: _Program, parts: _Parts, wanted: bool, own: list, common: list) -> list:
    leaves = jax.tree.leaves(_begin(program, own, common))
    return [x for x, varies in zip(leaves, parts.is_varying, strict=True) if varies == wanted]


@partial(jax.jit, static_argnums=(0, 1))
def _prepare(program: _Program, parts: _Parts, own: list, common: list) -> list:
    """The leaves that vary, lanes last."""
    chosen = partial(_chosen, program, parts, True)
    return jax.vmap(chosen, (0, None), -1)(own, common)


@partial(jax.jit, static_argnums=(0, 1))
def _prepare_shared(program: _Program, parts: _Parts, own: list, common: list) -> list:
    """The others, of any one case."""
    return _chosen(program, parts, False, own, common)


def _find_parts(program: _Program, own: list, common: list) -> _Parts:
    traced, shapes = jax.make_jaxpr(partial(_begin, program), return_shape=True)(own, common)
    is_varying = _dependence(traced.jaxpr, len(own))
    sizes = tuple(out.aval.shape for out in traced.jaxpr.outvars)
    return _Parts(jax.tree.structure(shapes), is_varying, sizes)


def _dependence(jaxpr: Any, n_varying: int) -> tuple[bool, ...]:
    """Which results depend on the first `n_varying` arguments."""
    depends: set[Any] = set(jaxpr.invars[:n_varying])
    for equation in jaxpr.eqns:
        if any(not hasattr(atom, "val") and atom in depends for atom in equation.invars):
            depends.update(equation.outvars)
    return tuple(not hasattr(out, "val") and out in depends for out in jaxpr.outvars)


@jax.jit
@partial(jax.vmap, in_axes=(-1, -1, -1))
def _conclude(outline: Any, code: Any, state: Any) -> Result:
    return conclude(outline, code, state)


# --- XLA ------------------------------------------------------------------------------------------


@partial(jax.jit, static_argnums=(0, 1))
def _run(program: _Program, parts: _Parts, varying: list, shared: list) -> Result:
    """Results of a chunk; what its cases share is computed once for all."""
    layout = program.layout
    TRACES.append(program.structure)

    def block(own: list, common: list) -> Result:
        """Cases side by side in the last axis; XLA fuses little of a step under `vmap`."""
        varies: Start = jax.tree.unflatten(parts.tree, parts.is_varying)
        chosen = jax.vmap(partial(_chosen, program, parts, True), (0, None), -1)(own, common)
        same = _chosen(program, parts, False, [x[0] for x in own], common)
        joined = _joined(parts.tree, parts.is_varying, chosen, [x[..., None] for x in same])
        start: Start = joined  # type: ignore[assignment]

        def whole(x: Any, is_wide: bool) -> Any:
            return x if is_wide else jnp.broadcast_to(x, (*x.shape[:-1], layout.lanes))

        state = jax.tree.map(whole, start.state, varies.state)
        outline = jax.tree.map(whole, start.outline, varies.outline)

        def body(at: State, inputs: Inputs) -> tuple[State, None]:
            return step(program.structure, start.loop, at, inputs)[0], None

        last, _ = jax.lax.scan(body, state, start.inputs)
        return _conclude(outline, state.status, last)

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
        split = _split(cases, self.layout, self.structure, self.has_own_ratio)
        if self._compiled is None:
            program = _Program(self.structure, self.layout, split.tree, split.is_varying)
            started = time.perf_counter()
            parts = _find_parts(program, [leaf[0] for leaf in split.varying], split.shared)
            self._compiled = _run.lower(program, parts, split.varying, split.shared).compile()
            self.compile_time = time.perf_counter() - started
        running = self._compiled(split.varying, split.shared)
        return Running(lambda: jax.tree.map(np.asarray, running), lambda: None)


# --- the traced kernel ----------------------------------------------------------------------------


class _Steps(NamedTuple):
    """Compiled for the numbers that all cases of a group share."""

    parts: _Parts
    shared: list[np.ndarray]  # leaves of a Start that do not vary
    run: kernel.Kernel


_STEPS: dict[tuple, _Steps] = {}
#: Kernels kept in memory.
KEPT_KERNELS = 8


class KernelExecutor:
    """Blocks of lanes on a pool of threads: XLA prepares them, the traced kernel steps them."""

    name = "traced kernel"

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0
        self._steps: _Steps | None = None
        self._pool = ThreadPoolExecutor(layout.devices)

    @property
    def operations(self) -> Counter[str]:
        """Operations of one sample by kind; none before the first chunk."""
        return Counter() if self._steps is None else self._steps.run.operations

    def start(self, cases: Case) -> Running:
        split = _split(cases, self.layout, self.structure, self.has_own_ratio)
        program = _Program(self.structure, self.layout, split.tree, split.is_varying)
        lanes = self.layout.lanes
        blocks = [
            [leaf[k : k + lanes] for leaf in split.varying]
            for k in range(0, self.layout.size, lanes)
        ]
        if self._steps is None:
            started = time.perf_counter()
            self._steps = _steps(program, split)
            _prepare(program, self._steps.parts, blocks[0], split.shared)
            self.compile_time = time.perf_counter() - started
        steps = self._steps
        running = [self._pool.submit(_step_block, program, steps, b, split.shared) for b in blocks]
        return Running(lambda: _concluded(running), lambda: _cancel(running))


def _step_block(
    program: _Program, steps: _Steps, varying: list[np.ndarray], shared: list[np.ndarray]
) -> Start:
    """A Start whose state is that after the last step; state and outline lanes last."""
    lanes, parts = program.layout.lanes, steps.parts
    own = [np.asarray(x, order="C") for x in _prepare(program, parts, varying, shared)]
    start: Start = _joined(parts.tree, parts.is_varying, own, steps.shared)  # type: ignore
    varies: Start = jax.tree.unflatten(parts.tree, parts.is_varying)
    state = jax.tree.map(lambda x, v: _wide(x, v, lanes), start.state, varies.state)
    outline = jax.tree.map(lambda x, v: _wide(x, v, lanes), start.outline, varies.outline)
    code = state.status.copy()
    loop = zip(jax.tree.leaves(start.loop), jax.tree.leaves(varies.loop), strict=True)
    read = [leaf for leaf, is_read in loop if is_read]
    leaves = [*read, *jax.tree.leaves((start.inputs, state))]
    steps.run.run(leaves, program.structure.n_steps, lanes)
    return Start((), code, state, outline)  # type: ignore[arg-type]


def _cancel(running: list[Future]) -> None:
    for future in running:
        future.cancel()


def _concluded(running: list[Future]) -> Result:
    done = [future.result() for future in running]
    whole = jax.tree.map(lambda *x: np.concatenate(x, axis=-1), *done)
    return jax.tree.map(np.asarray, _conclude(whole.outline, whole.inputs, whole.state))


def _wide(x: np.ndarray, is_varying: bool, lanes: int) -> np.ndarray:
    """A copy with one value per lane, lanes last."""
    wide = x if is_varying else np.broadcast_to(np.asarray(x)[..., None], (*np.shape(x), lanes))
    return np.array(wide, order="C", copy=True)


def _steps(program: _Program, split: _Split) -> _Steps:
    """Compile the steps, once per process for the same program and shared numbers."""
    real = jax.dtypes.canonicalize_dtype(np.float64)
    numbers = tuple((leaf.shape, leaf.tobytes()) for leaf in split.shared)
    shapes = tuple(leaf.shape for leaf in split.varying)
    key = (program, shapes, numbers, real)
    if key not in _STEPS:
        while len(_STEPS) >= KEPT_KERNELS:
            del _STEPS[next(iter(_STEPS))]
        one = [leaf[0] for leaf in split.varying]
        parts = _find_parts(program, one, split.shared)
        found = _prepare_shared(program, parts, one, split.shared)
        shared = [np.asarray(leaf, order="C") for leaf in found]
        TRACES.append(program.structure)
        _STEPS[key] = _Steps(parts, shared, _build(program.structure, parts, shared, real))
    return _STEPS[key]


def _build(structure: Structure, parts: _Parts, shared: list[np.ndarray], real: Any) -> Any:
    """The kernel of a structure, with what is shared written into it."""
    leaves = [kernel.Leaf(*x) for x in zip(parts.shapes, parts.is_varying, strict=True)]
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
        [kernel.Leaf(leaf.shape[1:], leaf.is_varying) for leaf in inputs],
        [kernel.Leaf(leaf.shape, True) for leaf in state],
        real,
    )
