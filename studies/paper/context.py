"""What every section of the paper's report reads, and how it formats numbers."""

from __future__ import annotations

from typing import NamedTuple

from studies.paper.cases import ALL, MOVES, OFF, ONE, SHAPERS, TWO, PaperRuns
from studies.paper.measures import Measures

#: Cases of a comparison: controlled links and heading.
PLACES = ((ALL, "three links"), (TWO, "first two"), (ONE, "first only"))


class Context(NamedTuple):
    """What every section reads."""

    runs: PaperRuns
    measures: Measures

    def find(self, move: str, shaper: str, modes: int, links: tuple[bool, ...]) -> int:
        """Index of a case at the default structural damping."""
        damping = self.runs.study.link.first_damping
        return self.runs.where(
            move=move, shaper=shaper, modes=modes, links=links, damping_ratio=damping
        )

    def drop(self, k: int, mode: int) -> str:
        """Change of a mode's spectral peak relative to no control, per link."""
        peak, off = self.measures.spectral_peak[:, :, mode - 1], self.measures.counterpart[k]
        return ", ".join(change(peak[k, i], peak[off, i]) for i in range(3))

    def pairs(self) -> list[tuple[int, int, str]]:
        """Cases without control and with three links, and their motion; also the damped ones."""
        found = [
            (self.find(m, s, 3, OFF), self.find(m, s, 3, ALL), move_text(m, s))
            for m, s in settings()
        ]
        cases, usual = self.runs.cases, self.runs.study.link.first_damping
        damped = [k for k, case in enumerate(cases) if case.damping_ratio != usual]
        if len(damped) == 2:
            zeta = cases[damped[0]].damping_ratio
            found.append((damped[0], damped[1], f"{move_text('fast', 'none')}, damping {zeta:g}"))
        return found


def change(value: float, reference: float) -> str:
    """Change relative to a reference in percent, "-" if that is zero."""
    return f"{100 * (value / reference - 1):+.1f} %" if reference > 0 else "-"


def move_text(move: str, shaper: str) -> str:
    kind = {"ei": "EI shaper", "none": "no shaper"}[shaper]
    text = {"paper": "paper's move", "fast": "fast move"}[move]
    return f"{text} ({MOVES[move]:g} s), {kind}"


def settings() -> list[tuple[str, str]]:
    return [(move, shaper) for move in MOVES for shaper in SHAPERS]


def residual(context: Context, case: int, link: int) -> str:
    """Late rms deflection of a link [µm], marked if the converter cannot resolve it."""
    value = context.measures.late_deflection[case, link]
    mark = " †" if value < context.runs.frame.adc_step[link] else ""
    return f"{1e6 * value:.3g}{mark}"
