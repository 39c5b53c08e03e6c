"""Gain margins in words, and the bounds of what is looked at."""

from __future__ import annotations

#: Plant modes that a margin rests on at least: modes that nobody controls limit the gains [1].
MARGIN_MODES = 12


#: Margins below this are pointed out [1].
ENOUGH = 2.0


#: Margins beyond this are given as it, and those below the other as 0 [1].
HIGHEST, LOWEST = 64.0, 1e-6


def caution(margin: float) -> str:
    """What must be said of a gain margin, "" where it is `ENOUGH`, or there is none."""
    if margin == 0:
        return (
            "UNSTABLE LOOP: the linearised sampled loop grows by itself, however small the gains."
        )
    if margin < 1:
        return (
            "UNSTABLE LOOP: the linearised sampled loop grows by itself; saturation and the end of "
            "the run bound what is seen here. Lower the gains below "
            f"{margin:.3g} of these."
        )
    if margin < ENOUGH:
        return (
            f"CAUTION: a gain margin of {margin:.3g}; below {ENOUGH:g} a machine may go unstable."
        )
    return ""


def margin_text(value: float, digits: int = 4) -> str:
    """A gain margin in words; beyond `HIGHEST` nobody looks."""
    return f"> {HIGHEST:g}" if value >= HIGHEST else f"{value:.{digits}g}"
