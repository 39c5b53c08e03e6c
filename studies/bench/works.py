"""Workloads, and their speed in this program."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.metrics import METRICS as ALL
from jaxmodel.numbers import in_working_precision
from jaxmodel.simulate import RunResult
from studies import config
from studies.engine.executor import Executor
from studies.engine.function import STEPPERS
from studies.engine.plan import Layout, even_layout, most_lanes, peak_memory
from studies.errors import StudyError, field_error
from studies.kernels.compilation import compiler_time
from studies.kernels.llvm import is_available
from studies.reference.tables import BARE
from studies.study.cases import build_structure
from studies.study.numbers import build_cases
from studies.study.spec import paper_study

#: Workloads of closed-loop runs, 0.8 s at 10 kHz, by their differences from the paper's study.
WORKS: dict[str, dict[str, Any]] = {
    # PD drive, ideal modal velocity feedback, unshaped square, residual rms only
    "W0": BARE
    | {
        "link__modes": 3,
        "link__static_correction": False,
        "control__feedback": "ideal",
        "shaper__kind": "none",
    },
    # the default sampled design with all metrics, 3 and 8 modes per link
    "W1": BARE | {"link__modes": 3},
    "W8": BARE | {"link__modes": 8},
    # W1 with patches as they are: the default plant
    "W1p": {"link__modes": 3},
}
#: Metrics they accumulate, others all that there were first, so that their times compare.
METRICS = dict.fromkeys(WORKS, tuple(name for name in ALL if name != "patch_strain_peak"))
METRICS["W0"] = ("residual_rms",)
#: Number of runs; the median counts.
REPEATS = 5


def check_executor(executor: str) -> None:
    """Reject an executor that is unknown or cannot run here.

    Args:
        executor: key of STEPPERS, or "".

    Raises:
        StudyError: if so.
    """
    if executor and executor not in STEPPERS:
        raise field_error("--executor", executor, ", ".join(map(repr, STEPPERS)))
    if executor in ("kernel", "gpu") and not is_available():
        raise StudyError(f"--executor {executor}: needs the package llvmlite")
    if executor == "gpu" and config.processor() != "cuda":
        raise StudyError(
            f"--executor gpu: needs an Nvidia graphics processor; JAX computes on "
            f"{config.processor()!r} here"
        )


def make_layout(batch: int) -> Layout:
    """A chunk of about this many cases; 0: two blocks of lanes on every device, one on a GPU."""
    blocks = 2 if config.processor() == "cpu" else 1
    return even_layout(batch or blocks * most_lanes() * len(jax.local_devices()))


def build_work(work: str, layout: Layout, **changes: Any) -> tuple[Structure, Case]:
    """Cases of a workload with different gains.

    Args:
        work: key of WORKS.
        layout: of their chunk.
        changes: of the study.
    """
    study = paper_study().change(**WORKS[work], **changes)
    structure = build_structure(study)._replace(metrics=METRICS.get(work, ()))
    gains = np.random.default_rng(0).uniform(0.01, 0.5, layout.size)
    return structure, build_cases(study, {"control.gain_factor": gains}, structure)


class Timing(NamedTuple):
    """Run and compile times."""

    seconds: float  # median of the later runs
    compile_time: float  # of compilers in the first run [s]
    trace_time: float  # rest of the first run, beyond that and the median [s]


def timed(run: Callable[[], Any], repeats: int | None = None) -> tuple[Any, Timing]:
    """Result and timing of a function that compiles on its first run.

    Args:
        run: what to do.
        repeats: number of runs, of which the median counts; default: REPEATS.
    """
    before, began = compiler_time(), time.perf_counter()
    run()
    first, compiled = time.perf_counter() - began, compiler_time() - before
    times = []
    for _ in range(repeats or REPEATS):
        began = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - began)
    seconds = statistics.median(times)
    return result, Timing(seconds, compiled, max(first - compiled - seconds, 0.0))


def describe(layout: Layout, structure: Structure, timing: Timing, dtype: Any) -> dict[str, Any]:
    """Figures of a chunk by name.

    Args:
        layout, structure: of the chunk.
        timing: of it.
        dtype: of its results.
    """
    return {
        "configs_per_s": round(layout.size / timing.seconds, 1),
        "ns_per_step": round(1e9 * timing.seconds / layout.size / structure.n_steps, 1),
        "compile_s": round(timing.compile_time, 2),
        "trace_s": round(timing.trace_time, 2),
        "peak_mib": round(peak_memory() / 2**20, 1),
        "device": f"{layout.devices} x {jax.local_devices()[0].device_kind}",
        "dtype": str(dtype),
        "batch": layout.size,
        "steps": structure.n_steps,
    }


def bench_runs(work: str, executor: str = "", batch: int = 0) -> dict[str, Any]:
    """Speed of a batch of closed-loop runs with different gains.

    Args:
        work: key of WORKS.
        executor: key of STEPPERS; "" for the fastest available.
        batch: cases per chunk; 0: as `make_layout`.

    Returns:
        Figures by name; configurations per second are for the median run, without compiling.

    Raises:
        StudyError: unknown work or executor, or one that is not installed.
    """
    if work not in WORKS:
        raise field_error("--work", work, ", ".join(map(repr, (*WORKS, "grad"))))
    check_executor(executor)
    config.require_configured()
    layout = make_layout(batch)
    structure, exact = build_work(work, layout)
    real = jax.dtypes.canonicalize_dtype(np.float64)
    cases = in_working_precision(exact)
    stepper = Executor(structure, layout, kind=executor)
    result, timing = timed(lambda: stepper.start(cases).wait())
    rms = result.metrics.residual_rms
    figures: dict[str, Any] = {"work": work, "executor": stepper.name}
    figures |= describe(layout, structure, timing, rms.dtype)
    figures["fingerprint"] = float(np.mean(rms))
    if real != np.float64:
        figures["error"] = _errors(result, structure, layout, exact)
    return figures


def _errors(
    result: RunResult, structure: Structure, layout: Layout, cases: Case
) -> dict[str, float]:
    """Largest error of each metric against double precision, relative to its largest value."""
    jax.config.update("jax_enable_x64", True)  # for all threads, unlike jax.enable_x64
    try:
        reference = Executor(structure, layout, kind="scan").start(cases).wait()
    finally:
        jax.config.update("jax_enable_x64", False)
    return {
        name: float(f"{np.nanmax(np.abs(a - b)) / max(np.nanmax(np.abs(b)), 1e-300):.2g}")
        for name, b in reference.metrics.items()
        for a in [result.metrics[name]]
    }
