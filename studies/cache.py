"""The folder of compiled programs: where it is, who may write there, what it holds, emptying it.

XLA's own cache (`studies.config`) and what the package keeps itself (`studies.kernels.compilation`)
share it. Nothing here needs JAX.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from studies.errors import StudyError
from studies.results.labelled import Labelled, told

#: Names the folder instead of the user's cache folder; JAX's own name.
VARIABLE = "JAX_COMPILATION_CACHE_DIR"
#: Below the user's cache folder.
_NAME = "flexlink-studies"
#: What is kept, by kind; of XLA's files the names are JAX's, all others begin with their kind.
KINDS = {
    "xla": "programs in XLA's own cache",
    "program": "compiled programs",
    "data": "data of compiled programs",
    "kernel": "machine code of kernels",
    "passport": "outcomes of `studies verify`",
}
_OWN = re.compile(r"\.?(program|data|kernel|passport)-[0-9a-f]{64}(\.(\d+-)?[0-9a-f]{8}\.tmp)?")
_XLA = re.compile(r"\w+-[0-9a-f]{64}-(cache|atime)")


class Kept(Labelled):
    """Files of one kind."""

    kind: str = told("xla, program, data, kernel or passport")
    files: int = told("how many")
    bytes: int = told("how large together")


class CacheContents(Labelled, command="cache"):
    """What `studies cache --json` prints: compiled programs that are kept, or with --clear have
    been removed.
    """

    folder: str = told("where they are")
    is_cleared: bool = told("whether these files have been removed")
    kinds: tuple[Kept, ...] = told("of each kind")

    @property
    def files(self) -> int:
        return sum(one.files for one in self.kinds)

    @property
    def bytes(self) -> int:
        return sum(one.bytes for one in self.kinds)


def chosen_folder() -> Path:
    """Where compiled programs are to be kept, whether or not it is there."""
    base = os.environ.get("XDG_CACHE_HOME")
    default = Path(base) if base else Path.home() / ".cache"
    return Path(os.environ.get(VARIABLE) or default / _NAME)


def is_shared() -> bool:
    """Whether other programs that use JAX may keep theirs in the same folder."""
    return bool(os.environ.get(VARIABLE))


def is_usable(folder: Path) -> bool:
    """Whether a folder exists or can be created, and is writable."""
    try:
        # For this user only: anyone who can write to the cache can run code through it.
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def exposure(folder: Path) -> str:
    """Why others could put programs into a folder, and what helps; "" if they cannot.

    Raises:
        OSError: no such folder.
    """
    about = os.stat(folder)
    if about.st_uid != os.getuid():
        fault, cure = "belongs to another user", "name one of your own"
    elif about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        fault, cure = "can be written by others", f"`chmod go-w {folder}`, or name another one"
    else:
        return ""
    return (
        f"compiled programs are not cached: the folder {folder} {fault}, who could run code "
        f"through it; {cure} in {VARIABLE}"
    )


def cache_contents(is_cleared: bool = False) -> CacheContents:
    """Count the compiled programs that are kept on disk.

    Other processes may use the folder meanwhile; what they need anew they compile again.

    Args:
        is_cleared: also remove them. XLA's stay where other programs may have theirs, too
            (`is_shared`), and so does the user's key, which tells own files from others'.

    Returns:
        What there is, or what has been removed; nothing for a folder that does not exist.

    Raises:
        StudyError: others own the folder or can write there, or it cannot be read or emptied.
    """
    folder = chosen_folder()
    count = {kind: [0, 0] for kind in KINDS}
    try:
        if os.path.lexists(folder):
            _count(folder, count, is_cleared)
    except OSError as error:
        what = "cleared" if is_cleared else "read"
        raise StudyError(f"{folder}: cannot be {what} ({error.strerror or error})") from None
    kinds = tuple(Kept(kind, *both) for kind, both in count.items())
    return CacheContents(str(folder), is_cleared, kinds)


def _count(folder: Path, count: dict[str, list[int]], is_cleared: bool) -> None:
    """Add files and bytes by kind, and remove the files if wanted."""
    if fault := exposure(folder):
        raise StudyError(fault)
    for entry in os.scandir(folder):
        kind = _kind(entry.name)
        if not kind or (is_cleared and kind == "xla" and is_shared()):
            continue
        try:
            if not entry.is_file(follow_symlinks=False):
                continue
            size = entry.stat(follow_symlinks=False).st_size
            if is_cleared:
                os.unlink(entry.path)
        except FileNotFoundError:  # another process has removed it
            continue
        count[kind][0] += 1
        count[kind][1] += size


def _kind(name: str) -> str:
    """Kind of a file, "" if it is none of ours."""
    if match := _OWN.fullmatch(name):
        return match[1]
    return "xla" if _XLA.fullmatch(name) else ""
