"""Numbers in readable units: micrometres, milliseconds."""

from __future__ import annotations

from typing import Any

import numpy as np

#: SI units of labels, with the factor to the unit that reports show, and that unit.
READABLE = {
    "m": (1e6, "µm"),
    "s": (1e3, "ms"),
    "m; m; rad": (1e6, "µm; µm; µrad"),
    "Pa": (1e-9, "GPa"),
}


def readable(unit: str) -> tuple[float, str]:
    """Factor and unit in which a report shows numbers of this unit."""
    return READABLE.get(unit, (1.0, unit))


def headed(name: str, unit: str) -> str:
    """A column heading: the name, and the unit of its numbers."""
    shown = readable(unit)[1]
    return name if shown in ("", "1") else f"{name} [{shown}]"


#: Settled is what has been seen to stay in the band for this long [s]: a period of the links' first
#: bending mode. A link that swings through the band once more may be anywhere in it.
CALM = 0.01


def settling_text(seconds: float, watched: float) -> str:
    """A settling time [ms], or that it was not seen.

    Args:
        seconds: from the end of the reference trajectory to the last time outside the band.
        watched: from there to the end of the run [s].
    """
    if is_cut_off(seconds, watched):
        return f"not within {number(watched, 's')}"
    return number(seconds, "s")


def is_cut_off(seconds: Any, watched: Any) -> Any:
    """Whether settling times [s] end with the run that was watched, rather than by settling."""
    return (seconds > 0) & (seconds > watched - CALM)


def number(value: float, unit: str) -> str:
    """A value of an SI unit as a report shows it, without the unit."""
    return f"{readable(unit)[0] * value:.4g}"


def count_text(n: int, what: str) -> str:
    """A count with its noun: "1 family", "2 families", "3 cases"."""
    many = f"{what.removesuffix('y')}ies" if what.endswith("y") else f"{what}s"
    return f"{n} {what if n == 1 else many}"


def span(values: Any, digits: str = ".3g") -> str:
    """Smallest and largest number: "1.2 to 3.4"."""
    low, high = (f"{x:{digits}}" for x in (float(np.min(values)), float(np.max(values))))
    return low if low == high else f"{low} to {high}"
