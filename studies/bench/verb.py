"""The command `studies bench`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.bench.run import Benchmark


@verb
def bench(work: str = "", *, executor: str = "", batch: int = 0, cases: int = 0) -> Benchmark:
    """Measure speed and memory on this machine.

    Args:
        work: W0, W1, W8, grad or sweep; default: W1.
        executor: kernel, scan or gpu; default: the fastest.
        batch: cases per chunk; 0: automatic.
        cases: in the sweep; 0: 100,000.

    Raises:
        StudyError: an unknown option, or one that has no effect.
    """
    from studies.bench.run import benchmarked

    return benchmarked(work, executor, batch, cases)
