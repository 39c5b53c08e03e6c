"""One call for everything that `studies bench` measures."""

from __future__ import annotations

from typing import Any

from studies.bench.gradients import bench_gradients
from studies.bench.works import bench_runs
from studies.errors import field_error
from studies.kernels.cpu import full_effort
from studies.result import Result
from studies.results.labelled import Labelled, told
from studies.show.listing import Rows
from studies.show.report import Report

#: Most cases per chunk.
MOST = 2**20


class Benchmark(Labelled, Result, command="bench", version=3):
    """What `studies bench --json` prints: speed and memory on this machine."""

    figures: dict[str, Any] = told("by name, with its unit")

    def report(self) -> Report:
        parts = ((name, x if isinstance(x, dict) else {"": x}) for name, x in self.figures.items())
        rows = [[f"{name} {y}".strip(), str(z)] for name, x in parts for y, z in x.items()]
        return Report("Benchmark", [], "", "", [Rows(["figure", "value"], rows)], [], {})


def benchmarked(work: str, executor: str, batch: int) -> Benchmark:
    """Measure; arguments and errors as `studies bench`."""
    if not 0 <= batch <= MOST:
        raise field_error("--batch", batch, f"0 to {MOST}", "1")
    with full_effort():
        if work == "grad":
            return Benchmark(bench_gradients(executor, batch))
        return Benchmark(bench_runs(work or "W1", executor, batch))
