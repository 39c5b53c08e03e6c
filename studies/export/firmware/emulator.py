"""A program for an Arm processor, run by QEMU and called like code on this machine.

The program `pil.c` opens two named pipes by semihosting, so that host and target can exchange
single samples as well as blocks. QEMU lets time advance by a fixed span per instruction
(`-icount`), so that the processor's own timer counts instructions.
"""

from __future__ import annotations

import os
import select
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.export.firmware.boards import Board
from studies.export.firmware.build import EMULATOR
from studies.export.firmware.project import BLOCK, CLOCK
from studies.publish import working_folder

#: An instruction takes 2^SHIFT ns of the emulated time: several ticks of the timer.
SHIFT = 7
#: Ticks of the timer in an instruction.
TICKS = 2**SHIFT * 1e-9 * CLOCK
#: Longest wait for an answer [s].
PATIENCE = 60.0
_SIZES, _INIT, _STEP, _SHAPE_INIT, _SHAPE, _END = range(6)


class ProgramSizes(NamedTuple):
    """What the program says of itself."""

    n_channels: int
    wire: int  # bytes of a sensor or actuator value
    word: int  # of a reference
    state: int  # of the controller [bytes]
    shaper: int  # [bytes]
    stack: int  # reserved [bytes]


class EmulatedCode:
    """A running program; with the same calls as `studies.export.compiler.Code`."""

    def __init__(self, process: subprocess.Popen[bytes], pipes: tuple[int, int]) -> None:
        self._process, (self._to, self._from) = process, pipes
        self.instructions: list[np.ndarray] = []  # of all samples, by calls
        self.depth = 0  # of the stack in a sample [bytes]
        self._send(_SIZES)
        self.sizes = ProgramSizes(*struct.unpack("<6I", self._receive(24)))

    def begin(self) -> None:
        """Reset the controller's state."""
        self._send(_INIT)

    def step(self, sensor: np.ndarray) -> tuple[np.ndarray, int]:
        """One sample: actuator values and the fault, from sensor values (3 K,)."""
        values, faults = self._steps(np.reshape(sensor, (1, -1)))
        return values[0], int(faults[0])

    def respond(self, sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A sequence (T, 3, K) from rest: actuator values (T, 3, K) and faults (T,)."""
        self.begin()
        values, faults = self._steps(np.reshape(sensor, (len(sensor), -1)))
        return values.reshape(sensor.shape), faults

    def shape(self, reference: np.ndarray) -> np.ndarray:
        """A shaped reference (T, 3), starting at rest in its first row."""
        rows = np.asarray(reference).astype(self._word)
        self._send(_SHAPE_INIT, 1, rows[:1])
        parts = []
        for k in range(0, len(rows), BLOCK):
            part = rows[k : k + BLOCK]
            self._send(_SHAPE, len(part), part)
            parts.append(self._read(self._word, part.shape))
        return np.concatenate(parts)

    def end(self) -> None:
        """Let the program end by itself."""
        self._send(_END)
        self._process.wait(PATIENCE)

    @property
    def _wire(self) -> np.dtype[Any]:
        return np.dtype({2: "<u2", 4: "<f4", 8: "<f8"}[self.sizes.wire])

    @property
    def _word(self) -> np.dtype[Any]:
        is_fixed = self.sizes.wire == 2
        return np.dtype("<i4" if is_fixed else f"<f{self.sizes.word}")

    def _steps(self, sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = np.asarray(sensor).astype(self._wire)
        values, faults, counts = [], [], []
        for k in range(0, len(rows), BLOCK):
            part = rows[k : k + BLOCK]
            self._send(_STEP, len(part), part)
            values.append(self._read(self._wire, part.shape))
            faults.append(self._read(np.dtype("<i4"), (len(part),)))
            counts.append(self._read(np.dtype("<u4"), (len(part),)) / TICKS)
            self.depth = max(self.depth, int(self._read(np.dtype("<u4"), (1,))[0]))
        # the program subtracts a call that has one instruction in it
        self.instructions.append(1 + np.round(np.concatenate(counts)).astype(int))
        return np.concatenate(values), np.concatenate(faults)

    def _send(self, command: int, count: int = 0, rows: np.ndarray | None = None) -> None:
        data = struct.pack("<2I", command, count) + (b"" if rows is None else rows.tobytes())
        until = time.monotonic() + PATIENCE
        while data:
            self._wait(self._to, False, until)
            data = data[os.write(self._to, data) :]

    def _read(self, kind: np.dtype[Any], shape: tuple[int, ...]) -> np.ndarray:
        data = self._receive(kind.itemsize * int(np.prod(shape)))
        return np.frombuffer(data, kind).reshape(shape)

    def _receive(self, count: int) -> bytes:
        data, until = b"", time.monotonic() + PATIENCE
        while len(data) < count:
            self._wait(self._from, True, until)
            data += os.read(self._from, count - len(data))
        return data

    def _wait(self, pipe: int, is_read: bool, until: float) -> None:
        """Wait until a pipe is ready.

        Raises:
            StudyError: the program has ended, or does not answer.
        """
        while not any(select.select(*(([pipe], []) if is_read else ([], [pipe])), [], 0.1)):
            if self._process.poll() is not None:
                assert self._process.stderr is not None
                said = self._process.stderr.read().decode(errors="replace").strip()
                raise StudyError(f"the program on the target stopped: {said[:500] or 'a fault'}")
            if time.monotonic() > until:
                raise StudyError(f"the program on the target gives no answer for {PATIENCE:g} s")


@contextmanager
def emulated(image: Path, board: Board, traced_to: Path | None = None) -> Iterator[EmulatedCode]:
    """Run a program on an emulated board.

    Args:
        image: the program, from `build`.
        board: where.
        traced_to: file for a line per instruction.

    Raises:
        StudyError: it does not run, or stops.
    """
    with working_folder() as folder:
        names = [str(folder / name) for name in ("to_target", "from_target")]
        for name in names:
            os.mkfifo(name)
        # both ends, so that opening does not wait for the program
        pipes = [os.open(name, os.O_RDWR | os.O_NONBLOCK) for name in names]
        command = [
            *(EMULATOR, "-machine", board.machine, "-display", "none", "-monitor", "none"),
            *("-serial", "none", "-icount", f"shift={SHIFT},sleep=off"),
            *("-semihosting-config", "enable=on,target=native", "-kernel", str(image)),
        ]
        if traced_to is not None:
            command += ["-singlestep", "-d", "exec,nochain", "-D", str(traced_to)]
        try:
            process = subprocess.Popen(
                command, cwd=folder, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
        except OSError as error:
            raise StudyError(f"{EMULATOR}: does not work ({error})") from None
        try:
            processor = EmulatedCode(process, (pipes[0], pipes[1]))
            yield processor
            processor.end()
        finally:
            process.kill()
            process.wait()
            for pipe in pipes:
                os.close(pipe)
