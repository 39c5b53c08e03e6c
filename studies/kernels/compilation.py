"""Compile time in this process, and a cache folder of LLVM's machine code.

JAX caches its compiled programs in a folder itself (`studies.config`); the kernels of
`studies.kernels.cpu` are kept there too, under the hash of their code, compiler and processor.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import jax

from studies.config import cache_folder
from studies.errors import StudyError
from studies.store import replacing

#: JAX's name for the time its backend takes to compile, or to find a program in the cache.
_EVENT = "/jax/core/compile/backend_compile_duration"
_spent = [0.0]


def compiler_time() -> float:
    """Seconds that XLA and LLVM have spent compiling in this process since the first call."""
    _listen()
    return _spent[0]


@contextmanager
def compiling() -> Iterator[None]:
    """Count the time inside as compile time."""
    began = time.perf_counter()
    yield
    _spent[0] += time.perf_counter() - began


@cache
def _listen() -> None:
    def heard(event: str, duration_secs: float, **_: Any) -> None:
        if event == _EVENT:
            _spent[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(heard)


class ObjectCache:
    """Machine code of one module."""

    def __init__(self, *names: str) -> None:
        """
        Args:
            names: everything the machine code depends on.
        """
        folder = cache_folder()
        name = hashlib.sha256("\0".join(names).encode()).hexdigest()
        self._path = Path(folder) / f"kernel-{name}" if folder else None

    def take(self) -> bytes | None:
        """The code, None if it is not there or damaged."""
        try:
            digest, code = self._path.read_bytes().split(b"\n", 1) if self._path else (b"", b"")
        except (OSError, ValueError):
            return None
        return code if digest and digest == _digest(code) else None

    def keep(self, code: bytes) -> None:
        """Write it; the cache only saves time, so an unwritable folder is not an error."""
        if self._path is None:
            return
        try:
            with replacing(self._path) as temporary:
                temporary.write_bytes(_digest(code) + b"\n" + code)
        except StudyError:
            pass


def _digest(code: bytes) -> bytes:
    return hashlib.sha256(code).hexdigest().encode()
