"""Executors: how the cases of a chunk are run. All call the same physics.

- `kernels.KernelExecutor`: the traced kernel on all cores; needs the extra `fast`.
- `kernels.GpuExecutor`: the same on Nvidia GPUs.
- `scan.ScanExecutor`: `lax.scan` compiled by XLA; everywhere, and the reference.

`make_executor` selects the fastest one that can do the job.
"""

from __future__ import annotations

import numpy as np

from jaxmodel.case import Case, Structure
from studies.config import processor
from studies.engine.kernel_executor import GpuExecutor, KernelExecutor
from studies.engine.plan import Layout
from studies.engine.program import Executor
from studies.engine.runs import uncontrolled
from studies.engine.scan import ScanExecutor
from studies.engine.steps import fits_kernel
from studies.kernels import native
from studies.kernels.gpu import is_known
from studies.kernels.llvm import is_available


def make_executor(structure: Structure, layout: Layout, has_own_ratio: bool) -> Executor:
    """The fastest executor for a group.

    Args:
        structure: of the group.
        layout: of its chunks.
        has_own_ratio: gain ratios come from an uncontrolled pass for some cases.
    """
    kernels: dict[str, type[Executor]] = {"cpu": KernelExecutor, "cuda": GpuExecutor}
    fastest = kernels.get(processor(), ScanExecutor) if fits_kernel(structure) else ScanExecutor
    return fastest(structure, layout, has_own_ratio)


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
