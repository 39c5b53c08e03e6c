"""Processors that the exported controller can be built for and emulated on."""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.table import Table


class Board(NamedTuple):
    """A processor on a board that QEMU emulates."""

    name: str
    text: str
    machine: str  # QEMU's name of the board
    flags: tuple[str, ...]  # of the compiler
    real: str  # floating-point type that code in floating point is built for
    cycles: float  # of an instruction, assumed without wait states [1]
    clock: float  # usual for it [Hz]

    def load(self, instructions: float, rate: float, clock: float) -> float:
        """Share of a sample period, estimated [1].

        Args:
            instructions: of a sample.
            rate: of samples [Hz].
            clock: of the processor [Hz].
        """
        return instructions * self.cycles * rate / clock


#: Clocks for which loads are stated [Hz]: common for Cortex-M3, M4 and M7.
CLOCKS = (72e6, 168e6, 480e6)

#: All processors by name. Cycles per instruction: loads take two of them in a row of loads, long
#: multiplications 3 to 7 on the M3 and 1 on the others, branches 2 to 4 (Arm's technical reference
#: manuals); the M7 issues up to two instructions at once.
BOARDS: Table[Board] = Table(
    "processor",
    [
        Board(
            name="cortex-m3",
            text="Cortex-M3 (MPS2 AN385)",
            machine="mps2-an385",
            flags=("-mcpu=cortex-m3", "-mthumb"),
            real="float",
            cycles=2.0,
            clock=72e6,
        ),
        Board(
            name="cortex-m4",
            text="Cortex-M4 without floating-point unit (MPS2 AN386)",
            machine="mps2-an386",
            flags=("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft"),
            real="float",
            cycles=1.5,
            clock=168e6,
        ),
        Board(
            name="cortex-m4f",
            text="Cortex-M4 with single-precision unit (MPS2 AN386)",
            machine="mps2-an386",
            flags=("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
            real="float",
            cycles=1.5,
            clock=168e6,
        ),
        Board(
            name="cortex-m7",
            text="Cortex-M7 with double-precision unit (MPS2 AN500)",
            machine="mps2-an500",
            flags=("-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-d16", "-mfloat-abi=hard"),
            real="double",
            cycles=1.0,
            clock=480e6,
        ),
    ],
)
