"""Publishing results: files appear in their folder when all of them are whole, or not at all."""

from __future__ import annotations

import errno
import glob
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from studies.errors import StudyError

#: Of every command that writes a folder.
REPORT = "report.html"
#: Of those whose cases can be looked at.
EXPLORER = "explorer.html"
#: End of the name of a file that says why a figure of that name is missing.
FAULT = ".fault"
#: Name prefix of the folders in which files are prepared.
_STAGED = ".unfinished-"
#: End of the name under which a file is written: the process (older ones had none), and what tells
#: its files apart.
TEMPORARY = r"(?:(\d+)-)?[0-9a-f]{8}\.tmp"
#: What says that a folder is whole moves there last: its page, then its document.
_LAST = (".html", ".json")


def check_folder(out: str | Path) -> None:
    """Raise StudyError if `out` cannot be a folder with files; call it before long work."""
    out = Path(out)
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


#: Locks of the folders that are reserved here: their paths and open files.
_RESERVED: ContextVar[tuple[tuple[Path, int], ...]] = ContextVar("reserved", default=())


@contextmanager
def reserving(lock: Path, descriptor: int) -> Iterator[None]:
    """Meanwhile, what is written into the folder of a lock is written only if it is still there."""
    token = _RESERVED.set((*_RESERVED.get(), (lock, descriptor)))
    try:
        check_reserved(lock)
        yield
    except (OSError, StudyError):
        check_reserved(lock)  # the reason why files are missing
        raise
    finally:
        _RESERVED.reset(token)


def check_reserved(path: str | Path) -> None:
    """Raise StudyError if a reserved folder that `path` is in was renamed or removed.

    A lock is held on a file and all else goes by name: under it there may be somebody else's work.
    """
    for lock, descriptor in _RESERVED.get():
        is_inside = Path(os.path.abspath(path)).is_relative_to(os.path.abspath(lock.parent))
        if is_inside and not is_open_as(lock, descriptor):
            raise StudyError(
                f"--out {lock.parent}: was renamed or removed while work went on in it; what is "
                "finished is where it went, and nothing more is written under the old name"
            )


def is_open_as(path: Path, descriptor: int) -> bool:
    """Whether the file at a path is the open one."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except OSError:
        return False


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path that becomes `path` on success, and is removed on any failure.

    Those that killed processes left are removed. Write errors are raised as StudyError.
    """
    check_reserved(path)
    check_target(path)
    target = Path(os.path.realpath(path))
    start = f".{target.name}."
    temporary = target.with_name(f"{start}{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        for left in target.parent.glob(f"{glob.escape(start)}*.tmp"):
            name = re.fullmatch(TEMPORARY, left.name.removeprefix(start))
            if name and name[1] and not _is_alive(name[1]):
                left.unlink(missing_ok=True)
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        check_reserved(path)  # the content may have taken long
        os.replace(temporary, target)
    except OSError as error:
        raise StudyError(f"{path}: cannot write it ({error.strerror or error})") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def publish(out: str | Path, stale: Iterable[str] = ()) -> Iterator[Path]:
    """Yield a folder whose files move to `out` at the end; on a failure, none does.

    The folder is prepared inside `out`, which is created if missing. Files of the same names are
    replaced, others are left alone. What a killed process left unfinished is removed. Page and
    document move last, and earlier ones go first: where they are, all files are of one result.

    Args:
        out: where the files appear.
        stale: names of files of an earlier result, removed unless they are written again.

    Raises:
        StudyError: the folder cannot be written to, or a file cannot be moved there.
    """
    out = Path(out)
    check_reserved(out)
    is_new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        for left in out.glob(f"{_STAGED}*"):
            if not _is_alive(left.name.removeprefix(_STAGED).partition("-")[0]):
                shutil.rmtree(left, ignore_errors=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=f"{_STAGED}{os.getpid()}-") as folder:
            yield Path(folder)
            check_reserved(out)
            names = sorted(os.listdir(folder), key=_place)
            for name in names:
                check_target(out / name)
            for name in sorted(set(stale) - set(names), key=_place, reverse=True):
                (out / name).unlink(missing_ok=True)
            for name in reversed(names if len(names) > 1 else []):
                if Path(name).suffix in _LAST:
                    Path(os.path.realpath(out / name)).unlink(missing_ok=True)
            for name in names:
                os.replace(Path(folder) / name, os.path.realpath(out / name))
    except OSError as error:
        raise StudyError(f"--out {out}: cannot write there ({error.strerror or error})") from error
    finally:
        if is_new and out.is_dir() and not any(out.iterdir()):
            out.rmdir()


#: Of errors for want of room.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def working_folder() -> Iterator[Path]:
    """Yield a folder for files that only this process needs.

    Raises:
        StudyError: there is none, or it has no room.
    """
    try:
        folder = tempfile.TemporaryDirectory()
    except OSError as error:
        raise StudyError(_no_room("temporary files", error)) from None
    with folder as name:
        try:
            yield Path(name)
        except OSError as error:
            if error.errno not in _FULL:
                raise
            raise StudyError(_no_room(name, error)) from None


def _no_room(where: str, error: OSError) -> str:
    return f"{where}: cannot write ({error.strerror}); name a folder with room in TMPDIR"


def _place(name: str) -> tuple[int, str]:
    """Sorts names of files in the order in which they move."""
    suffix = Path(name).suffix
    return (1 + _LAST.index(suffix) if suffix in _LAST else 0), name


def _is_alive(process: str) -> bool:
    """Whether a process of that number runs on this machine."""
    try:
        os.kill(int(process), 0)
    except PermissionError:
        return True
    except (ValueError, OSError, OverflowError):
        return False
    return True
