"""Parts of long work, each kept in a file once it is found: work that is resumed repeats none.

A part is made of named tuples, results, studies, lists and dictionaries of arrays, numbers and
texts. It is written as arrays with a description of how they nest, so that reading runs no code.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from studies.publish import replacing
from studies.reading import parse_npz, read_bytes
from studies.store import numbers_digest

T = TypeVar("T")

#: Folder of the parts.
PARTS = "parts"
#: Largest file of a part [bytes].
LARGEST = 2**31
#: Packages whose records a file can name.
_PACKAGES = ("jaxmodel.", "studies.")


def kept_part(folder: Path, name: str, of: str, make: Callable[[], T]) -> T:
    """What `make` finds, or found before.

    Args:
        folder: of the work.
        name: of the part, in words.
        of: what the part depends on, beside what the folder was begun with.
        make: finds it.

    Returns:
        The part as it is written, whether it was there or not.

    Raises:
        StudyError: it cannot be written.
    """
    path = folder / PARTS / f"{re.sub('[^a-z0-9]+', '_', name.lower()).strip('_')}.npz"
    try:
        return _read(path, of)
    except Exception:  # of any kind: not there, of something else or damaged; it is found again
        pass
    arrays: dict[str, np.ndarray] = {}
    form = packed(make(), arrays)
    written = arrays | {"form": np.array(json.dumps(form))}
    whole: Any = {**written, "digest": numbers_digest(written), "of": of}
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **whole)
    return cast("T", unpacked(form, arrays))


def _read(path: Path, of: str) -> Any:
    arrays = parse_npz(read_bytes(path, LARGEST), LARGEST)
    wanted, digest = (str(arrays.pop(name)) for name in ("of", "digest"))
    if wanted != of or digest != numbers_digest(arrays):
        raise ValueError("of something else")
    return unpacked(json.loads(str(arrays.pop("form"))), arrays)


def packed(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """How a value nests, for JSON; its arrays are added to `arrays`."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | bool | int | float):
        return {"item": value}
    if isinstance(value, np.ndarray) and value.dtype == object:
        return {"objects": [packed(x, arrays) for x in value.flat], "shape": value.shape}
    if isinstance(value, complex) or hasattr(value, "__array__"):
        name = f"x{len(arrays)}"
        arrays[name] = np.asarray(value)
        return {"number" if isinstance(value, complex) else "array": name}
    kind = type(value)
    if kind in (list, tuple):
        return {kind.__name__: [packed(x, arrays) for x in value]}
    name = f"{kind.__module__}:{kind.__qualname__}"
    if isinstance(value, Mapping):
        pairs = [[packed(x, arrays) for x in pair] for pair in value.items()]
        is_own = issubclass(kind, dict) and name.startswith(_PACKAGES)
        return {"of": pairs, "as": name if is_own else ""}
    if hasattr(value, "model_dump"):  # a study
        return {"model": name, "fields": value.model_dump(mode="json", exclude_unset=True)}
    fields = {x: packed(getattr(value, x), arrays) for x in _fields(kind)}
    return {"record": name, "fields": fields}


def unpacked(form: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The value that `packed` has described."""
    kind, content = next(iter(form.items()))
    if kind == "array":
        return arrays[content]
    if kind in ("item", "number"):
        return content if kind == "item" else arrays[content].item()
    if kind == "objects":
        found = np.empty(len(content), object)
        found[:] = [unpacked(x, arrays) for x in content]
        return found.reshape(form["shape"])
    if kind == "of":
        made = {unpacked(x, arrays): unpacked(y, arrays) for x, y in content}
        return _named(form["as"], dict)(made) if form["as"] else made
    if kind in ("list", "tuple"):
        entries = [unpacked(x, arrays) for x in content]
        return entries if kind == "list" else tuple(entries)
    record = _named(content)
    if kind == "model":
        return record.parse(form["fields"])
    fields = {x: unpacked(y, arrays) for x, y in form["fields"].items()}
    if tuple(fields) != _fields(record):
        raise ValueError(f"{content} has other fields")
    return record(**fields)


def _named(text: str, of: type = object) -> Any:
    """A class of this program, by module and name, derived from another one."""
    module, _, name = text.partition(":")
    found = getattr(import_module(module), name) if module.startswith(_PACKAGES) else None
    if not isinstance(found, type) or not issubclass(found, of):
        raise ValueError(f"{text} is no {of.__name__} of this program")
    return found


def _fields(record: type) -> tuple[str, ...]:
    """Of a named tuple or a dataclass.

    Raises:
        TypeError: it is neither.
    """
    if dataclasses.is_dataclass(record):
        return tuple(x.name for x in dataclasses.fields(record))
    if not hasattr(record, "_fields"):
        raise TypeError(f"{record.__name__}: no part of work can hold it")
    return tuple(record._fields)
