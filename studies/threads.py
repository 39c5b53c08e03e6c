"""What the threads of a process share: settings that hold while any of them wants them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

#: Begin of the names of threads that may still compile when a command is interrupted.
COMPILING = "compiling"


class SharedSetting:
    """A setting of the process: the first thread that wants it makes it, the last one ends it."""

    def __init__(self, make: Callable[[], Callable[[], object]]) -> None:
        """make: makes the setting; returns what ends it."""
        self._make, self._lock, self._count = make, Lock(), 0

    @contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if not self._count:
                self._end = self._make()
            self._count += 1
        try:
            yield
        finally:
            with self._lock:
                self._count -= 1
                if not self._count:
                    self._end()


def _limit_blas() -> Callable[[], object]:
    from threadpoolctl import OpenBLASController, threadpool_limits

    def as_any_thread(work: Callable[[], Any]) -> Any:
        # it obeys one thread alone, the first that has called it, as long as that lives
        OpenBLASController.clear_controlling_thread(force=True)
        return work()

    limits = as_any_thread(lambda: threadpool_limits(1, "blas"))
    return lambda: as_any_thread(limits.restore_original_limits)


#: Matrix operations of NumPy, SciPy and JAX's LAPACK on one thread each: more only slow down many
#: small matrices, and those of several threads of Python wait for each other, now and then without
#: end.
serial_blas = SharedSetting(_limit_blas)
