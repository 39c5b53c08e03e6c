"""Functions of UFF files (type 58): which one an entry takes, and what its header says it is."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies.errors import DataWarning, StudyError, field_error, shown
from studies.reading import read_bytes

#: Function types that each kind of entry takes; all take 0, unknown.
_TAKEN = {"response": (4, 5), "spectrum": (2, 9, 10), "trace": (1,), "record": (1,), "decay": (1,)}
_TYPES = {1: "time response", 2: "auto spectrum", 4: "frequency response", 6: "coherence"}
#: Specific data types that have one unit: name, and SI unit.
_QUANTITIES = {
    8: ("displacement", "m"),
    9: ("reaction force", "N"),
    11: ("velocity", "m/s"),
    12: ("acceleration", "m/s^2"),
    13: ("excitation force", "N"),
}
#: Abscissa of a frequency [Hz]; else it is the time [s].
_FREQUENCY = 18
#: Numbers that a line holds: an exporter may fill the last one with zeros.
_IN_A_LINE = 6

#: One side of a function as its entry says it: "ordinate" or "orddenom" (what the ordinate is
#: over), the field that says so, its value, and the unit.
Side = tuple[str, str, object, str]


def read_uff(
    where: Path, number: str, path: str, kind: str, sides: Sequence[Side]
) -> dict[str, np.ndarray]:
    """Columns of one function: `frequency_hz` or `time`, and `value`.

    Args:
        where: the file.
        number: of the function, from 1; "": the first one that such an entry takes.
        path: where the file is named, for messages.
        kind: of the entry.
        sides: what the header must not contradict.

    Raises:
        StudyError: the header contradicts a side.
        ValueError: no such function, or a damaged file.
    """
    try:
        import pyuff
    except ImportError:
        raise StudyError(f"{path}: reading {where} needs pyuff; install the extra 'uff'") from None
    read_bytes(where)  # not larger than a file may be
    try:
        sets = pyuff.UFF(str(where))
        at = np.flatnonzero(sets.get_set_types() == 58)
        if not at.size:
            raise ValueError("has no function (type 58)")
        first, last = (int(number),) * 2 if number else (1, at.size)
        if not 0 < first <= at.size:
            raise ValueError(f"has functions 1 to {at.size}")
        others, header = [], {}
        for k in range(first, last + 1):
            header = sets.read_sets(int(at[k - 1]))
            others.append(f"function {k} is of type {_type(header['func_type'])}")
            if header["func_type"] in (0, *_TAKEN[kind]):
                break
        else:
            raise ValueError(f"{', '.join(others)}; {kind!r} takes type {_type(_TAKEN[kind][0])}")
        columns = _columns(header)
    except Exception as error:  # of any kind, for a damaged file
        raise ValueError(str(error) or "damaged") from error
    if others[:-1]:
        text = f"{path}: of {where.name}, function {k} is read; {', '.join(others[:-1])}"
        warnings.warn(text, DataWarning, stacklevel=2)
    for side in sides:
        _compare(header, side, f"function {k} of {where.name}")
    return columns


def _type(number: Any) -> str:
    return f"{int(number)} ({_TYPES[int(number)]})" if number in _TYPES else f"{number}"


def _columns(header: dict[str, Any]) -> dict[str, np.ndarray]:
    abscissa, data = np.asarray(header["x"]), np.asarray(header["data"])
    promised = int(header.get("num_pts", len(data)))
    if not 0 <= len(data) - promised < _IN_A_LINE or np.any(data[promised:]):
        raise ValueError(f"promises {promised} points and has {len(data)}")
    name = "frequency_hz" if header["abscissa_spec_data_type"] == _FREQUENCY else "time"
    return {name: abscissa[:promised], "value": data[:promised]}


def _compare(header: dict[str, Any], side: Side, what: str) -> None:
    """Refuse another quantity than the entry's, and warn of another unit."""
    which, field, value, unit = side
    name, own = _QUANTITIES.get(header[f"{which}_spec_data_type"], ("", unit))
    if own != unit:
        raise field_error(field, value, f"{name} [{own}], as the header of {what} says")
    label = str(header.get(f"{which}_axis_units_lab") or "").strip()
    plain = label.lower().replace("²", "2").replace("^", "").replace(" ", "")
    if plain not in ("", "none", unit.lower().replace("^", "")):
        text = f"{field}: the header of {what} gives the unit {shown(label)}; taken for {unit}"
        warnings.warn(text, DataWarning, stacklevel=3)
