"""Labelled results in one file: netCDF-4, written by h5netcdf, which xarray opens by name.

Every axis has its coordinate, every variable its units and long name, and the file appears whole or
not at all. xarray itself takes a second to import; commands do without it.
"""

from __future__ import annotations

import math
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from studies.errors import StudyError
from studies.publish import check_target, replacing
from studies.reading import open_hdf5
from studies.results.labelled import Variable

# What the words of flag_meanings may not contain.
_NO_FLAG = re.compile(r"[^A-Za-z0-9_.+@-]+")
_TEXT = h5py.string_dtype("utf-8")
#: Files up to this size are built in memory: HDF5 itself can crash on a full disk [bytes].
_IN_MEMORY = 2**26
#: Rows are written in blocks of this size [bytes].
BLOCK_BYTES = 2**25


class LazyArray(NamedTuple):
    """An array too large for memory, read some rows at a time."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[slice], np.ndarray]


def write_store(
    path: str | Path, variables: Mapping[str, Variable], attributes: Mapping[str, Any]
) -> None:
    """Write variables and global attributes to a netCDF-4 file, replacing an existing one.

    path: the file; its folder must exist. attributes: text, numbers or lists of one of them.
    An axis without a coordinate gets its numbers, from 1. Booleans become int8.

    Raises StudyError for a target that cannot be written; an existing file at `path` is then left
    unchanged.
    """
    check_target(path)
    variables = {
        name: variable._replace(data=_array(variable.data))
        for name, variable in with_coordinates(variables).items()
    }
    needed = sum(_size(variable.data) for variable in variables.values())
    with replacing(path) as temporary:
        if needed > _IN_MEMORY:
            _check_room(path, needed)
            _write(temporary, variables, attributes)
        else:
            image = BytesIO()
            _write(image, variables, attributes)
            temporary.write_bytes(image.getbuffer())


def _array(data: Any) -> np.ndarray | LazyArray:
    return data if isinstance(data, LazyArray) else np.asarray(data)


def _write(target: Any, variables: Mapping[str, Variable], attributes: Mapping[str, Any]) -> None:
    import h5netcdf

    with h5netcdf.File(target, "w") as file:
        file.attrs.update(attributes)
        file.dimensions = axis_sizes(variables)
        for name, variable in variables.items():
            data = variable.data
            dtype = {"b": np.int8, "U": _TEXT, "O": _TEXT}.get(data.dtype.kind, data.dtype)
            stored = file.create_variable(name, variable.dims, dtype)
            stored.attrs.update(variable_labels(variable))
            if isinstance(data, LazyArray):
                for rows in _blocks(data):
                    stored[rows] = data.read(rows)
            else:
                stored[...] = data.astype(dtype)


def _blocks(data: LazyArray) -> Iterator[slice]:
    """Rows of at most `BLOCK_BYTES` together."""
    count = max(1, BLOCK_BYTES // (data.dtype.itemsize * math.prod(data.shape[1:])))
    for start in range(0, data.shape[0], count):
        yield slice(start, min(start + count, data.shape[0]))


def _size(data: np.ndarray | LazyArray) -> int:
    """Bytes in the file, about."""
    text, labels = 32, 4096
    item = text if data.dtype.kind in "UO" else data.dtype.itemsize
    return labels + item * math.prod(data.shape)


def _check_room(path: str | Path, needed: int) -> None:
    """Raise StudyError if the disk has no room for so many bytes."""
    free = shutil.disk_usage(Path(os.path.realpath(path)).parent).free
    if free < 1.1 * needed:
        raise StudyError(
            f"{path}: cannot write it, {needed / 2**20:.1f} MiB are needed and "
            f"{free / 2**20:.1f} MiB are free"
        )


def numbers_digest(arrays: Mapping[str, Any]) -> str:
    """Hash of arrays with their names, as an attribute that tells whether a file was changed."""
    digest = sha256()
    for name in sorted(arrays):
        data = np.asarray(arrays[name])
        digest.update(f"{name} {data.dtype} {data.shape} ".encode() + data.tobytes())
    return digest.hexdigest()


def axis_sizes(variables: Mapping[str, Variable]) -> dict[str, int]:
    """Length of each axis."""
    return {
        axis: size
        for variable in variables.values()
        for axis, size in zip(variable.dims, _shape(variable.data), strict=True)
    }


def _shape(data: Any) -> tuple[int, ...]:
    return data.shape if isinstance(data, LazyArray) else np.shape(data)


def with_coordinates(variables: Mapping[str, Variable]) -> dict[str, Variable]:
    """The same, and the numbers from 1 of every axis without a coordinate."""
    numbers = {
        axis: Variable(np.arange(1, size + 1), (axis,), "1", f"number of {axis}")
        for axis, size in axis_sizes(variables).items()
        if axis not in variables
    }
    return dict(variables) | numbers


def variable_labels(variable: Variable) -> dict[str, Any]:
    """Attributes of a variable, named as in the CF conventions."""
    labels: dict[str, Any] = {"units": variable.units, "long_name": variable.long_name}
    if variable.flags:
        words = (_NO_FLAG.sub("_", text) for text in variable.flags.values())
        labels["flag_values"] = np.array(list(variable.flags), variable.data.dtype)
        labels["flag_meanings"] = " ".join(words)
    return labels


def read_store(path: str | Path) -> tuple[dict[str, Variable], dict[str, Any]]:
    """Read what `write_store` wrote: the variables, coordinates with them, and attributes.

    Raises StudyError if there is no such file or it is not a store.
    """
    if not Path(path).is_file():
        raise StudyError(f"{path}: no such file")
    try:
        with open_hdf5(Path(path)) as file:  # a third of the time that h5netcdf needs
            variables = {name: _read_variable(name, stored) for name, stored in file.items()}
            attributes = {
                name: value.squeeze().tolist() if isinstance(value, np.ndarray) else value
                for name, value in file.attrs.items()
                if name != "_NCProperties"
            }
    except (OSError, RuntimeError, LookupError, AttributeError, TypeError, ValueError) as error:
        raise StudyError(f"{path}: not a store of results ({error})") from error
    return variables, attributes


def _read_variable(name: str, stored: h5py.Dataset) -> Variable:
    is_text = h5py.check_string_dtype(stored.dtype) is not None
    data = np.array(stored.asstr()[()], str) if is_text else np.asarray(stored[()])
    dims = (name,) if stored.is_scale else tuple(axis.keys()[0] for axis in stored.dims)
    labels, flags = dict(stored.attrs), None
    if "flag_values" in labels:
        words = labels["flag_meanings"].split()
        flags = dict(zip(labels["flag_values"].tolist(), words, strict=True))
    return Variable(data, dims, labels["units"], labels["long_name"], flags)
