"""Long work in a folder: begun once, kept as it goes on, interrupted at any moment, resumed.

`working` opens the folder of a command: it is locked against other processes, says what was asked
for (`request.json`), and what is found is kept there part by part. Results appear at the end, all
at once (`studies.publish`).

    with working("certify", out, request, PHASES, resume) as job:
        job.begin("judge")
        certificate = job.part("plants", lambda: certify(study))
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import current_process
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple, TypeVar

from studies import config, sources
from studies.console import make_console
from studies.errors import StudyError
from studies.parts import kept_part
from studies.phases import Phases
from studies.publish import TEMPORARY, is_open_as, replacing, reserving
from studies.reading import read_json

T = TypeVar("T")

LOCK, REQUEST = ".lock", "request.json"
#: Of the files in a folder: names of variables, contents of chunks.
FORMAT = 2
#: Names that an interrupted job can leave behind.
LEFTOVER = re.compile(rf"\.unfinished-.*|\.joined\.h5|\..+\.{TEMPORARY}")
_SOURCES = Path(__file__).parents[1]
#: Words of the command line, without the program's; () in a session of Python.
command: Sequence[str] = ()


class Kind(NamedTuple):
    """A kind of job."""

    what: str  # that its folder holds, with the article
    marks: tuple[str, ...] = (REQUEST,)  # what was asked for: one is there from the beginning

    @property
    def mark(self) -> str:
        """The usual one."""
        return self.marks[0]


#: By verb.
KINDS = {
    "sweep": Kind("a sweep", ("sweep.json", "screen.json")),
    "tune": Kind("a tuning", ("tune.json",)),
    "fit": Kind("a fit"),
    "certify": Kind("a certificate"),
    "compare": Kind("a comparison of laws"),
    "commission": Kind("a commissioning"),
    "verify": Kind("a verification"),
    "twin": Kind("a comparison with a twin"),
    "atlas": Kind("an atlas"),
    "paper": Kind("a paper's results"),
}
#: What must be the same in a folder that is gone on with, in words.
CHECKED = {
    "verb": "command",
    "spec": "input",
    "code": "program",
    "jaxlib": "jaxlib",
    "precision": "precision",
}


class Job:
    """Work under way: where it is kept, and how far it is.

    folder: of the work, None if nothing is written; phases: present and later ones.
    """

    def __init__(self, folder: Path | None, phases: Phases) -> None:
        self.folder, self.phases = folder, phases
        self.begin, self.advance, self.say = phases.begin, phases.advance, phases.say

    @property
    def place(self) -> Path:
        """The folder of work that cannot do without one."""
        assert self.folder is not None
        return self.folder

    def part(self, name: str, make: Callable[[], T], of: str = "") -> T:
        """What `make` finds, or has found before; arguments as in `kept_part`."""
        return make() if self.folder is None else kept_part(self.folder, name, of, make)

    @contextmanager
    def inside(self, name: str, names: Sequence[str] | Mapping[str, float] = ()) -> Iterator[Job]:
        """A job in a folder of this one's, which owns it; names: of its phases, () for these."""
        folder = self.folder and self.folder / name
        if folder is not None:
            folder.mkdir(exist_ok=True)
        if not names:
            yield Job(folder, self.phases)
            return
        with Phases(self.phases.console, names, self.phases.is_quiet) as phases:
            yield Job(folder, phases)


@contextmanager
def working(
    verb: str,
    out: str | Path | None,
    request: Mapping[str, Any] | None,
    names: Sequence[str] | Mapping[str, float],
    resume: bool = False,
    progress: bool = True,
    checked: Mapping[str, str] = CHECKED,
    fixed: Callable[[Any], Any] = lambda part: part,
) -> Iterator[Job]:
    """Work in a folder that holds nothing else, or in which the same was begun.

    Args:
        verb: one of `KINDS`.
        out: folder, created if missing; None: nothing is kept.
        request: from `make_request`, and more; None: the work itself keeps it.
        names: of the phases, as in `Phases`.
        resume: go on with what is in the folder, if anything.
        progress: show it.
        checked: entries of the request that must be the same, in words.
        fixed: what of such an entry must not change.

    Raises:
        StudyError: the folder cannot be written to, is in use, or holds something else.
        KeyboardInterrupt: Ctrl-C or SIGTERM; how to go on was said.
    """
    if out is None and resume:
        raise StudyError("--resume: name the folder with --out")
    config.require_configured()
    with Phases(make_console(), names, not progress) as phases:
        if out is None:
            yield Job(None, phases)
            return
        out = Path(out)
        with locked_folder(out, verb):
            refuse_existing(out, verb, resume)
            if request is not None:
                keep_request(out / KINDS[verb].mark, {"verb": verb, **request}, checked, fixed)
            with resumable(out):
                yield Job(out, phases)


def checked_out(out: str | Path | None) -> Path:
    """Where a verb writes.

    Raises:
        StudyError: nowhere.
    """
    if out is None:
        raise StudyError("--out: name a folder for the results")
    return Path(out)


def make_request(data: Mapping[str, Any], modules: Iterable[str]) -> dict[str, Any]:
    """What determines numbers, and what finds them.

    Args:
        data: what was asked for, as read.
        modules: those that determine the numbers, with everything they import.
    """
    return {
        "format": FORMAT,
        "spec": data,
        "code": sources.digest(*modules),
        "git": git_state(),
        **config.origin(),
    }


def keep_request(
    file: Path,
    request: Mapping[str, Any],
    checked: Mapping[str, str] = CHECKED,
    fixed: Callable[[Any], Any] = lambda part: part,
) -> None:
    """Write what is asked for to a file, or check that it was begun with the same.

    Args:
        request, checked, fixed: as in `working`.

    Raises:
        StudyError: the folder was begun with something else, or the file is damaged.
    """
    request = json.loads(json.dumps(request))
    if file.is_file():
        _check_request(file, request, checked, fixed)
    for left in file.parent.iterdir():  # only once their owner is known
        if LEFTOVER.fullmatch(left.name) and left.is_file():
            left.unlink()
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(request, indent=1), encoding="utf-8")


def _check_request(
    file: Path,
    request: Mapping[str, Any],
    checked: Mapping[str, str],
    fixed: Callable[[Any], Any],
) -> None:
    """Raise StudyError unless a folder was begun with the same; arguments as in `working`."""
    try:
        before = read_json(file)
    except (OSError, ValueError):
        before = None
    if not isinstance(before, dict):
        raise StudyError(f"{file}: damaged; name a new folder")
    for key, what in checked.items():
        old, new = before.get(key), request.get(key)
        if fixed(old) != fixed(new):
            values = "" if isinstance(new, dict) else f" ({old}, now {new})"
            raise StudyError(
                f"--out {file.parent}: was begun with another {what}{values}; name a new folder"
            )


def refuse_existing(path: Path, verb: str, is_resumed: bool) -> None:
    """Refuse a folder with results or other files; call it before long work.

    Args:
        path: the folder, which need not exist.
        verb: whose results it is to hold.
        is_resumed: whether these may be there already.

    Raises:
        StudyError: they are, and are not resumed; other files; no access.
    """
    try:
        there = _verb_of(path, verb)
        if not there and path.is_dir():
            _refuse_others(path)
    except OSError as error:
        raise StudyError(f"--out {path}: cannot write there ({error.strerror})") from None
    if there not in ("", verb):
        raise StudyError(f"--out {path}: holds {KINDS[there].what}; name a new folder")
    if there and not is_resumed:
        extend = " or to extend it" if verb == "sweep" else ""
        raise StudyError(
            f"--out {path}: holds {KINDS[verb].what} already; add --resume to go on with "
            f"it{extend}, or name a new folder"
        )


def _verb_of(path: Path, wanted: str) -> str:
    """Whose results a folder holds, "" if it holds none; those wanted if that cannot be read."""
    if (path / REQUEST).exists():
        with suppress(OSError, ValueError, TypeError, KeyError):
            written = read_json(path / REQUEST)["verb"]
            return written if written in KINDS else wanted
        return wanted
    marks = ((verb, mark) for verb, kind in KINDS.items() for mark in kind.marks)
    return next((verb for verb, mark in marks if (path / mark).exists()), "")


def _refuse_others(path: Path) -> None:
    """Raise StudyError if a new folder holds anything but its lock and leftovers of a kill."""
    names = [entry.name for entry in path.iterdir() if entry.name != LOCK]
    others = sorted(name for name in names if not LEFTOVER.fullmatch(name))
    if others:
        raise StudyError(
            f"--out {path}: holds other files ({', '.join(others[:3])}); name a new or empty folder"
        )


@contextmanager
def resumable(out: Path) -> Iterator[None]:
    """Say after Ctrl-C how work in a folder goes on."""
    try:
        yield
    except KeyboardInterrupt as error:
        if out.exists():
            safe = str(error) or "finished work is safe"
            print(f"studies: {safe}; continue with: {again()}", file=sys.stderr)
        raise


def again() -> str:
    """The present command line with --resume; in a session of Python, the argument."""
    if not command:
        return "resume=True"
    words = ["studies", *command, *([] if "--resume" in command else ["--resume"])]
    return " ".join(map(quote, words))


def _at_once(path: str, flags: int) -> int:
    """Open a file, or fail: a pipe would wait for its reader."""
    return os.open(path, flags | os.O_NONBLOCK, 0o666)


@contextmanager
def locked_folder(path: Path, verb: str) -> Iterator[None]:
    """Reserve a folder for this process, creating it if necessary.

    It stays reserved only as long as it has its name, see `check_reserved`. What is refused leaves
    no trace: lock, request and folders made here go again if an error ends it before anything
    else is in them.

    Args:
        path: the folder.
        verb: what is done there.

    Raises:
        StudyError: not writable or in use.
    """
    try:
        created = [folder for folder in (path, *path.parents) if not folder.exists()]
        before = set(path.iterdir()) if path.is_dir() else set()
        path.mkdir(parents=True, exist_ok=True)
        lock = open(path / LOCK, "a", opener=_at_once)  # noqa: SIM115 (held as long as the folder is)
    except FileExistsError:
        raise StudyError(f"--out {path}: this is a file; name a folder") from None
    except OSError as error:
        raise StudyError(f"--out {path}: cannot write there ({error.strerror})") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if getattr(current_process(), "_inheriting", False):  # a worker imports the script
                sys.exit(1)  # who has the folder says why
            text = f"another process is at work on {KINDS[verb].what} there"
            raise StudyError(f"--out {path}: {text}") from None
        except OSError as error:
            raise StudyError(
                f"--out {path}: cannot be locked against other processes ({error.strerror}); name "
                "a folder on another file system"
            ) from None
        try:
            with reserving(path / LOCK, lock.fileno()):
                yield
        except Exception:
            made = {path / name for name in (LOCK, *KINDS[verb].marks)}
            is_here = is_open_as(path / LOCK, lock.fileno())
            if is_here and set(path.iterdir()) - before <= made:
                for file in made - before:
                    file.unlink(missing_ok=True)
                with suppress(OSError):  # somebody else has used one meanwhile
                    for folder in created:
                        folder.rmdir()
            raise


def git_state() -> str:
    """Commit of the sources, "unknown" outside a repository."""
    command = ["git", "-C", str(_SOURCES), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip()
