"""Compile time in this process, and a cache folder of LLVM's machine code.

JAX caches its compiled programs in a folder itself (`studies.config`); the kernels of
`studies.kernels.cpu` are kept there too, under the hash of their code, compiler and processor, and
with a code that only the user's key makes: what others put there is not run.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import jax

from studies.config import cache_folder
from studies.errors import StudyError
from studies.publish import replacing
from studies.reading import open_regular, read_bytes

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
    """Machine code of one module, or whatever else is kept."""

    def __init__(self, kind: str, *names: str) -> None:
        """
        Args:
            kind: of `studies.cache.KINDS`.
            names: everything the machine code depends on.
        """
        folder = cache_folder()
        name = hashlib.sha256("\0".join(names).encode()).hexdigest()
        self._path = Path(folder) / f"{kind}-{name}" if folder else None
        self._key = _key(Path(folder)) if folder else b""

    def take(self) -> bytes | None:
        """The code, None if it is not there, damaged or not of this user."""
        if self._path is None or not self._key:
            return None
        try:
            digest, code = read_bytes(self._path).split(b"\n", 1)
        except (OSError, ValueError):
            return None
        return code if hmac.compare_digest(digest, self._digest(code)) else None

    def keep(self, code: bytes) -> None:
        """Write it; the cache only saves time, so an unwritable folder is not an error."""
        if self._path is None or not self._key:
            return
        try:
            with replacing(self._path) as temporary:
                temporary.write_bytes(self._digest(code) + b"\n" + code)
        except StudyError:
            pass

    def _digest(self, code: bytes) -> bytes:
        assert self._path is not None
        return hmac.new(self._key, self._path.name.encode() + code, "sha256").hexdigest().encode()


#: Name of the key's file, and its length [bytes].
_KEY, _KEY_BYTES = "key", 32


@cache
def _key(folder: Path) -> bytes:
    """The user's key of a cache folder, made if missing; b"" if there can be none."""
    path = folder / _KEY
    try:
        if not (key := _read_key(path)):
            path.unlink(missing_ok=True)
            _make_key(path)
            key = _read_key(path)
    except OSError:
        return b""
    return key


def _read_key(path: Path) -> bytes:
    """The key, b"" if there is none that only this user can read and write."""
    try:
        with open_regular(path) as file:
            about, key = os.fstat(file.fileno()), file.read(_KEY_BYTES + 1)
    except FileNotFoundError:
        return b""
    is_private = about.st_uid == os.getuid() and not about.st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    return key if is_private and len(key) == _KEY_BYTES else b""


def _make_key(path: Path) -> None:
    """Write a new key, whole; another process may be faster."""
    temporary = path.with_name(f".{_KEY}.{secrets.token_hex(4)}.tmp")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_bytes(_KEY_BYTES))
        os.link(temporary, path)
    except FileExistsError:
        pass
    finally:
        temporary.unlink(missing_ok=True)
