"""One thread for NumPy's linear algebra where many small matrices are worked on.

On several threads each of them takes longer, and many times as long beside other processes. The
variable OPENBLAS_NUM_THREADS would do it for a whole process, but only before NumPy is loaded.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np

#: Names of the functions in the OpenBLAS that comes with NumPy, and in others.
_NAMES = (
    "scipy_openblas_{}_num_threads64_", "scipy_openblas_{}_num_threads",
    "openblas_{}_num_threads64_", "openblas_{}_num_threads",
)  # fmt: skip


@contextmanager
def one_thread() -> Iterator[None]:
    """Context with OpenBLAS on one thread; does nothing where NumPy has another library."""
    found = _controls()
    if found is None:
        yield
        return
    get, set_ = found
    before = get()
    set_(1)
    try:
        yield
    finally:
        set_(before)


@cache
def _controls() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Getter and setter of the number of threads, None where there are none to be found."""
    package = Path(np.__file__).parent
    for folder in (package.parent / "numpy.libs", package / ".dylibs"):
        for path in folder.glob("*openblas*"):
            library = ctypes.CDLL(str(path))  # the one that is loaded already
            for name in _NAMES:
                if hasattr(library, name.format("set")):
                    return tuple(getattr(library, name.format(what)) for what in ("get", "set"))
    return None
