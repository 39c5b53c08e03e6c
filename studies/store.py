"""Labelled results in one file: netCDF-4 written as plain HDF5, which xarray opens by name.

Every axis has a dimension scale, every variable its units and long name, and the file appears
whole or not at all.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from studies.errors import StudyError, field_error
from studies.reading import open_hdf5

# What netCDF, HDF5 and xarray's attribute access all take as a name.
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
# What the words of flag_meanings may not contain.
_NO_FLAG = re.compile(r"[^A-Za-z0-9_.+@-]+")
#: Name prefix of the folders of `staged`.
_STAGED = ".unfinished-"
_TEXT = h5py.string_dtype("utf-8")


class Streamed(NamedTuple):
    """Data too large for memory, written part by part along the first axis.

    parts: called once, yields (first row, rows); what no part covers is NaN or -1.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    parts: Callable[[], Iterable[tuple[int, np.ndarray]]]

    @property
    def ndim(self) -> int:
        return len(self.shape)


class Variable(NamedTuple):
    """One labelled array.

    data: numbers, booleans or text, one axis per name in dims; `Streamed` only for writing.
    dims: name of each axis; a one-dimensional variable named like its axis is its coordinate.
    units: SI symbol such as "m" or "Hz", "1" for none. Not "seconds": xarray turns that into dates.
    long_name: what it is, in words.
    flags: meaning of each number, for codes; flag_values and flag_meanings in the file, _ for " ".
    """

    data: Any
    dims: tuple[str, ...]
    units: str
    long_name: str
    flags: Mapping[int, str] | None = None


def write_store(
    path: str | Path, variables: Mapping[str, Variable], attributes: Mapping[str, Any]
) -> None:
    """Write variables and global attributes to a netCDF-4 file, replacing an existing one.

    path: the file; its folder must exist. attributes: text, numbers or lists of one of them.
    An axis without a coordinate gets its numbers, from 1. Booleans become int8.

    Raises StudyError for a target that cannot be written, and for data that netCDF cannot label or
    hold; an existing file at `path` is then left unchanged.
    """
    check_target(path)
    arrays = {name: _stored(name, variable) for name, variable in variables.items()}
    sizes = _axis_sizes(variables, arrays)
    labels = {name: _attribute(name, value) for name, value in attributes.items()}
    coordinates = {
        axis: Variable(np.arange(1, size + 1), (axis,), "1", f"number of {axis}")
        for axis, size in sizes.items()
        if axis not in variables
    }
    arrays |= {axis: coordinate.data for axis, coordinate in coordinates.items()}
    everything = coordinates | dict(variables)

    def fill(file: h5py.File) -> None:
        file.attrs.update(labels)
        for name, variable in everything.items():
            dataset = _dataset(file, name, arrays[name])
            dataset.attrs.update(variable_labels(variable))
        for axis in sizes:
            file[axis].make_scale(axis)
        for name, variable in variables.items():
            if name not in sizes:
                for position, axis in enumerate(variable.dims):
                    file[name].dims[position].attach_scale(file[axis])

    with replacing(path) as temporary:
        # HDF5 itself can crash on a full disk: build small files in memory, check space for others
        if any(isinstance(array, Streamed) for array in arrays.values()):
            _check_room(path, arrays)
            with h5py.File(temporary, "w", track_order=True) as file:
                fill(file)
        else:
            image = BytesIO()
            with h5py.File(image, "w", track_order=True) as file:
                fill(file)
            temporary.write_bytes(image.getbuffer())


def _dataset(file: h5py.File, name: str, array: np.ndarray | Streamed) -> h5py.Dataset:
    if not isinstance(array, Streamed):
        return file.create_dataset(name, data=array, track_order=True)
    empty = np.nan if array.dtype.kind == "f" else -1
    dataset = file.create_dataset(
        name, array.shape, array.dtype, fillvalue=empty, fletcher32=True, track_order=True
    )
    for start, rows in array.parts():
        dataset[start : start + len(rows)] = rows
    return dataset


def _check_room(path: str | Path, arrays: Mapping[str, np.ndarray | Streamed]) -> None:
    """Raise StudyError if the disk has no room for the arrays."""
    text, labels = 32, 4096  # estimated bytes of a short text, and of a variable's labels
    needed = sum(
        labels
        + float(np.prod(np.array(array.shape, float)))
        * (text if array.dtype.kind == "O" else array.dtype.itemsize)
        for array in arrays.values()
    )
    free = shutil.disk_usage(Path(os.path.realpath(path)).parent).free
    if free < 1.1 * needed:
        raise StudyError(
            f"{path}: cannot write it, {needed / 2**20:.1f} MiB are needed and "
            f"{free / 2**20:.1f} MiB are free"
        )


def variable_labels(variable: Variable) -> dict[str, Any]:
    """Attributes of a variable, named as in the CF conventions."""
    labels: dict[str, Any] = {"units": variable.units, "long_name": variable.long_name}
    if variable.flags:
        words = (_NO_FLAG.sub("_", text) for text in variable.flags.values())
        labels["flag_values"] = np.array(list(variable.flags), variable.data.dtype)
        labels["flag_meanings"] = " ".join(words)
    return labels


def read_store(path: str | Path) -> tuple[dict[str, Variable], dict[str, Any]]:
    """Read what `write_store` wrote: the variables, index coordinates with them, and attributes.

    Raises StudyError if there is no such file or it is not a store.
    """
    if not Path(path).is_file():
        raise StudyError(f"{path}: no such file")
    try:
        with open_hdf5(Path(path)) as file:
            variables = {name: _read_variable(dataset) for name, dataset in file.items()}
            attributes = {name: _plain(value) for name, value in file.attrs.items()}
    except (OSError, RuntimeError, KeyError, AttributeError, TypeError, ValueError) as error:
        raise StudyError(f"{path}: not a store of results ({error})") from error
    return variables, attributes


def check_target(path: str | Path) -> None:
    """Raise StudyError unless a file can be written at `path`; call it before long work."""
    target = Path(os.path.realpath(path))
    folder = target.parent
    if not folder.is_dir():
        raise StudyError(f"{path}: cannot write there, {folder} is not a folder; create it first")
    try:
        is_there = target.exists()
    except OSError as error:  # a name that is too long
        raise StudyError(f"{path}: cannot write there ({error.strerror})") from None
    if is_there and not target.is_file():
        raise StudyError(f"{path}: cannot write there, it is a folder or a device; name a file")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise StudyError(f"{path}: cannot write there, no permission for the folder {folder}")
    if target.exists() and not os.access(target, os.W_OK):
        raise StudyError(f"{path}: cannot write there, the file is write-protected")


def check_folder(out: Path) -> None:
    """Raise StudyError if `out` cannot be a folder with files; call it before long work."""
    there = Path(os.path.abspath(out))
    while not os.path.lexists(there):
        there = there.parent
    if not there.is_dir():
        raise StudyError(f"--out {out}: {there} is not a folder; name another one")
    most = os.pathconf(there, "PC_NAME_MAX")
    longest = max((len(os.fsencode(part)) for part in out.parts), default=0)
    if longest > most:
        raise StudyError(f"--out: a name of {longest} bytes; allowed: {most} at most")
    if not os.access(there, os.W_OK | os.X_OK):
        raise StudyError(f"--out {out}: no permission to write in {there}")


def _is_alive(process: str) -> bool:
    """Whether a process of that number runs on this machine."""
    try:
        os.kill(int(process), 0)
    except PermissionError:
        return True
    except (ValueError, OSError, OverflowError):
        return False
    return True


@contextmanager
def staged(out: Path) -> Iterator[Path]:
    """Yield a folder inside `out` whose files move to `out` at the end; on a failure, none does.

    Leftovers of a killed process are removed.

    Args:
        out: folder that exists.

    Raises:
        StudyError: a file cannot be moved there; then none is.
    """
    for left in out.glob(f"{_STAGED}*"):
        if not _is_alive(left.name.removeprefix(_STAGED).partition("-")[0]):
            shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=f"{_STAGED}{os.getpid()}-") as folder:
        yield Path(folder)
        files = sorted(Path(folder).iterdir())
        for file in files:
            check_target(out / file.name)
        for file in files:
            os.replace(file, out / file.name)


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path that becomes `path` on success, and is removed on any failure.

    Write errors are raised as StudyError.
    """
    check_target(path)
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise StudyError(f"{path}: cannot write it ({error.strerror or error})") from error
    finally:
        temporary.unlink(missing_ok=True)


def _stored(name: str, variable: Variable) -> np.ndarray | Streamed:
    """The array as the file holds it, or StudyError for what netCDF cannot label or hold."""
    _check_name("variable", name)
    for label in ("units", "long_name"):
        text = getattr(variable, label)
        if not text:
            raise field_error(f"{name}.{label}", text, "a text that is not empty")
    data = variable.data
    if not isinstance(data, Streamed):
        data = np.asarray(data)
    dims = variable.dims
    for axis in dims:
        _check_name(f"dimension of {name}", axis)
    if len(dims) != data.ndim or len(set(dims)) != len(dims):
        raise field_error(f"{name}.dims", dims, f"one distinct name for each of {data.ndim} axes")
    if name in dims and len(dims) > 1:
        raise field_error(f"{name}.dims", dims, f"only ({name!r},) for the coordinate of {name}")
    return data if isinstance(data, Streamed) else _storable(name, data)


def _storable(field: str, data: np.ndarray) -> np.ndarray:
    """Text as UTF-8 strings, booleans as int8, numbers unchanged; StudyError for the rest."""
    if data.dtype.kind == "U" or (
        data.dtype.kind == "O" and all(isinstance(value, str) for value in data.flat)
    ):
        if any("\0" in text for text in data.flat):
            raise field_error(field, "text with a NUL character", "text without NUL characters")
        return data.astype(_TEXT)
    if data.dtype.kind == "b":
        return data.astype(np.int8)
    if data.dtype.kind in "iu" or data.dtype in (np.float32, np.float64):
        return data
    raise field_error(f"type of {field}", data.dtype, "integers, float32, float64, bool or text")


def _axis_sizes(
    variables: Mapping[str, Variable], arrays: Mapping[str, np.ndarray | Streamed]
) -> dict[str, int]:
    """Length of each axis, which must be the same in all variables."""
    sizes: dict[str, int] = {}
    for name, variable in variables.items():
        for axis, size in zip(variable.dims, arrays[name].shape, strict=True):
            if sizes.setdefault(axis, size) != size:
                raise field_error(
                    f"length of {name} along {axis}", size, f"{sizes[axis]} as in other variables"
                )
    for axis in sizes:
        if axis in variables and variables[axis].dims != (axis,):
            raise field_error(f"{axis}.dims", variables[axis].dims, f"({axis!r},), it is an axis")
    return sizes


def _attribute(name: str, value: Any) -> Any:
    """A global attribute as the file holds it."""
    _check_name("attribute", name)
    data = np.asarray(value)
    if data.ndim > 1:
        raise field_error(f"shape of attribute {name}", data.shape, "one value or a list")
    return _storable(f"attribute {name}", data)


def _check_name(kind: str, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise field_error(kind, name, "letters, digits and _, not beginning with a digit")


def _read_variable(dataset: h5py.Dataset) -> Variable:
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    data = dataset.asstr()[()] if is_text else dataset[()]
    if dataset.is_scale:
        dims: tuple[str, ...] = (dataset.name.lstrip("/"),)
    else:
        dims = tuple(axis[0].name.lstrip("/") for axis in dataset.dims)
    array = np.asarray(data, dtype=str if is_text else None)
    labels = dataset.attrs
    flags = None
    if "flag_values" in labels:
        words = labels["flag_meanings"].split()
        flags = dict(zip(labels["flag_values"].tolist(), words, strict=True))
    return Variable(array, dims, labels["units"], labels["long_name"], flags)


def _plain(value: Any) -> Any:
    """An attribute as Python text or number if it is one value, otherwise as an array."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        return value.astype(str)
    return value.item() if isinstance(value, np.generic) else value
