"""Files of studies, sweeps and tunings: finding and reading them."""

from __future__ import annotations

import hashlib
import os
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from studies.errors import DataWarning, StudyError, field_error, nearest, shown
from studies.reading import check_depth, read_text
from studies.study.state_space import with_matrices

T = TypeVar("T")

#: Folder of the package's ready-made files, available by name.
READY = Path(__file__).parents[1] / "specs"
#: Begins a study file that a command has written into its folder.
SIGNATURE = "# Written by the command; the digest of what follows: "
#: Bytes of a file's name that file systems take.
LONGEST_NAME = 255


def find_spec(name: str | Path) -> Path:
    """A file, or the ready-made one of that name if there is no such file.

    Raises:
        StudyError: neither exists, but a ready-made one has nearly that name.
    """
    path = Path(name)
    if len(os.fsencode(path.name)) > LONGEST_NAME:
        raise StudyError(f"{shown(str(path))}: cannot be read (name too long)")
    if path.is_file() or len(path.parts) > 1 or path.suffix not in ("", ".toml"):
        return path
    ready = {file.stem: file for file in READY.glob("*.toml")}
    hint = nearest(path.stem, ready)
    if path.stem not in ready and hint and not path.exists():
        raise StudyError(f"{path}: cannot be read (no such file); did you mean {hint!r}?")
    return ready.get(path.stem, path)


def ready_text(name: str) -> str:
    """The ready-made file of a name.

    Raises:
        StudyError: there is none.
    """
    ready = {file.stem: file for file in READY.glob("*.toml")}
    if name not in ready:
        raise field_error("--from", name, ", ".join(sorted(ready)), hint=nearest(name, ready))
    return ready[name].read_text(encoding="utf-8")


def as_given(what: Any, kind: type[T], load: Callable[[str | Path], T]) -> T:
    """What a verb is given: of a kind, or the file of one, or the name of a ready-made one.

    Raises:
        StudyError: something else, or as `load`.
    """
    if isinstance(what, str | Path):
        return load(what)
    if not isinstance(what, kind):
        raise StudyError(f"{type(what).__name__}; expected a {kind.__name__}, or its file")
    return what


def read_toml(name: str | Path) -> dict[str, Any]:
    """A TOML file, found by `find_spec`, as a dictionary; a controller's file is put in.

    Raises:
        StudyError: not found, unreadable or not TOML.
    """
    path = find_spec(name)
    try:
        text = read_text(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise StudyError(f"study file {path}: cannot be read ({reason})") from None
    if text.startswith(SIGNATURE) and not _is_signed(text):
        edited = f"{path}: edited since the command has written it; no longer its result"
        warnings.warn(edited, DataWarning, stacklevel=2)
    try:
        data = tomllib.loads(text)
        check_depth(data)
    except (ValueError, RecursionError) as error:  # ValueError: also a number of 5000 digits
        raise StudyError(f"study file {path}: not valid TOML ({error})") from None
    return with_matrices(data, path.parent)


def signed(text: str) -> str:
    """A study file whose first line tells whether somebody has edited it since."""
    return f"{SIGNATURE}{hashlib.sha256(text.encode()).hexdigest()[:16]}\n{text}"


def is_as_written(path: Path) -> bool:
    """Whether a file is one that a command has signed, unchanged."""
    try:
        return _is_signed(read_text(path))
    except (OSError, ValueError):
        return False


def _is_signed(text: str) -> bool:
    text = text.replace("\r\n", "\n")  # of an editor that has changed nothing else
    return text == signed(text.partition("\n")[2])
