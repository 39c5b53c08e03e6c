"""One call for everything that `studies bench` measures."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from studies.bench.gradients import bench_gradients
from studies.bench.works import bench_runs, bench_sweep
from studies.errors import StudyError
from studies.kernels.cpu import full_effort
from studies.results.labelled import Labelled, told

#: Cases of the work `sweep`.
SWEEP_CASES = 100_000


class Benchmark(Labelled, command="bench", version=3):
    """What `studies bench --json` prints: speed and memory on this machine."""

    figures: dict[str, Any] = told("by name, with its unit")


def run_bench(
    work: str = "",
    executor: str = "",
    batch: int = 0,
    cases: int = 0,
    console: Console | None = None,
) -> Benchmark:
    """Measure speed and memory on this machine.

    Args:
        work: W0, W1, W8, grad or sweep; "": W1.
        executor: kernel, scan or gpu; "": the fastest.
        batch: cases per chunk; 0: automatic.
        cases: of the work `sweep`; 0: `SWEEP_CASES`.
        console: where progress goes; default: standard error.

    Raises:
        StudyError: an unknown option, or one that has no effect.
    """
    _check(work, executor, batch, cases)
    console = console or Console(stderr=True, highlight=False, markup=False)
    if work == "sweep":
        return Benchmark(bench_sweep(cases or SWEEP_CASES, console))
    with full_effort():
        if work == "grad":
            return Benchmark(bench_gradients(executor, batch))
        return Benchmark(bench_runs(work or "W1", executor, batch))


def _check(work: str, executor: str, batch: int, cases: int) -> None:
    """Reject options that have no effect."""
    if work == "sweep":
        options, reason = {"--executor": executor, "--batch": batch}, "with --work sweep"
    else:
        options, reason = {"--cases": cases}, "but with --work sweep"
    for name, value in options.items():
        if value:
            raise StudyError(f"{name} {value}: not allowed {reason}; leave it out")
