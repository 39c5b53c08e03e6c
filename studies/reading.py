"""Reading files that somebody else may have made: regular, of bounded size, depth and content.

Every reader of the package opens its files here. Faults are `OSError` (with `strerror`) for the
file and `ValueError` for its content, so that the caller says whose file it is.
"""

from __future__ import annotations

import errno
import json
import mmap
import os
import stat
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, BytesIO
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np

#: Largest file that is read whole, and what a packed one may unpack to [bytes].
LARGEST = 2**26
#: Levels of tables and lists.
DEEPEST = 64
#: Digits of a whole number that is kept exactly.
_EXACT = 18
#: What compression can save [1], and what a dataset may take without any storage [bytes].
_PACKED, _SPARE = 1100, 2**20
#: How a collection of texts begins in an HDF5 file (its specification, section III.E).
_HEAP = b"GCOL\x01\0\0\0"


@contextmanager
def open_regular(path: Path) -> Iterator[BufferedReader]:
    """Open a file for reading, without waiting: a pipe or a device is refused.

    Raises:
        OSError: not there, not readable, or no regular file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        fault = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
        raise OSError(errno.EINVAL, fault)
    with os.fdopen(descriptor, "rb") as file:
        yield file


def read_bytes(path: Path, most: int = LARGEST) -> bytes:
    """Contents of a regular file of at most `most` bytes.

    Raises:
        OSError: as `open_regular`, or too large.
    """
    with open_regular(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"larger than {most / 2**20:g} MiB")
    return content


def read_text(path: Path, most: int = LARGEST, encoding: str = "utf-8") -> str:
    """The same as text, without the mark by which some editors tell its encoding.

    Raises:
        OSError: as `read_bytes`.
        ValueError: not of this encoding.
    """
    try:
        return read_bytes(path, most).decode(encoding).removeprefix("\ufeff")
    except UnicodeDecodeError:
        raise ValueError(f"not {encoding.upper()} text") from None


def read_json(path: Path) -> Any:
    """Contents of a JSON file; no name twice, whole numbers beyond 18 digits as floats.

    Raises:
        OSError: as `read_bytes`.
        ValueError: not JSON, a name twice, too deep, or text that no file could hold.
    """
    return parse_json(read_text(path))


def parse_json(text: str) -> Any:
    """The same from text; errors as `read_json`."""
    try:
        content = json.loads(text, object_pairs_hook=_unique, parse_int=_whole)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    check_depth(content)
    return content


_TOO_DEEP = f"nested deeper than {DEEPEST} levels"


def check_depth(content: Any) -> None:
    """Raise ValueError if nested deeper than `DEEPEST`, or if a text has half a character."""
    left = [(content, 0)]
    while left:
        value, depth = left.pop()
        if isinstance(value, str):
            _check_text(value)
        elif isinstance(value, (dict, list, tuple)):
            if depth == DEEPEST:
                raise ValueError(_TOO_DEEP)
            inner = value.values() if isinstance(value, dict) else value
            left += [(entry, depth + 1) for entry in inner]
            for name in value if isinstance(value, dict) else ():
                _check_text(name)


def _check_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"{text[:40]!a} is not text") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for name, value in pairs:
        if name in table:
            raise ValueError(f"{name[:40]!a} occurs twice")
        table[name] = value
    return table


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= _EXACT else float(digits)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Arrays of an NPZ file, numbers and text, after a look at the sizes that it declares.

    Raises:
        OSError: as `read_bytes`.
        ValueError: no such file, damaged, or unpacking to more than `LARGEST`.
    """
    return parse_npz(read_bytes(path))


def parse_npz(packed: bytes, most: int = LARGEST) -> dict[str, np.ndarray]:
    """The same from the file's contents, up to `most` bytes; errors as `read_npz`."""
    try:
        with zipfile.ZipFile(BytesIO(packed)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > most:
                raise ValueError(f"unpacks to more than {most / 2**20:g} MiB")
            return {
                member.filename.removesuffix(".npy"): _array(archive.read(member))
                for member in members
            }
    except ValueError:
        raise
    except Exception as error:  # of any kind, for a damaged archive
        raise ValueError(str(error) or "damaged") from None


def _array(content: bytes) -> np.ndarray:
    """An array in NumPy's format, if its content is as long as its header says."""
    file = BytesIO(content)
    version = np.lib.format.read_magic(file)
    headers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in headers:
        raise ValueError(f"an array in format {version[0]}.{version[1]}")
    shape, is_transposed, dtype = headers[version](file)
    if dtype.kind not in "biufcSU":
        raise ValueError(f"an array of {dtype}; allowed: numbers and text")
    begin = file.tell()
    if prod(shape) * dtype.itemsize != len(content) - begin:
        raise ValueError(f"an array of shape {shape} in {len(content) - begin} bytes")
    if not dtype.itemsize:
        return np.zeros(shape, dtype)
    flat = np.frombuffer(content, dtype, offset=begin)
    return flat.reshape(shape, order="F" if is_transposed else "C")


@contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file whose datasets are all in it and no larger than it can hold.

    Raises:
        OSError: as `open_regular`, or no HDF5.
        ValueError: damaged, a link to elsewhere, or a dataset too large for the file.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size:
            _check_heaps(file)
    with h5py.File(path, "r") as opened:
        try:
            _check_group(opened, _PACKED * size + _SPARE, set(), 0)
            yield opened
        except (RuntimeError, KeyError) as error:  # h5py's, for a damaged or missing part
            raise ValueError(str(error)) from None


def _check_heaps(file: BufferedReader) -> None:
    """Raise ValueError for texts of an HDF5 file whose sizes make HDF5 walk them without end."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        for begin, end in _written(file.fileno()):
            first = content.find(_HEAP, begin, end)
            while first >= 0:
                _check_heap(content, first)
                first = content.find(_HEAP, first + 1, end)


def _check_heap(content: mmap.mmap, first: int) -> None:
    at, stop = first + 16, first + int.from_bytes(content[first + 8 : first + 16], "little")
    while at + 16 <= min(stop, len(content)):
        number, _, _, length = struct.unpack("<HHIQ", content[at : at + 16])
        step = 16 + -(-length // 8) * 8 if number else length  # 0: the free rest
        if not 0 < step <= stop - at:
            raise ValueError("its texts have sizes that do not fit")
        at += step


def _written(file: int) -> Iterator[tuple[int, int]]:
    """Where an open file has content: a sparse one may be a terabyte long, and hold nothing."""
    end = 0
    while True:
        try:
            begin = os.lseek(file, end, os.SEEK_DATA)
        except OSError:  # none beyond
            return
        end = os.lseek(file, begin, os.SEEK_HOLE)
        yield begin, end


def _check_group(group: h5py.Group, most: int, seen: set[int], depth: int) -> None:
    """Raise ValueError for what leaves the file or takes more than `most` bytes."""
    if depth == DEEPEST:
        raise ValueError(_TOO_DEEP)
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{name!a} is a link to elsewhere")
        inner = group[name]
        address = h5py.h5o.get_info(inner.id).addr
        if address in seen:  # groups may hold one another
            continue
        seen.add(address)
        if isinstance(inner, h5py.Group):
            _check_group(inner, most, seen, depth + 1)
        elif isinstance(inner, h5py.Dataset):
            if inner.external or inner.is_virtual:
                raise ValueError(f"{name!a} keeps its data elsewhere")
            if inner.size is not None and inner.size * inner.dtype.itemsize > most:
                raise ValueError(f"{name!a} declares more data than the file can hold")
