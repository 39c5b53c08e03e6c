"""What entries of all kinds have: signals, columns, noise, a pose."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from studies.errors import StudyError, field_error
from studies.fitting.bench import Bench
from studies.fitting.bench import Pose as At
from studies.fitting.kinds.contract import Noise
from studies.fitting.kinds.figures import Runs
from studies.fitting.kinds.motions import RECORDED, Motions
from studies.fitting.spec import (
    Common,
    DecayEntry,
    FileEntry,
    FitSpec,
    NoiseEntry,
    OutputEntry,
    PoseEntry,
    ResponseEntry,
    ShakenEntry,
    ThinnedEntry,
)
from studies.fitting.tables import column, read_columns
from studies.fitting.uff import Side
from studies.study.cases import build_structure
from studies.study.signals import INPUTS, OUTPUTS, Signal, parse_signal

#: Rows of a measurement that a fit takes: a minute or two of work.
MOST_ROWS = 20_000
#: Derivatives of the output by its quantity.
ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2}
#: The same of outputs that have one quantity.
GIVEN = {"accelerometer": 2, "motor": 0}


class Models(NamedTuple):
    """What measurements are predicted with."""

    bench: Bench
    runs: Runs
    motions: Motions


def pose_of(spec: FitSpec, entry: PoseEntry) -> At:
    """The pose of a measurement."""
    return entry.pose or spec.study.motion.waypoints[0]


def signals_of(spec: FitSpec, entry: Common, path: str) -> tuple[Signal, ...]:
    """Input and output of an entry, or its outputs."""
    if not isinstance(entry, OutputEntry | DecayEntry):
        return ()
    sizes = build_structure(spec.study).n_patches, spec.study.each_link(spec.study.link.length)
    if isinstance(entry, DecayEntry):
        moving = {x: form for x, form in OUTPUTS.items() if x != "motor"}
        return tuple(
            parse_signal(x, moving, *sizes, f"{path}.outputs[{j}]")
            for j, x in enumerate(entry.outputs)
        )
    kinds = OUTPUTS if isinstance(entry, ShakenEntry) else {x: OUTPUTS[x] for x in RECORDED}
    output = parse_signal(entry.output, kinds, *sizes, f"{path}.output")
    if not isinstance(entry, ShakenEntry):
        return (output,)
    source = parse_signal(entry.input, INPUTS, *sizes, f"{path}.input")
    what = f"{path}: responses from commands and to motors are"
    check_drive(spec, {source.kind, output.kind}, what)
    return source, output


def check_drive(spec: FitSpec, kinds: set[str], what: str) -> None:
    """Refuse commands and motors, kinds of signals, of other drives than PD."""
    if kinds & {"command", "motor"} and spec.study.drive.kind != "pd":
        raise StudyError(
            f"{what} known of drive.kind = 'pd' only, which has no forward path; it is "
            f"{spec.study.drive.kind!r}"
        )


def each(value: Any, count: int, path: str) -> np.ndarray:
    """One number for all, or one for each."""
    if isinstance(value, tuple) and len(value) != count:
        raise field_error(path, value, f"one number, or {count}")
    return np.broadcast_to(np.asarray(value, float), (count,)).copy()


def unit_of(output: Signal, quantity: str) -> str:
    """Unit of an output or of its derivative."""
    order = 0 if output.kind in GIVEN else ORDERS[quantity]
    return OUTPUTS[output.kind][1] + ("", "/s", "/s^2")[order]


def _sides(spec: FitSpec, entry: FileEntry, path: str) -> list[Side]:
    """What an entry says of its output, and of the input of a response."""
    *source, output = signals_of(spec, entry, path)
    names = ["outputs" if isinstance(entry, DecayEntry) else "output"]
    if output.kind not in GIVEN:
        names.insert(0, "quantity")
    field = next(x for x in names if hasattr(entry, x))
    unit = unit_of(output, getattr(entry, "quantity", "displacement"))
    sides: list[Side] = [("ordinate", f"{path}.{field}", getattr(entry, field), unit)]
    if isinstance(entry, ResponseEntry):
        unit = INPUTS[source[0].kind][1]
        sides.append(("orddenom", f"{path}.input", entry.input, unit))
    return sides


def reader(spec: FitSpec, entry: FileEntry, path: str) -> Callable[[str], np.ndarray]:
    """What reads a column; all that are read have one length."""
    sides = _sides(spec, entry, path)
    columns = read_columns(entry.file, spec.folder, f"{path}.file", entry.kind, sides)
    thin = entry.thin if isinstance(entry, ThinnedEntry) else 1
    thinned = {name: x[::thin] for name, x in columns.items()}
    lengths: dict[str, int] = {}

    def read(name: str) -> np.ndarray:
        rows = lengths[name] = len(columns.get(name, ()))
        if isinstance(entry, ThinnedEntry) and rows > MOST_ROWS * thin:
            raise field_error(
                f"{path}.thin",
                thin,
                f"{-(-rows // MOST_ROWS)} or more for {entry.file} of {rows} rows: a fit takes up "
                f"to {MOST_ROWS} of each measurement (of raw time records take kind = 'record')",
                "1",
            )
        values = column(thinned, name, entry.file, path)
        if len(set(lengths.values())) > 1:
            sizes = ", ".join(f"{key} {size}" for key, size in lengths.items())
            raise StudyError(
                f"{path}: columns of {entry.file} differ in length: {sizes}; allowed: one length"
            )
        return values

    return read


def real(x: np.ndarray, name: str, path: str) -> np.ndarray:
    """A column that must not be complex.

    Raises:
        StudyError: it is.
    """
    if np.iscomplexobj(x):
        raise StudyError(f"{path}: column {name!r} is complex; expected real numbers")
    return x


def ascending(x: np.ndarray, what: str, path: str, least: int = 3) -> None:
    """Refuse a column of time or frequency that does not ascend, or of few points.

    Raises:
        StudyError: with the first row that does not.
    """
    if len(x) < least:
        raise StudyError(f"{path}: {what} has {len(x)} points; allowed: {least} or more")
    if not np.all(np.diff(x) > 0):
        row = int(np.argmax(np.diff(x) <= 0)) + 2
        raise StudyError(f"{path}: {what} must ascend; row {row} does not")


def noise_of(entry: NoiseEntry, value: np.ndarray, path: str) -> Noise:
    """Noise of measured values.

    Raises:
        StudyError: a value without any.
    """
    noise = Noise(entry.sigma or 0.0, (entry.sigma_percent or 0.0) / 100)
    without = np.flatnonzero(noise.sigma(value) <= 0)
    if without.size:
        raise StudyError(
            f"{path}: value {without[0] + 1} is 0, where sigma_percent alone means no noise; give "
            "sigma beside it, the noise of small values in the unit of the output"
        )
    return noise


def unknown(names: tuple[str, ...]) -> tuple[str, ...]:
    """Each of them once."""
    return tuple(dict.fromkeys(names))
