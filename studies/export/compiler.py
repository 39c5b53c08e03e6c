"""Exported C code, compiled and callable from Python."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import numpy as np

from studies.errors import StudyError
from studies.export.c_text import Source
from studies.publish import working_folder

#: Flags with which exported code must compile without warnings.
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
_NAMES = ("cc", "gcc", "clang")
_ALLOWED = "allowed: a C99 compiler for this machine, named by the variable CC"
NO_COMPILER = "no C compiler found (the command in the variable CC if it is set, or cc, gcc, clang)"


class Responding(Protocol):
    """Code of a controller, wherever it runs."""

    def respond(self, sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A sequence (T, 3, K) from rest: actuator values (T, 3, K) and faults (T,)."""


class Code(NamedTuple):
    """A compiled controller, with room for its state."""

    library: ctypes.CDLL
    name: str
    real: type  # NumPy's type of sensors and actuators
    reference: type  # and of the shaper
    n_channels: int
    shaper_length: int
    state: ctypes.Array[Any]  # room for the controller's state

    def begin(self) -> None:
        """Reset the state."""
        getattr(self.library, f"{self.name}_init")(self.state)

    def step(self, sensor: np.ndarray) -> tuple[np.ndarray, int]:
        """One sample: actuator values and the fault, from sensor values (3 K,)."""
        inputs: np.ndarray = np.ascontiguousarray(sensor, self.real).ravel()
        out: np.ndarray = np.empty(self.n_channels, self.real)
        fault = getattr(self.library, f"{self.name}_step")(
            self.state, _address(inputs), _address(out)
        )
        return out, fault

    def respond(self, sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A sequence (T, 3, K) from rest: actuator values (T, 3, K) and faults (T,)."""
        self.begin()
        inputs: np.ndarray = np.ascontiguousarray(sensor, self.real)
        values = np.empty_like(inputs)
        step = getattr(self.library, f"{self.name}_step")
        faults = [
            step(self.state, _address(row), _address(out))
            for row, out in zip(inputs, values, strict=True)
        ]
        return values, np.array(faults)

    def shape(self, reference: np.ndarray) -> np.ndarray:
        """A shaped reference (T, p), starting at rest in its first row."""
        room = ctypes.create_string_buffer(self.shaper_length * reference.shape[1] * 8 + 64)
        poses: np.ndarray = np.ascontiguousarray(reference, self.reference)
        getattr(self.library, f"{self.name}_shape_init")(room, _address(poses[0]))
        out = np.empty_like(poses)
        step = getattr(self.library, f"{self.name}_shape_step")
        for row, shaped in zip(poses, out, strict=True):
            step(room, _address(row), _address(shaped))
        return out


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def find_compiler() -> list[str]:
    """Command of a C compiler, from the variable CC or by name; [] if there is none."""
    try:
        custom = shlex.split(os.environ.get("CC", ""))
    except ValueError as error:
        raise StudyError(f"CC = {os.environ['CC']!r}: not a command ({error})") from None
    for command in [custom] if custom else [[name] for name in _NAMES]:
        if shutil.which(command[0]):
            return command
    return []


@contextmanager
def compiled(
    source: Source,
    name: str,
    compiler: list[str],
    real: type,
    reference: type,
    sizes: tuple[Any, ...],
) -> Iterator[Code]:
    """Compile a controller and load it.

    Args:
        source: header and code.
        name: prefix of its functions.
        compiler: command, from `find_compiler`.
        real: NumPy's type of sensors and actuators.
        reference: of the shaper.
        sizes: patches, channels or states, and samples stored by the shaper.

    Raises:
        StudyError: the compiler rejects the code, or does not work.
    """
    n_channels, n_modes, length = sizes
    with library(source, name, compiler, real) as loaded:
        # no state word takes more than 8 bytes
        room = ctypes.create_string_buffer(8 * (3 * n_modes + 2 * n_channels) + 64)
        yield Code(
            library=loaded,
            name=name,
            real=real,
            reference=reference,
            n_channels=n_channels,
            shaper_length=length,
            state=room,
        )


@contextmanager
def library(source: Source, name: str, compiler: list[str], real: type) -> Iterator[ctypes.CDLL]:
    """Compile C code and load it.

    Args:
        source: header and code.
        name: of the files and prefix of functions.
        compiler: command, from `find_compiler`.
        real: NumPy's type of its numbers.

    Raises:
        StudyError: the compiler rejects the code, or does not work.
    """
    with working_folder() as folder:
        header, code, built = (folder / f"{name}{end}" for end in (".h", ".c", ".so"))
        header.write_text(source.header, encoding="utf-8")
        code.write_text(source.code, encoding="utf-8")
        single = [f"-D{name.upper()}_REAL=float"] if real is np.float32 else []
        command = [
            *compiler,
            *STRICT,
            "-O2",
            *single,
            "-shared",
            "-fPIC",
            "-o",
            str(built),
            str(code),
            "-lm",
        ]
        _run(command)
        try:
            loaded = ctypes.CDLL(str(built))
        except OSError as error:
            raise StudyError(
                f"C compiler {shlex.join(compiler)}: its code does not run here ({error}); "
                f"{_ALLOWED}"
            ) from None
        yield loaded


def _run(command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise StudyError(f"C compiler {command[0]}: does not work ({error}); {_ALLOWED}") from None
    if done.returncode:
        raise StudyError(f"C compiler {command[0]}: {done.stderr.strip()[:2000]}; {_ALLOWED}")
