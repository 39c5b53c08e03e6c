"""How fast metrics are differentiated by parameters."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case
from jaxmodel.parameters import Array
from studies import config, kernel
from studies.bench.works import METRICS, WORKS, check_executor, make_layout, timed
from studies.cases import build_cases, build_structure
from studies.spec import paper_study
from studies.sweeps.gradients import KernelGradients, ScanGradients
from studies.sweeps.plan import peak_memory


def place_gains(case: Case, parameters: Array) -> Case:
    """A case with the velocity gains of its modes, relative to those of the links, (9,)."""
    control = case.control
    ratio = parameters.reshape(control.ratio.shape)
    return case._replace(control=control._replace(ratio=ratio))


def bench_gradients(executor: str = "", batch: int = 0) -> dict[str, Any]:
    """Gradients a second of the residual rms of W0 by its nine gains.

    Args:
        executor: "kernel", "scan", or "" for the fastest one at hand.
        batch: cases in a chunk; 0: two blocks of lanes on every device.

    Returns:
        Figures by name; the fingerprint is the norm of the mean gradient.

    Raises:
        StudyError: unknown executor, or one that is not installed.
    """
    check_executor(executor)
    config.require_configured()
    layout = make_layout(batch)
    study = paper_study().change(**WORKS["W0"])
    structure = build_structure(study)._replace(metrics=METRICS["W0"])
    random = np.random.default_rng(0)
    factors = random.uniform(0.01, 0.5, layout.size)
    cases = build_cases(study, {"control.gain_factor": factors}, structure)
    ratio = np.asarray(cases.control.ratio).reshape(1, -1)
    parameters = ratio * random.uniform(0.5, 2.0, (layout.size, ratio.size))
    is_kernel = kernel.is_available() if not executor else executor == "kernel"
    made = (KernelGradients if is_kernel else ScanGradients)(structure, layout, place_gains)
    found, timing = timed(lambda: made.evaluate(cases, parameters))
    gradient = found.metrics.residual_rms.mean((0, 2, 3))
    return {
        "work": "grad",
        "executor": f"{made.name}, forward",
        "configs_per_s": round(layout.size / timing.seconds, 1),
        "parameters": ratio.size,
        "ns_per_step": round(1e9 * timing.seconds / layout.size / structure.n_steps, 1),
        "compile_s": round(timing.compile_time, 2),
        "trace_s": round(timing.trace_time, 2),
        "peak_mib": round(peak_memory() / 2**20, 1),
        "device": f"{layout.devices} x {jax.local_devices()[0].device_kind}",
        "dtype": str(found.metrics.residual_rms.dtype),
        "batch": layout.size,
        "steps": structure.n_steps,
        "fingerprint": float(np.linalg.norm(gradient)),
    }
