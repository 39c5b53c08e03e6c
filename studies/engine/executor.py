"""Executors: how the cases of a chunk are run. All call the same physics.

- `kernels.KernelExecutor`: the traced kernel on all cores; needs the extra `fast`.
- `kernels.GpuExecutor`: the same on Nvidia GPUs.
- `scan.ScanExecutor`: `lax.scan` compiled by XLA; everywhere, and the reference.

`make_executor` selects the fastest one that can do the job.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from jaxmodel.case import Case, Structure, uncontrolled
from studies.config import processor
from studies.engine.kernel_executor import GpuExecutor, KernelExecutor
from studies.engine.plan import Layout
from studies.engine.program import Executor, Running
from studies.engine.scan import ScanExecutor
from studies.engine.steps import fits_kernel
from studies.errors import NoKernelError
from studies.kernels import native
from studies.kernels.gpu import is_known
from studies.kernels.llvm import is_available

_Make = Callable[[Structure, Layout, bool], Executor]


def make_executor(structure: Structure, layout: Layout, has_own_ratio: bool) -> Executor:
    """The fastest executor for a group.

    Args:
        structure: of the group.
        layout: of its chunks.
        has_own_ratio: gain ratios come from an uncontrolled pass for some cases.
    """
    kernels: dict[str, _Make] = {"cpu": KernelExecutor, "cuda": GpuExecutor}
    kernel = kernels.get(processor()) if fits_kernel(structure) else None
    if kernel is None:
        return ScanExecutor(structure, layout, has_own_ratio)
    return KernelOrScan(kernel, structure, layout, has_own_ratio)


class KernelOrScan:
    """A kernel; XLA's scan from the first chunk on if the group has none, and `name` says why."""

    def __init__(
        self, kernel: _Make, structure: Structure, layout: Layout, has_own_ratio: bool
    ) -> None:
        """
        Args:
            kernel: makes the executor to try.
            structure, layout, has_own_ratio: as for `make_executor`.
        """
        self.structure = structure
        self._scan = partial(ScanExecutor, structure, layout, has_own_ratio)
        self._chosen, self._reason = kernel(structure, layout, has_own_ratio), ""

    @property
    def name(self) -> str:
        return self._chosen.name + (f" ({self._reason})" if self._reason else "")

    @property
    def compile_time(self) -> float:
        return self._chosen.compile_time

    @compile_time.setter
    def compile_time(self, seconds: float) -> None:
        self._chosen.compile_time = seconds

    def start(self, cases: Case) -> Running:
        started = time.perf_counter()
        try:
            return self._chosen.start(cases)
        except NoKernelError as error:
            self._reason = str(error)
            self._chosen = self._scan()
            lost = time.perf_counter() - started
            running = self._chosen.start(cases)
            self.compile_time += lost
            return running


def executor_text() -> str:
    """What sweeps run with here, in words."""
    if not is_available():
        return "XLA scan; the traced kernel, several times faster, needs the extra 'fast'"
    if processor() == "cpu":
        return f"traced kernel, vectors of {native.this_processor().vector_bytes} bytes"
    if processor() == "cuda" and is_known():
        return "GPU kernel; never run on a device so far: a sweep's first cases also run on the CPU"
    return "XLA scan"


def own_ratios(executor: Executor, cases: Case) -> np.ndarray:
    """EMC ratios of the cases' own uncontrolled runs, (size, 3, C)."""
    return np.asarray(executor.start(uncontrolled(cases)).wait().metrics.energy_ratio)
