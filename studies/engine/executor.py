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


def own_ratios(executor: Executor, cases: Case) -> np.ndarray:
    """EMC ratios of the cases' own uncontrolled runs, (size, 3, C)."""
    return np.asarray(executor.start(uncontrolled(cases)).wait().metrics.energy_ratio)
