"""Names of inputs and outputs of a machine: `actuator 1.2`, `deflection 3 at 0.05`."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from studies.errors import field_error

#: Kinds of inputs and outputs, how they are written, and the unit of their numbers.
INPUTS = {
    "actuator": ("actuator LINK.PATCH", "V"),
    "slider": ("slider LINK", "N"),
    "hammer": ("hammer LINK at X", "N"),
    "command": ("command LINK", "m"),
}
OUTPUTS = {
    "sensor": ("sensor LINK.PATCH", "V"),
    "deflection": ("deflection LINK at X", "m"),
    "accelerometer": ("accelerometer LINK at X to ANGLE", "m/s^2"),
    "slider": ("slider LINK", "m"),
    "motor": ("motor LINK", "N"),
    "platform": ("platform x, y or phi", "m"),
}
#: Those with a place along a link.
PLACED = ("hammer", "deflection", "accelerometer")
#: Direction of an accelerometer from its link's axis if none is given: across it [deg].
ACROSS = 90.0
_NUMBERED = re.compile(r"(\w+) ([1-9])(?:\.([1-9]))?(?: at ([0-9.eE+-]+))?(?: to ([0-9.eE+-]+))?")
_PLATFORM = {"platform x": 0, "platform y": 1, "platform phi": 2}


class Signal(NamedTuple):
    """One input or output."""

    kind: str  # a key of INPUTS or OUTPUTS
    link: int  # from 0; of the platform: its coordinate
    patch: int  # from 0
    place: float  # from the actuated joint along the link [m], nan if it has none
    angle: float = ACROSS  # of an accelerometer, from the link's axis to its normal [deg]

    def row(self, n_patches: int, stations: tuple[float, ...]) -> int:
        """Its place among all signals of its kind."""
        if self.kind in ("actuator", "sensor"):
            return self.link * n_patches + self.patch
        if self.kind in PLACED:
            return self.link * len(stations) + stations.index(self.place)
        return self.link


def parse_signal(
    text: str, kinds: dict[str, tuple[str, str]], n_patches: int, length: np.ndarray, path: str
) -> Signal:
    """A signal from its name.

    Args:
        text: as the file writes it.
        kinds: INPUTS or OUTPUTS.
        n_patches: pairs of patches on each link.
        length: of the links [m], (n,).
        path: where it is written, for messages.

    Raises:
        StudyError: no such signal.
    """
    allowed = ", ".join(form for form, _ in kinds.values())
    if text in _PLATFORM and "platform" in kinds:
        return Signal("platform", _PLATFORM[text], 0, np.nan)
    match = _NUMBERED.fullmatch(text)
    if match is None or match[1] not in kinds or match[1] == "platform":
        raise field_error(path, text, allowed)
    kind, link = match[1], int(match[2])
    if link > len(length):
        raise field_error(path, text, f"links 1 to {len(length)}")
    if (kind in ("actuator", "sensor")) != (match[3] is not None):
        raise field_error(path, text, kinds[kind][0])
    patch = int(match[3] or 1)
    if patch > n_patches:
        raise field_error(path, text, f"patches 1 to {n_patches}")
    if (kind in PLACED) != (match[4] is not None):
        raise field_error(path, text, kinds[kind][0])
    if match[5] is not None and kind != "accelerometer":
        raise field_error(path, text, kinds[kind][0])
    place, angle = np.nan, ACROSS
    try:
        place, angle = float(match[4] or np.nan), float(match[5] or ACROSS)
    except ValueError:
        raise field_error(path, text, kinds[kind][0], "m; deg") from None
    if not -360 <= angle <= 360:
        raise field_error(path, text, "angles of -360 to 360", "deg")
    if match[4] is not None:
        shortest = float(np.min(length))  # places are common to all links
        if not 0 < place < shortest:
            raise field_error(path, text, f"between 0 and {shortest:g}", "m")
    return Signal(kind=kind, link=link - 1, patch=patch - 1, place=place, angle=angle)


def signal_name(signal: Signal) -> str:
    """Its name as files write it."""
    if signal.kind == "platform":
        return next(name for name, k in _PLATFORM.items() if k == signal.link)
    name = f"{signal.kind} {signal.link + 1}"
    if signal.kind in ("actuator", "sensor"):
        return f"{name}.{signal.patch + 1}"
    if np.isnan(signal.place):
        return name
    turned = "" if signal.angle == ACROSS else f" to {signal.angle:g}"
    return f"{name} at {signal.place:g}{turned}"
