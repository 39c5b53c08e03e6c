"""One call for everything that `studies bench` measures."""

from __future__ import annotations

from typing import Any

from studies.bench.gradients import bench_gradients
from studies.bench.works import bench_runs, bench_sweep
from studies.errors import StudyError, field_error
from studies.kernels.cpu import full_effort
from studies.result import Result
from studies.results.labelled import Labelled, told
from studies.show.listing import Rows
from studies.show.report import Report

#: Cases of the work `sweep`.
SWEEP_CASES = 100_000
#: Most cases per chunk.
MOST = 2**20


class Benchmark(Labelled, Result, command="bench", version=3):
    """What `studies bench --json` prints: speed and memory on this machine."""

    figures: dict[str, Any] = told("by name, with its unit")

    def report(self) -> Report:
        parts = ((name, x if isinstance(x, dict) else {"": x}) for name, x in self.figures.items())
        rows = [[f"{name} {y}".strip(), str(z)] for name, x in parts for y, z in x.items()]
        return Report("Benchmark", [], "", "", [Rows(["figure", "value"], rows)], [], {})


def benchmarked(work: str, executor: str, batch: int, cases: int) -> Benchmark:
    """Measure; arguments and errors as `studies bench`."""
    _check(work, executor, batch, cases)
    if work == "sweep":
        return Benchmark(bench_sweep(cases or SWEEP_CASES))
    with full_effort():
        if work == "grad":
            return Benchmark(bench_gradients(executor, batch))
        return Benchmark(bench_runs(work or "W1", executor, batch))


def _check(work: str, executor: str, batch: int, cases: int) -> None:
    """Reject options out of range, or without an effect."""
    ranges = ("--batch", batch, MOST), ("--cases", cases, SWEEP_CASES * MOST)
    for name, number, most in ranges:
        if not 0 <= number <= most:
            raise field_error(name, number, f"0 to {most}", "1")
    if work == "sweep":
        options, reason = {"--executor": executor, "--batch": batch}, "with --work sweep"
    else:
        options, reason = {"--cases": cases}, "but with --work sweep"
    for name, value in options.items():
        if value:
            raise StudyError(f"{name} {value}: not allowed {reason}; leave it out")
