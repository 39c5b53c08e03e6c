"""Speed of differentiating metrics by parameters."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case
from jaxmodel.parameters import Array
from studies import config
from studies.bench.works import build_work, check_executor, describe, make_layout, timed
from studies.engine.executor import Executor


def place_gains(case: Case, parameters: Array) -> Case:
    """A case with the velocity gains of its modes, relative to those of the links, (9,)."""
    control = case.control
    ratio = parameters.reshape(control.ratio.shape)
    return case._replace(control=control._replace(ratio=ratio))


def bench_gradients(executor: str = "", batch: int = 0) -> dict[str, Any]:
    """Gradients per second of the residual rms of W0 by its nine gains.

    Args:
        executor: key of STEPPERS; "" for the fastest available.
        batch: cases per chunk; 0: two blocks of lanes on every device.

    Returns:
        Figures by name; the fingerprint is the norm of the mean gradient.

    Raises:
        StudyError: unknown executor, or one that is not installed.
    """
    check_executor(executor)
    config.require_configured()
    layout = make_layout(batch)
    structure, cases = build_work("W0", layout)
    random = np.random.default_rng(1)
    ratio = np.asarray(cases.control.ratio).reshape(1, -1)
    parameters = ratio * random.uniform(0.5, 2.0, (layout.size, ratio.size))
    stepper = Executor(structure, layout, place=place_gains, kind=executor)

    def gradients() -> np.ndarray:
        runs = stepper.differentiate(cases, parameters)
        by = jax.tree.map(lambda x: np.ones((1, *x.shape)), runs.result.metrics)
        return runs.pull_back(by)[0]

    by_case, timing = timed(gradients)
    gradient = by_case.mean(axis=0)
    return {
        "work": "grad",
        "executor": stepper.name,
        "parameters": ratio.size,
        **describe(layout, structure, timing, gradient.dtype),
        "fingerprint": float(np.linalg.norm(gradient)),
    }
