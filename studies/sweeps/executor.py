"""Executors: how the cases of a chunk are run. All call the same physics.

- `KernelExecutor`: the traced kernel of `studies.kernel` on all cores; CPU, needs the extra `fast`.
- `ScanExecutor`: `lax.scan` under vmap, compiled by XLA; everywhere, and the reference.

`make_executor` takes the fastest one that can do the job.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxmodel.case import Case, Structure
from jaxmodel.loop import step
from jaxmodel.simulate import Result, Start, begin, conclude, simulate
from studies import kernel
from studies.runs import uncontrolled, with_ratio
from studies.sweeps.plan import Layout

#: How often a program was traced in this process; the tests count compilations with it.
TRACES: list[Structure] = []
#: More plant steps in a sample than this would make the kernel's code too long.
KERNEL_SUBSTEPS = 4


class Executor(Protocol):
    """Runs chunks of one group."""

    name: str
    compile_time: float  # [s], 0 before the first chunk

    def start(self, cases: Case) -> Callable[[], Result]:
        """Start a chunk; calling what is returned waits for its result (NumPy arrays).

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
    return np.asarray(executor.start(uncontrolled(cases))().energy_ratio)


class _Split(NamedTuple):
    """Leaves of a Case, those that vary apart from those that all cases share."""

    tree: Any
    is_varying: tuple[bool, ...]
    varying: list[np.ndarray]  # cases first
    shared: list[np.ndarray]


def _split(cases: Case, layout: Layout, structure: Structure, has_own_ratio: bool) -> _Split:
    if has_own_ratio:  # the same program for both passes
        shape = (layout.size, 3, structure.n_controlled)
        cases = with_ratio(cases, np.broadcast_to(cases.control.ratio, shape))
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


# --- XLA ------------------------------------------------------------------------------------------


class _Program(NamedTuple):
    """What a compiled program depends on; hashable."""

    structure: Structure
    layout: Layout
    tree: Any  # of a Case
    is_varying: tuple[bool, ...]


@partial(jax.jit, static_argnums=0)
def _run(program: _Program, varying: list, shared: list) -> Result:
    """Results of a chunk; what its cases share goes in unbatched and is computed once for all."""
    layout = program.layout
    TRACES.append(program.structure)

    def one(own: list, common: list) -> Result:
        return simulate(program.structure, _joined(program.tree, program.is_varying, own, common))

    def device(own: list, common: list) -> Result:
        blocks = [x.reshape((layout.blocks, layout.lanes, *x.shape[1:])) for x in own]
        done = jax.lax.map(lambda lanes: jax.vmap(one, (0, None))(lanes, common), blocks)
        return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), done)

    devices = np.array(jax.local_devices()[: layout.devices])
    each, same = PartitionSpec("cases"), PartitionSpec()
    return jax.shard_map(
        device, mesh=Mesh(devices, ("cases",)), in_specs=(each, same), out_specs=each,
        check_vma=False,
    )(varying, shared)  # fmt: skip


class ScanExecutor:
    """The reference step in a scan, vectorised over lanes and sharded over devices by XLA."""

    name = "XLA scan"

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0
        self._compiled: Any = None

    def start(self, cases: Case) -> Callable[[], Result]:
        split = _split(cases, self.layout, self.structure, self.has_own_ratio)
        if self._compiled is None:
            program = _Program(self.structure, self.layout, split.tree, split.is_varying)
            started = time.perf_counter()
            self._compiled = _run.lower(program, split.varying, split.shared).compile()
            self.compile_time = time.perf_counter() - started
        running = self._compiled(split.varying, split.shared)
        return lambda: jax.tree.map(np.asarray, running)


# --- the traced kernel ----------------------------------------------------------------------------


class _Stages(NamedTuple):
    """Compiled parts of a run: what comes before the steps, the steps, what comes after."""

    tree: Any  # of a Start
    is_varying: tuple[bool, ...]  # per leaf of a Start
    shared: Callable[[list, list], list]  # leaves of a Start that all cases share
    varying: Callable[[list, list], list]  # the others, lanes last
    steps: kernel.Kernel
    conclude: Callable[..., Result]


_STAGES: dict[tuple, _Stages] = {}


class KernelExecutor:
    """Blocks of lanes on a pool of threads: XLA prepares them, the traced kernel steps them."""

    name = "traced kernel"

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0
        self._stages: _Stages | None = None
        self._shared: list[np.ndarray] | None = None
        self._pool = ThreadPoolExecutor(layout.devices)

    def start(self, cases: Case) -> Callable[[], Result]:
        split = _split(cases, self.layout, self.structure, self.has_own_ratio)
        lanes = self.layout.lanes
        blocks = [
            [leaf[k : k + lanes] for leaf in split.varying]
            for k in range(0, self.layout.size, lanes)
        ]
        if self._stages is None:
            started = time.perf_counter()
            self._stages = _stages(self.structure, lanes, split, blocks[0])
            one = [leaf[0] for leaf in blocks[0]]
            found = self._stages.shared(one, split.shared)
            self._shared = [np.asarray(leaf, order="C") for leaf in found]
            self.compile_time = time.perf_counter() - started
        running = [self._pool.submit(self._block, block, split.shared) for block in blocks]
        return lambda: self._result(running)

    def _block(self, varying: list[np.ndarray], shared: list[np.ndarray]) -> Start:
        """A Start whose state is that after the last step; every leaf of the state lanes last."""
        stages, lanes = self._stages, self.layout.lanes
        assert stages is not None and self._shared is not None
        own = [np.asarray(leaf, order="C") for leaf in stages.varying(varying, shared)]
        start: Start = _joined(stages.tree, stages.is_varying, own, self._shared)  # type: ignore
        varies: Start = jax.tree.unflatten(stages.tree, stages.is_varying)
        state = jax.tree.map(lambda x, v: _wide(x, v, lanes), start.state, varies.state)
        outline = jax.tree.map(lambda x, v: _wide(x, v, lanes), start.outline, varies.outline)
        code = state.status.copy()
        leaves = jax.tree.leaves((start.loop, start.inputs, state))
        stages.steps.run(leaves, self.structure.n_steps, lanes)
        return Start((), code, state, outline)  # type: ignore[arg-type]

    def _result(self, running: list[Future]) -> Result:
        done = [future.result() for future in running]
        whole = jax.tree.map(lambda *x: np.concatenate(x, axis=-1), *done)
        assert self._stages is not None
        return jax.tree.map(
            np.asarray, self._stages.conclude(whole.outline, whole.inputs, whole.state)
        )


def _wide(x: np.ndarray, is_varying: bool, lanes: int) -> np.ndarray:
    """A copy with one value per lane, lanes last."""
    wide = x if is_varying else np.broadcast_to(np.asarray(x)[..., None], (*np.shape(x), lanes))
    return np.array(wide, order="C", copy=True)


def _stages(structure: Structure, lanes: int, split: _Split, block: list[np.ndarray]) -> _Stages:
    """Compile everything for a structure, once per process."""
    shapes = tuple(np.shape(leaf) for leaf in (*block, *split.shared))
    key = (structure, lanes, split.tree, split.is_varying, shapes, jax.config.jax_enable_x64)  # type: ignore[attr-defined]
    if key not in _STAGES:
        TRACES.append(structure)
        _STAGES[key] = _compile_stages(structure, split)
    return _STAGES[key]


def _compile_stages(structure: Structure, split: _Split) -> _Stages:
    def whole(own: list, common: list) -> Start:
        return begin(structure, _joined(split.tree, split.is_varying, own, common))

    one = [leaf[0] for leaf in split.varying]
    traced, shapes = jax.make_jaxpr(whole, return_shape=True)(one, split.shared)
    is_varying = _dependence(traced.jaxpr, len(one))
    tree = jax.tree.structure(shapes)

    def chosen(own: list, common: list, wanted: bool) -> list:
        leaves = jax.tree.leaves(whole(own, common))
        return [x for x, varies in zip(leaves, is_varying, strict=True) if varies == wanted]

    shared = jax.jit(partial(chosen, wanted=False))
    varying = jax.jit(jax.vmap(partial(chosen, wanted=True), (0, None), -1))
    parts: Start = jax.tree.unflatten(
        tree,
        [
            kernel.Leaf(out.aval.shape, varies)
            for out, varies in zip(traced.jaxpr.outvars, is_varying, strict=True)
        ],
    )
    is_leaf = partial(_is_instance, kernel.Leaf)
    trees = [jax.tree.structure(part, is_leaf=is_leaf) for part in parts[:3]]
    loop, inputs, state = (jax.tree.leaves(part, is_leaf=is_leaf) for part in parts[:3])

    def sample(constants: list, row: list, carried: list) -> list:
        args = (
            jax.tree.unflatten(t, x) for t, x in zip(trees, (constants, row, carried), strict=True)
        )
        at_loop, at_inputs, at_state = args
        return jax.tree.leaves(step(structure, at_loop, at_state, at_inputs)[0])

    steps = kernel.build_kernel(
        sample,
        loop,
        [kernel.Leaf(leaf.shape[1:], leaf.is_varying) for leaf in inputs],
        [kernel.Leaf(leaf.shape, True) for leaf in state],
        jax.dtypes.canonicalize_dtype(np.float64),
    )
    return _Stages(
        tree, is_varying, shared, varying, steps, jax.jit(jax.vmap(conclude, (-1, -1, -1)))
    )


def _is_instance(kind: type, x: object) -> bool:
    return isinstance(x, kind)


def _dependence(jaxpr: Any, n_varying: int) -> tuple[bool, ...]:
    """Which results depend on the first `n_varying` arguments."""
    depends: set[Any] = set(jaxpr.invars[:n_varying])
    for equation in jaxpr.eqns:
        if any(not hasattr(atom, "val") and atom in depends for atom in equation.invars):
            depends.update(equation.outvars)
    return tuple(not hasattr(out, "val") and out in depends for out in jaxpr.outvars)
