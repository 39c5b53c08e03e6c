"""Files of measurements: columns of numbers from CSV, HDF5, MATLAB or UFF (type 58)."""

from __future__ import annotations

import csv
import re
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from studies.errors import StudyError, field_error, nearest, shown
from studies.fitting.uff import Side, read_uff
from studies.reading import LARGEST as LARGEST_FILE
from studies.reading import open_hdf5, open_regular, read_bytes, read_text
from studies.study.matlab import read_mat

#: Endings of the formats.
FORMATS = (".csv", ".txt", ".h5", ".hdf5", ".mat", ".uff", ".unv")
#: Larger numbers are none that an instrument reads.
LARGEST = 1e30


def read_columns(
    file: str, folder: Path, path: str, kind: str = "response", sides: Sequence[Side] = ()
) -> dict[str, np.ndarray]:
    """Columns of a file by name, as text from CSV; `column` makes numbers of them.

    Args:
        file: name, relative to `folder`; of HDF5 and MATLAB perhaps `file::group`
            (a struct), of UFF `file::number`.
        folder: where the file that names it is.
        path: where it is written, for messages.
        kind, sides: what the header of a UFF function must not contradict, see `uff.read_uff`.

    Raises:
        StudyError: unreadable, unknown format, no columns, or another quantity.
    """
    name, _, inside = file.partition("::")
    where = folder / name
    if where.suffix.lower() not in FORMATS:
        raise field_error(path, file, f"a file {', '.join(FORMATS)}")
    try:
        with open_regular(where):  # of any size: pyuff opens its files itself
            pass
        if where.suffix.lower() in (".h5", ".hdf5"):
            columns = _from_hdf5(where, inside)
        elif where.suffix.lower() == ".mat":
            columns = _from_matlab(where, inside)
        elif where.suffix.lower() in (".uff", ".unv"):
            columns = read_uff(where, inside, path, kind, sides)
        else:
            columns = _from_csv(where)
    except (OSError, ValueError, KeyError, csv.Error) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error
        raise StudyError(f"{path}: {where} cannot be read ({reason})") from None
    if not columns:
        raise StudyError(f"{path}: {where} has no columns; allowed: columns of numbers with names")
    return columns


def column(columns: dict[str, np.ndarray], name: str, file: str, path: str) -> np.ndarray:
    """One column as numbers; others may hold anything.

    Raises:
        StudyError: there is none of that name, or it has entries that are no finite numbers.
    """
    if name not in columns:
        hint = nearest(name, columns)
        suggestion = f"; did you mean {hint!r}?" if hint else ""
        names = ", ".join(shown(x) for x in columns)
        raise StudyError(
            f"{path}: {shown(file)} has no column {shown(name)}; it has {names}{suggestion}"
        )
    values = columns[name]
    if values.dtype.kind == "U":
        values = np.array(
            [
                _cell(x, f"{path}: {shown(file)}, row {k}, column {shown(name)}")
                for k, x in enumerate(values, 1)
            ]
        )
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise StudyError(
            f"{path}: {shown(file)}, column {name!r}: {bad.size} of {len(values)} entries are not "
            f"finite numbers, the first in row {bad[0] + 1}; delete these rows, or cut a record "
            "there"
        )
    huge = np.flatnonzero(np.abs(values) > LARGEST)
    if huge.size:
        raise StudyError(
            f"{path}: {shown(file)}, column {name!r}, row {huge[0] + 1}: {values[huge[0]]:g}; "
            f"allowed: up to {LARGEST:g} in size"
        )
    return values


def _cell(text: str, where: str) -> float:
    try:
        if "_" not in text:
            return float(text or "nan")
    except ValueError:
        pass
    raise StudyError(f"{where}: {shown(str(text))} is not a number")


def _from_csv(where: Path) -> dict[str, np.ndarray]:
    lines = read_text(where).splitlines(keepends=True)
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise ValueError("needs a row of names and one of numbers or more")
    mark = next((x for x in (";", "\t") if x in lines[0]), ",")
    rows = list(csv.reader(lines, delimiter=mark))
    names = [name.strip() for name in rows[0]]
    if len(set(names)) < len(names):
        raise ValueError("two columns have one name")
    width = len(names)
    for k, row in enumerate(rows[1:], 1):
        if len(row) != width:
            raise ValueError(f"row {k} has {len(row)} entries instead of {width}")
    columns = zip(*rows[1:], strict=True)
    whole = zip(names, columns, strict=True)
    return {name: np.array(x if mark == "," else _with_points(name, x), str) for name, x in whole}


#: A whole number with commas between its thousands, or one with three decimals.
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")


def _with_points(name: str, cells: Sequence[str]) -> Sequence[str]:
    """A column with decimal points where it has decimal commas."""
    split = [x for x in cells if "," in x]
    if not split or any("." in x for x in cells):
        return cells
    if len(split) < len(cells) and all(_THOUSANDS.fullmatch(x.strip()) for x in split):
        raise ValueError(
            f"column {shown(name)}: {shown(split[0])} beside whole numbers can be thousands or "
            "decimals; write decimal points"
        )
    return [x.replace(",", ".") for x in cells]


def _numbers(x: np.ndarray) -> np.ndarray:
    return x if np.iscomplexobj(x) else x.astype(float)


def _from_hdf5(where: Path, group: str) -> dict[str, np.ndarray]:
    with open_hdf5(where) as file:
        at = file[group] if group else file
        if not isinstance(at, h5py.Group):
            raise ValueError(f"{group} is not a group")
        columns = {name: x for name, x in at.items() if isinstance(x, h5py.Dataset)}
        return {
            name: _numbers(np.ravel(x))
            for name, x in columns.items()
            if max(x.shape, default=0) == x.size > 0 and x.dtype.kind in "iufc"
        }


def _from_matlab(where: Path, struct: str) -> dict[str, np.ndarray]:
    """Vectors, not scalars, of a file that MATLAB saved; since version 7.3 it is one of HDF5."""
    if h5py.is_hdf5(where):
        return _from_matlab_hdf5(where, struct)
    _check_unpacked(read_bytes(where))
    vectors = {name: np.squeeze(x) for name, x in read_mat(where, struct, _UNPACKED).items()}
    return {
        name: _numbers(x) for name, x in vectors.items() if x.ndim == 1 and x.dtype.kind in "iufc"
    }


#: Bytes that a compressed MATLAB file may unpack to.
_UNPACKED = 4 * LARGEST_FILE
#: Its header, and the type of a compressed variable.
_HEADER, _COMPRESSED = 128, 15


def _check_unpacked(content: bytes) -> None:
    """Raise ValueError for a file of version 5 whose variables unpack to more than `_UNPACKED`."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    at, total = _HEADER, 0
    while order and at + 8 <= len(content):
        kind, size = struct.unpack(f"{order}II", content[at : at + 8])
        if kind == _COMPRESSED:
            packed = content[at + 8 : at + 8 + size]
            try:
                total += len(zlib.decompressobj().decompress(packed, _UNPACKED - total + 1))
            except zlib.error as error:
                raise ValueError(str(error)) from None
        if total > _UNPACKED:
            raise ValueError(f"unpacks to more than {_UNPACKED / 2**20:g} MiB")
        at += 8 + size


def _from_matlab_hdf5(where: Path, group: str) -> dict[str, np.ndarray]:
    with open_hdf5(where) as file:
        at = file[group] if group else file
        if not isinstance(at, h5py.Group):
            raise ValueError(f"{group} is not a struct")
        columns = {}
        for name, x in at.items():
            kind = x.attrs.get("MATLAB_class", b"")
            is_text = kind in (b"char", "char") or "MATLAB_empty" in x.attrs
            is_vector = isinstance(x, h5py.Dataset) and max(x.shape, default=0) == x.size > 1
            if is_vector and not is_text:
                values = np.ravel(x)
                if values.dtype.names == ("real", "imag"):
                    values = values["real"] + 1j * values["imag"]
                if values.dtype.kind in "iufc":
                    columns[name] = _numbers(values)
        return columns
