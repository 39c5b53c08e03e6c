"""Executors with traced kernels: XLA prepares and judges the cases, the kernel steps them."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.simulate import Result, Start
from studies.engine.plan import Layout
from studies.engine.program import (
    Program,
    Running,
    Split,
    StartParts,
    begin_block,
    conclude_all,
    lane_blocks,
    split_cases,
)
from studies.engine.steps import (
    Steps,
    Traced,
    compile_steps,
    read_leaves,
    start_block,
    trace_steps,
)
from studies.errors import NoKernelError
from studies.kernels import cpu, gpu


class KernelExecutor:
    """Blocks of lanes on a pool of threads."""

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
            start_block(program, self._steps, blocks[0], split.shared)
            self.compile_time = time.perf_counter() - started
        steps = self._steps
        running = [self._pool.submit(_step_block, program, steps, b, split.shared) for b in blocks]
        return Running(lambda: _concluded(running), lambda: _cancel(running))


def _step_block(
    program: Program, steps: Steps, varying: list[np.ndarray], shared: list[np.ndarray]
) -> Start:
    """A Start with the state after the last step; state and outline lanes last."""
    ready = start_block(program, steps, varying, shared)
    code = ready.state.status.copy()
    leaves = [*ready.loop, *ready.inputs, *jax.tree.leaves(ready.state)]
    steps.run.run(leaves, program.structure.n_steps, program.layout.lanes)
    return Start((), code, ready.state, ready.outline)  # type: ignore[arg-type]


def _cancel(running: list[Future[Any]]) -> None:
    for future in running:
        future.cancel()


def _concluded(running: list[Future[Any]]) -> Result:
    done = [future.result() for future in running]
    whole = jax.tree.map(lambda *x: np.concatenate(x, axis=-1), *done)
    return jax.tree.map(np.asarray, conclude_all(whole.outline, whole.inputs, whole.state))


# --- GPUs ----------------------------------------------------------------------------------------

#: Largest difference from the CPU, as a share of the largest value.
TOLERANCE = {8: 1e-6, 4: 1e-2}


class GpuExecutor:
    """Blocks of lanes on GPUs, one thread per case.

    The first cases of the first chunk also run on the CPU; the kernel must give the same.
    """

    name = "GPU kernel"

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0
        self._run: Any = None

    def start(self, cases: Case) -> Running:
        split = split_cases(cases, self.layout, self.structure, self.has_own_ratio)
        blocks = lane_blocks(split, self.layout)
        if self._run is None:
            started = time.perf_counter()
            program = Program(self.structure, self.layout, split.tree, split.is_varying)
            self._build(program, split, blocks[0])
            self.compile_time = time.perf_counter() - started
        devices = jax.local_devices()[: self.layout.devices]
        launched = [
            self._run(*jax.device_put((block, split.shared), devices[k % len(devices)])).result
            for k, block in enumerate(blocks)
        ]
        return Running(lambda: _gathered(launched), lambda: None)

    def _build(self, program: Program, split: Split, block: list[Any]) -> None:
        """Build the program.

        Raises:
            NoKernelError: it cannot be used, or its results are wrong.
        """
        if not gpu.is_known():
            raise NoKernelError(
                f"the GPU kernel is known to run with jaxlib {gpu.KNOWN} only, this is {gpu.JAXLIB}"
            )
        try:
            traced = trace_steps(program, split)
            if traced.loop.operations()["tanh"]:
                raise NoKernelError("the GPU kernel does not support tanh, which friction needs")
            kernel = gpu.build_kernel(traced.loop, program.structure.n_steps, program.layout.lanes)
            run = jax.jit(partial(_run_block, program, traced.parts, kernel))
            first = run(block, split.shared)
            jax.block_until_ready(first)
        except RuntimeError as error:  # from JAX, LLVM or the tracer
            raise NoKernelError(f"the GPU kernel failed: {str(error).splitlines()[0]}") from error
        difference = _difference(traced, first, program.structure.n_steps)
        if difference > TOLERANCE[traced.loop.dtype.itemsize]:
            raise NoKernelError(
                f"the GPU kernel differs by {difference:.1g} from the same on the CPU"
            )
        self._run = run


class CaseBlock(NamedTuple):
    """A block of cases after its last sample, and the initial values of a few of them."""

    result: Result
    given: list[Any]  # leaves as the kernel reads them, the first lanes
    last: list[Any]  # leaves of their state after the last sample


def _run_block(
    program: Program, parts: StartParts, kernel: Any, own: list[Any], common: list[Any]
) -> CaseBlock:
    start = begin_block(program, parts, own, common)
    leaves = [
        *read_leaves(start, parts),
        *jax.tree.leaves(start.inputs),
        *jax.tree.leaves(start.state),
    ]
    last = kernel(leaves)
    state = jax.tree.unflatten(jax.tree.structure(start.state), last)
    few = cpu.LANE_BYTES // last[0].dtype.itemsize
    return CaseBlock(
        conclude_all(start.outline, start.state.status, state),
        [x[..., :few] for x in leaves],
        [x[..., :few] for x in last],
    )


def _difference(traced: Traced, block: CaseBlock, n_steps: int) -> float:
    """Largest difference of a block's first cases from the CPU, as a share of the largest value."""
    given = [np.array(x, order="C") for x in block.given]
    cpu.build_kernel(traced.loop).run(given, n_steps, block.last[0].shape[-1])
    worst = 0.0
    for a, b in zip(block.last, given[len(given) - len(block.last) :], strict=True):
        if not np.array_equal(np.isnan(a), np.isnan(b)):
            return np.inf
        size = np.nanmax(np.abs(b), initial=1e-300)
        worst = max(worst, float(np.nanmax(np.abs(np.asarray(a) - b), initial=0.0) / size))
    return worst


def _gathered(running: list[Result]) -> Result:
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(part) for part in x]), *running)
