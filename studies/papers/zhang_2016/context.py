"""What every section of the paper's report reads, and how it formats numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.papers.zhang_2016.cases import ALL, COMPARED, MOVES, OFF, ONE, SHAPERS, TWO, PaperRuns
from studies.papers.zhang_2016.measures import Measures

#: Cases of a comparison: controlled links and heading.
PLACES = ((ALL, "three links"), (TWO, "first two"), (ONE, "first only"))


class Context(NamedTuple):
    """The runs of one machine and what was measured in them."""

    name: str
    runs: PaperRuns
    measures: Measures

    def find(self, move: str, shaper: str, modes: int, links: tuple[bool, ...]) -> int:
        """Index of a case of the grid, with the machine's own damping."""
        fields = {"move": move, "shaper": shaper, "modes": modes, "links": links}
        return self.runs.where(**fields, damping_ratio=None)

    def compared(self, modes: int, links: tuple[bool, ...]) -> int:
        """Index of a case on the move that is compared with the paper's numbers."""
        return self.find(*COMPARED, modes, links)

    def peak_change(self, k: int, mode: int) -> str:
        """Change of a mode's spectral peak relative to no control, per link."""
        peak, off = self.measures.spectral_peak[:, :, mode - 1], self.measures.counterpart[k]
        return ", ".join(change(peak[k, i], peak[off, i]) for i in range(3))

    def pairs(self) -> list[tuple[int, int, str]]:
        """Cases without control and with three links, and their motion; also the damped ones."""
        pairs = [
            (self.find(m, s, 3, OFF), self.find(m, s, 3, ALL), move_text(m, s))
            for m, s in settings()
        ]
        cases = self.runs.cases
        damped = [k for k, case in enumerate(cases) if case.damping_ratio is not None]
        if len(damped) == 2:
            zeta = cases[damped[0]].damping_ratio
            pairs.append((damped[0], damped[1], f"{move_text('fast', 'none')}, damping {zeta:g}"))
        return pairs


class Machines(NamedTuple):
    """The machines whose numbers stand beside the paper's."""

    fitted: Context  # to the paper's measurements; its runs are the compared cases
    nominal: Context  # all cases


def change(value: float, reference: float) -> str:
    """Change relative to a reference in percent, "-" if that is zero."""
    return f"{100 * (value / reference - 1):+.1f} %" if reference > 0 else "-"


def move_text(move: str, shaper: str) -> str:
    kind = {"ei": "EI shaper", "none": "no shaper"}[shaper]
    text = {"paper": "paper's move", "fast": "fast move"}[move]
    return f"{text} ({MOVES[move]:g} s), {kind}"


def settings() -> list[tuple[str, str]]:
    return [(move, shaper) for move in MOVES for shaper in SHAPERS]


def residual(context: Context, rms: float, link: int) -> str:
    """Rms deflection of a link [µm]; of what the converter cannot resolve, only its step."""
    step = context.runs.frame.adc_step[link]
    return f"{1e6 * rms:.3g}" if rms >= step else f"< {1e6 * step:.2g}"


def residuals(context: Context, rms: np.ndarray) -> str:
    """`residual` of all links, rms (3,)."""
    return ", ".join(residual(context, x, i) for i, x in enumerate(rms))
