"""Files of a firmware project around an exported controller."""

from __future__ import annotations

from pathlib import Path

from studies.export.c_text import Source
from studies.export.firmware.boards import Board
from studies.show.pages import render

#: Bytes reserved for the stack.
STACK = 4096
#: Samples of a command of the emulated program.
BLOCK = 256
#: Clock of the emulated boards [Hz].
CLOCK = 25_000_000

FILES = (
    "CMakeLists.txt",
    "README.md",
    "board.ld",
    "main.c",
    "pil.c",
    "startup.c",
    "toolchain-clang.cmake",
    "toolchain-gcc.cmake",
)


def project_files(source: Source, name: str, board: Board, is_fixed: bool) -> dict[str, str]:
    """Texts of all files of a project, by file name.

    Args:
        source: the controller.
        name: of its files and functions.
        board: what it is built for.
        is_fixed: whether it is in fixed point.
    """
    upper = name.upper()
    values = {
        "name": name,
        "NAME": upper,
        "board": board,
        "flags": board.flags,
        "fixed": is_fixed,
        "real": "" if is_fixed else board.real,
        "wire": "uint16_t" if is_fixed else f"{name}_real",
        "word": "int32_t" if is_fixed else f"{name}_real",
        "rest": f"{upper}_DAC_REST" if is_fixed else "0",
        "at_rest": f"({upper}_ADC_TOP + 1) / 2"
        if is_fixed
        else f"(wire)(0.5 * {upper}_ADC_TOP * {upper}_ADC_STEP)",
        "stack": STACK,
        "block": BLOCK,
        "clock": CLOCK,
    }
    texts = {file: render(f"export/firmware/templates/{file}", **values) for file in FILES}
    return texts | {f"{name}.h": source.header, f"{name}.c": source.code}


def write_files(files: dict[str, str], folder: Path) -> None:
    """Write texts to a folder, created if missing."""
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
