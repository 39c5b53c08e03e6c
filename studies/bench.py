"""`studies bench`: how fast and how large, on this machine."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from studies.sweeps.plan import peak_memory
from studies.sweeps.results import load
from studies.sweeps.run import run_sweep
from studies.sweeps.spec import parse_sweep

#: A sweep of very short runs: ten samples of a released link, so that the engine itself is timed.
SHORT_RUNS: dict[str, Any] = {
    "title": "benchmark of the sweep engine",
    "run": {"duration": 1e-3},
    "link": {"modes": 1},
    "control": {"modes": 1},
    "motion": {"waypoints": [[0.0, 0.0, 0.5235987755982988]]},
    "shaper": {"kind": "none"},
    "initial": {"modal": [[1e-6], [1e-6], [1e-6]]},
    "metrics": {"residual_length": 1e-3},
    "sweep": {
        "method": "sobol",
        "metrics": ["residual_rms"],
        "axes": {
            "gain": {"from": 0.1, "to": 1.0},
            "drive.kp": {"from": 1e4, "to": 4e4},
            "link.damping_ratio": {"from": 0.001, "to": 0.05},
        },
    },
}


def bench_sweep(cases: int, console: Console) -> dict[str, Any]:
    """Time and peak memory of a sweep of very short runs, chunk files and joining included.

    Args:
        cases: how many.
        console: where progress goes.
    """
    data = SHORT_RUNS | {"sweep": SHORT_RUNS["sweep"] | {"count": cases}}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "sweep"
        done = run_sweep(parse_sweep(data), out, console=console)
        size = sum(file.stat().st_size for file in out.rglob("*.h5"))
        rms = load(out)["residual_rms"]
    return {
        "work": "sweep",
        "executor": "XLA scan",
        "cases": done.n_run,
        "configs_per_s": round(done.n_run / done.run_time, 1),
        "run_s": round(done.run_time, 2),
        "compile_s": round(done.compile_time, 2),
        "peak_mib": round(peak_memory() / 2**20, 1),
        "file_mib": round(size / 2**20, 1),
        "device": str(jax.devices()[0].device_kind),
        "dtype": str(rms.dtype),
        "steps": 10,
        "fingerprint": float(np.mean(rms)),
    }
