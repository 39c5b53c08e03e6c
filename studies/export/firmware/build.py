"""The project's programs, built by Arm's compiler, and what is known without running them."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

from studies.errors import StudyError
from studies.export.firmware.boards import Board

COMPILER, EMULATOR = "arm-none-eabi-gcc", "qemu-system-arm"
#: Names of tools, and packages of Debian and Ubuntu that have them.
PACKAGES = "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
#: Flags with which a project compiles without warnings.
STRICT = (
    *("-std=c99", "-O2", "-ffunction-sections", "-fdata-sections"),
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"),
)
#: Library functions that stand for floating-point arithmetic (Arm's run-time ABI).
_SOFT_FLOAT = re.compile(r"__aeabi_(?:[cfd]|[iul]+2[fd]|h2f)\w*")


class Built(NamedTuple):
    """A controller built for a processor."""

    image: Path  # that runs in the emulator
    flash: int  # code and constants of the controller [bytes]
    firmware: int  # of the whole program main.c [bytes]
    stack: int  # bound for a sample, without the library's functions [bytes]
    library: tuple[str, ...]  # functions of the compiler's library that the controller calls
    version: str  # of the compiler

    @property
    def soft_float(self) -> tuple[str, ...]:
        """Library functions that emulate floating-point arithmetic."""
        return tuple(x for x in self.library if _SOFT_FLOAT.fullmatch(x))


def check_tools() -> None:
    """Check that there are compiler and emulator.

    Raises:
        StudyError: there are not.
    """
    missing = [tool for tool in (COMPILER, EMULATOR) if not shutil.which(tool)]
    if missing:
        raise StudyError(
            f"--pil: {' and '.join(missing)} not found; on Debian and Ubuntu the packages "
            f"{PACKAGES} have what it needs"
        )


def build(folder: Path, name: str, board: Board, is_fixed: bool) -> Built:
    """Compile and link a project.

    Args:
        folder: with its files, from `project_files`; what is built is added.
        name: of the controller.
        board: what for.
        is_fixed: whether it is in fixed point.

    Raises:
        StudyError: the compiler rejects it.
    """
    defined = [] if is_fixed else [f"-D{name.upper()}_REAL={board.real}"]
    flags = [*board.flags, *STRICT, *defined]
    for file in (name, "startup", "main", "pil"):
        notes = ["-fcallgraph-info=su"] if file == name else []
        _run([COMPILER, *flags, *notes, "-c", f"{file}.c", "-o", f"{file}.o"], folder)
    link = [
        *(COMPILER, *board.flags, "-nostartfiles", "--specs=nosys.specs"),
        *("-Wl,--gc-sections", "-T", "board.ld"),
    ]
    for program in ("main", "pil"):
        objects = [f"{program}.o", "startup.o", f"{name}.o"]
        _run([*link, *objects, "-o", f"{program}.elf"], folder)
    graph = (folder / f"{name}.ci").read_text(encoding="utf-8")
    undefined = _run(["arm-none-eabi-nm", "--undefined-only", f"{name}.o"], folder)
    return Built(
        image=folder / "pil.elf",
        flash=_flash(f"{name}.o", folder),
        firmware=_flash("main.elf", folder),
        stack=stack_bound(graph, f"{name}_step"),
        library=tuple(sorted(line.split()[-1] for line in undefined.splitlines())),
        version=_run([COMPILER, "--version"], folder).splitlines()[0],
    )


def _flash(file: str, folder: Path) -> int:
    """Code, constants and initial values in a file [bytes]."""
    text, data, *_ = _run(["arm-none-eabi-size", file], folder).splitlines()[1].split()
    return int(text) + int(data)


def stack_bound(graph: str, function: str) -> int:
    """Largest sum of stack frames on any way through the calls of a function [bytes].

    Args:
        graph: written by the compiler's `-fcallgraph-info=su`.
        function: its name.
    """
    own = {
        match[1].split(":")[-1]: int(match[2])
        for match in re.finditer(
            r'node: \{ title: "([^"]+)" label: "[^"]*?\\n(\d+) bytes \(static\)', graph
        )
    }
    calls: dict[str, set[str]] = {}
    for match in re.finditer(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph):
        calls.setdefault(match[1].split(":")[-1], set()).add(match[2].split(":")[-1])

    def depth(name: str) -> int:
        return own.get(name, 0) + max(map(depth, calls.get(name, ())), default=0)

    return depth(function)


def _run(command: list[str], folder: Path) -> str:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise StudyError(f"{command[0]}: does not work ({error})") from None
    if done.returncode:
        raise StudyError(f"{shlex.join(command[:1])}: {done.stderr.strip()[:2000]}")
    return done.stdout
