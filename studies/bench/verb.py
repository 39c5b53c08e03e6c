"""The command `studies bench`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.bench.run import Benchmark


@verb
def bench(work: str = "", *, executor: str = "", batch: int = 0) -> Benchmark:
    """Measure speed and memory on this machine.

    Args:
        work: W0, W1, W8 or grad; default: W1.
        executor: kernel, scan or gpu; default: the fastest.
        batch: cases per chunk; 0: automatic.

    Raises:
        StudyError: an unknown option.
    """
    from studies.bench.run import benchmarked

    return benchmarked(work, executor, batch)
