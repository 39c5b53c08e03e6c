"""The folder of a sweep: every finished chunk survives however the run ends.

`sweep.json` records what is run and by which code. Each chunk is one file in `chunks/`, whose name
contains the hash of its bytes, so that half-written or damaged files are detected. At the end,
`results.h5`, whose hash is in `sweep.json`, joins them and they are deleted. A lock keeps a second
process out.
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
from hashlib import file_digest, sha256
from io import BytesIO
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

import h5py
import numpy as np

from jaxmodel.metrics import METRICS
from studies import config, sources
from studies.engine.columns import PER_CASE, SCREENED, label_of
from studies.errors import StudyError
from studies.publish import TEMPORARY, check_reserved, is_open_as, replacing, reserving
from studies.reading import open_hdf5, open_regular, read_json

RESULTS, MANIFEST, CHUNKS, LOCK = "results.h5", "sweep.json", "chunks", ".lock"
#: Where the chunks of the linear model are, if there is a screen.
SCREEN = "screen"
#: Key in the manifest that lists chunks that were given up.
GIVEN_UP = "given_up"
#: And what its cases hold.
CONTENT = "content"
#: The corresponding file in a tuning's folder.
TUNING = "tune.json"
#: That of a fit.
FIT = "fit.h5"
#: The baseline of the sweep without control.
BASELINE = "baseline.h5"
#: Of the files in a folder: names of variables, contents of chunks.
FORMAT = 2
#: Temporary name of the results.
JOINED = ".joined.h5"
#: To read a folder beside what replaces files in it.
ATTEMPTS = 100
_CHUNK = re.compile(r"(\d{6,})-([0-9a-f]{16})\.h5")
_SOURCES = Path(__file__).parents[2]


class Content(NamedTuple):
    """What a folder of results holds."""

    what: str  # with its article
    mark: str  # file or folder that is there from the beginning
    leftover: re.Pattern[str]  # names that an interrupted run can leave behind


SWEEPS = Content(
    "a sweep",
    MANIFEST,
    re.compile(rf"\.joined\.h5|\.(joined\.h5|baseline\.h5|sweep\.json)\.{TEMPORARY}"),
)
TUNINGS = Content("a tuning", TUNING, re.compile(rf"\..+\.{TEMPORARY}"))
SCREENS = Content("a screen", "screen.json", re.compile(rf"\..+\.{TEMPORARY}"))
ATLASES = Content("an atlas", "runs", re.compile(r"\.unfinished-.*"))
#: Of a folder with a request and folders of its own in it.
_UNFINISHED = re.compile(rf"\.unfinished-.*|\..+\.{TEMPORARY}")
COMPARISONS = Content("a comparison of laws", "request.json", _UNFINISHED)
COMMISSIONINGS = Content("a commissioning", "request.json", _UNFINISHED)


class Finished(NamedTuple):
    """Where finished cases are."""

    case_id: np.ndarray  # (n,)
    file: np.ndarray  # position in `files`, (n,)
    row: np.ndarray  # in that file, (n,)
    files: list[Path]
    damaged: Sequence[Path] = ()  # chunks that cannot be read


class SweepFolder:
    """One folder, open for writing by this process only. Create it with `open_folder`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def results(self) -> Path:
        return self.path / RESULTS

    def write_chunk(self, arrays: Mapping[str, np.ndarray], place: str = CHUNKS) -> None:
        """Save a finished chunk: write to a temporary file, flush, rename.

        Args:
            arrays: contents, by the names of `label_of`, which labels them when they are joined.
            place: `CHUNKS` or `SCREEN`.

        Raises:
            StudyError: the disk is full or not writable; nothing half-written remains.
        """
        folder = self.path / place
        check_reserved(folder)
        image = BytesIO()  # HDF5 itself can crash on a full disk
        with h5py.File(image, "w") as file:
            for name, array in arrays.items():
                file[name] = array
        try:
            folder.mkdir(exist_ok=True)
            number = 1 + max((n for n, _ in _chunk_files(folder)), default=-1)
            digest = sha256(image.getbuffer()).hexdigest()[:16]
            with replacing(folder / f"{number:06d}-{digest}.h5") as temporary:
                temporary.write_bytes(image.getbuffer())
            _sync(folder)
        except OSError as error:
            raise StudyError(f"{folder}: cannot write a chunk ({error})") from error

    def begin(
        self,
        manifest: dict[str, Any],
        damaged: Iterable[Path] = (),
        report: Callable[[str], object] = print,
    ) -> None:
        """From now on the folder holds this sweep, or the previous one extended to it.

        Args:
            manifest: from `make_manifest`, and more.
            damaged: chunks to set aside.
            report: called with a message for each of them.
        """
        check_reserved(self.path)
        unfinished = (x for place in (CHUNKS, SCREEN) for x in self.path.glob(f"{place}/*.tmp"))
        for left in (*self.path.iterdir(), *unfinished):
            is_own = left.parent != self.path or SWEEPS.leftover.fullmatch(left.name)
            if is_own and left.is_file():
                left.unlink()
        for chunk in damaged:
            report(f"{chunk.name} is damaged; its cases run again")
            chunk.rename(chunk.with_suffix(".damaged"))
        old = read_manifest(self.path) if (self.path / MANIFEST).is_file() else {}
        self._write_manifest({**manifest, "results": old.get("results", [])})

    def give_up(self, rows: np.ndarray, reason: str) -> None:
        """Record that cases are left out, until a resumed sweep retries them.

        Args:
            rows: numbers of the cases, (k,).
            reason: why.
        """
        manifest = read_manifest(self.path)
        entry = {"cases": ranges(rows), "reason": reason}
        self._write_manifest({**manifest, GIVEN_UP: [*manifest.get(GIVEN_UP, []), entry]})

    def publish(self) -> None:
        """Rename the joined file to its final name; delete the chunks it contains."""
        joined = self.path / JOINED
        manifest = read_manifest(self.path)
        try:
            # both files are valid until the new one is in place
            old = [file_hash(self.results)] if self.results.is_file() else []
            manifest["results"] = [*old, file_hash(joined)]
            self._write_manifest(manifest)
            check_reserved(joined)
            os.replace(joined, self.results)
            _sync(self.path)
            check_reserved(self.path)
            for place in (CHUNKS, SCREEN):
                _remove_chunks(self.path / place)
        except OSError as error:
            raise StudyError(f"{self.results}: cannot write it ({error})") from error

    def _write_manifest(self, manifest: dict[str, Any]) -> None:
        text, path = json.dumps(manifest, indent=1), self.path / MANIFEST
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            with replacing(path) as temporary:
                temporary.write_text(text, encoding="utf-8")


def _remove_chunks(folder: Path) -> None:
    for _, path in _chunk_files(folder):
        path.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


@contextmanager
def open_folder(path: Path, manifest: dict[str, Any], is_resumed: bool) -> Iterator[SweepFolder]:
    """Open a sweep's folder, creating it if necessary, and lock it; `begin` is the first to write.

    Args:
        path: the folder.
        manifest: from `make_manifest`, and more.
        is_resumed: continue the existing sweep.

    Raises:
        StudyError: not writable, in use, holds something else, or a different sweep.
    """
    with locked_folder(path, "sweep"):
        refuse_existing(path, SWEEPS, is_resumed)
        check_resumed(path, manifest)
        yield SweepFolder(path)


def _at_once(path: str, flags: int) -> int:
    """Open a file, or fail: a pipe would wait for its reader."""
    return os.open(path, flags | os.O_NONBLOCK, 0o666)


@contextmanager
def locked_folder(path: Path, what: str) -> Iterator[None]:
    """Reserve a folder for this process, creating it if necessary.

    It stays reserved only as long as it has its name, see `check_reserved`. What is refused leaves
    no trace: the lock and folders made here go again if a StudyError ends
    it before anything else is in them.

    Args:
        path: the folder.
        what: what is done there, for messages.

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
            raise StudyError(f"--out {path}: another process is running a {what} there") from None
        except OSError as error:
            raise StudyError(
                f"--out {path}: cannot be locked against other processes ({error.strerror}); name "
                "a folder on another file system"
            ) from None
        try:
            with reserving(path / LOCK, lock.fileno()):
                yield
        except StudyError:
            is_here = is_open_as(path / LOCK, lock.fileno())
            if is_here and set(path.iterdir()) - before == {path / LOCK}:
                (path / LOCK).unlink()
                with suppress(OSError):  # somebody else has used one meanwhile
                    for folder in created:
                        folder.rmdir()
            raise


#: Modules that determine the numbers of a sweep, with everything they import.
DECISIVE = ("studies.engine.screen", "studies.space.table")


def make_manifest(data: dict[str, Any], modules: Iterable[str] = DECISIVE) -> dict[str, Any]:
    """What determines a sweep's numbers, and what ran it.

    Args:
        data: the sweep file as read.
        modules: those that determine them, with everything they import.
    """
    return {
        "format": FORMAT,
        "spec": data,
        "code": sources.digest(*modules),
        "git": git_state(),
        **config.origin(),
    }


def keep_request(file: Path, request: dict[str, Any], checked: Mapping[str, str]) -> None:
    """Write what is asked for, or check that a folder was begun with the same.

    Args:
        file: where, in the folder.
        request: from `make_manifest`, and more.
        checked: its entries that must be the same, in words.

    Raises:
        StudyError: the folder was begun with something else, or the file is damaged.
    """
    request = json.loads(json.dumps(request))
    if file.is_file():
        try:
            before = read_json(file)
        except (OSError, ValueError):
            before = None
        if not isinstance(before, dict):
            raise StudyError(f"{file}: damaged; name a new folder")
        for key, what in checked.items():
            old, new = before.get(key), request[key]
            if old != new:
                values = "" if isinstance(new, dict) else f" ({old}, now {new})"
                raise StudyError(
                    f"--out {file.parent}: was begun with another {what}{values}; name a new folder"
                )
        return
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(request, indent=1), encoding="utf-8")


@contextmanager
def resumable(out: Path, command: str = "") -> Iterator[None]:
    """Say after Ctrl-C how work in a folder goes on, by this command or the same one again."""
    try:
        yield
    except KeyboardInterrupt:
        if out.exists():
            how = command or f"--resume --out {quote(str(out))}"
            print(f"studies: finished work is safe; continue with: {how}", file=sys.stderr)
        raise


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a sweep's folder.

    Raises:
        StudyError: no sweep there, or one in another format.
    """
    try:
        manifest = read_json(path / MANIFEST)
        spec = manifest.get("spec") if isinstance(manifest, dict) else None
        if not isinstance(spec, dict) or not isinstance(spec.get("sweep"), dict):
            raise ValueError("no sweep in it")
        for name, kind in (("results", list), (GIVEN_UP, list), (CONTENT, dict)):
            if not isinstance(manifest.get(name, kind()), kind):
                raise ValueError(f"{name} is not a {kind.__name__}")
        if not isinstance(spec["sweep"].get("screen", {}), dict):
            raise ValueError("sweep.screen is not a table")
    except OSError:
        if os.path.isfile(path / TUNING):  # false for a name too long, too
            raise StudyError(
                f"{path}: holds a tuning, not a sweep; see its report.html, or tune.h5 with xarray"
            ) from None
        if os.path.isfile(path / SCREENS.mark):
            raise StudyError(
                f"{path}: holds a screen, not a sweep; run its best designs first: studies sweep "
                f"{quote(str(path / 'best.toml'))} --out DIR"
            ) from None
        raise StudyError(f"{path}: not the folder of a sweep ({MANIFEST} is missing)") from None
    except ValueError as error:
        raise StudyError(f"{path / MANIFEST}: damaged ({error})") from None
    if manifest.get("format", 1) != FORMAT:
        version, commit = (manifest.get(key, "unknown") for key in (config.PACKAGE, "git"))
        raise StudyError(
            f"{path}: its results have format {manifest.get('format', 1)}, this version reads "
            f"format {FORMAT}; run the sweep again in a new folder, or install the version that "
            f"wrote it ({version}, commit {commit})"
        )
    return manifest


def refuse_existing(path: Path, content: Content, is_resumed: bool) -> None:
    """Refuse a folder with results or other files; call it before long work.

    Args:
        path: the folder, which need not exist.
        content: what it is to hold.
        is_resumed: whether that may be there already.

    Raises:
        StudyError: it is, and is not resumed; other files; no access.
    """
    try:
        is_there = (path / content.mark).exists()
        if not is_there and path.is_dir():
            _refuse_others(path, content.leftover)
    except OSError as error:
        raise StudyError(f"--out {path}: cannot write there ({error.strerror})") from None
    if is_there and not is_resumed:
        extend = " or to extend it" if content is SWEEPS else ""
        raise StudyError(
            f"--out {path}: holds {content.what} already; add --resume to go on with it{extend}, "
            "or name a new folder"
        )


def _refuse_others(path: Path, leftover: re.Pattern[str]) -> None:
    """Raise StudyError if a new folder holds anything but its lock and leftovers of a kill."""
    names = [entry.name for entry in path.iterdir() if entry.name != LOCK]
    others = sorted(name for name in names if not leftover.fullmatch(name))
    if others:
        raise StudyError(
            f"--out {path}: holds other files ({', '.join(others[:3])}); name a new or empty folder"
        )


def check_resumed(path: Path, manifest: dict[str, Any]) -> None:
    """Reject a resumed sweep whose cases would not fit the finished ones, before a byte is written.

    Args:
        path: the folder, which need not hold a sweep yet.
        manifest: from `make_manifest`; with `content`, what its cases hold is compared, too.

    Raises:
        StudyError: other code, other precision, another content of a case.
    """
    if not (path / MANIFEST).exists():
        return
    old = read_manifest(path)
    for key, what in (
        ("code", "code"),
        ("precision", "precision"),
        ("jaxlib", "version of jaxlib"),
    ):
        if old.get(key) != manifest[key]:
            raise StudyError(
                f"--resume: {path} was begun with another {what} ({old.get(key)}, now "
                f"{manifest[key]}), so its cases would not fit new ones; name a new folder"
            )
    content = manifest.get(CONTENT, old.get(CONTENT, {}))
    for name, value in old.get(CONTENT, {}).items():
        if content.get(name) != value:
            raise StudyError(
                f"--resume: {path} has sweep.{name} = {value!r}, now {content.get(name)!r}; a "
                "resumed sweep keeps the same, since finished cases hold nothing else; name a new "
                "folder"
            )


def steady(path: Path, read: Callable[[], Any]) -> Any:
    """What is read from a sweep's folder while nothing in it is replaced or removed.

    A sweep that ends beside it joins its chunks: what one listing has named is gone then.
    """
    for _ in range(ATTEMPTS):
        before = _files(path)
        try:
            found = read()
        except (OSError, StudyError):
            if before <= _files(path):
                raise
        else:
            if before <= _files(path):
                return found
    return read()


def _files(path: Path) -> set[tuple[str, int, int]]:
    """What a sweep's folder holds: names, and what tells a file from one that replaces it."""
    found = set()
    for file in (path / MANIFEST, path / RESULTS, *path.glob(f"{CHUNKS}/*.h5")):
        with suppress(OSError):
            is_of = file.stat()
            found.add((file.name, is_of.st_ino, is_of.st_mtime_ns))
    return found


def finished_cases(path: Path, place: str = CHUNKS) -> Finished:
    """Finished cases, each once.

    Args:
        path: the sweep's folder.
        place: `CHUNKS`, or `SCREEN` for those that the linear model has finished.
    """
    code = "status" if place == CHUNKS else "screen_status"
    check_results(path)
    files = [path / RESULTS] if (path / RESULTS).is_file() else []
    damaged = []
    for _, chunk in _chunk_files(path / place):
        if file_hash(chunk) == _CHUNK.fullmatch(chunk.name)[2]:  # type: ignore[index]
            files.append(chunk)
        else:
            damaged.append(chunk)
    ids, sources, rows = [], [], []
    kept: list[Path] = []
    for file in files:
        try:
            with open_hdf5(file) as store:
                if code not in store and file.name == RESULTS:
                    continue  # of a sweep without screen
                status, names = store[code][()], store["case_id"][()]
                _check_columns(store, len(names))
                is_run, names = status >= 0, np.array(names, "S16")
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            if file.name == RESULTS:
                raise StudyError(
                    f"{file}: damaged ({error}); remove it to run its cases again"
                ) from None
            damaged.append(file)
            continue
        ids.append(names[is_run])
        rows.append(np.flatnonzero(is_run))
        sources.append(np.full(is_run.sum(), len(kept)))
        kept.append(file)
    if not ids:
        none = np.empty(0, int)
        return Finished(np.empty(0, "S16"), file=none, row=none, files=[], damaged=damaged)
    case_id, first = np.unique(np.concatenate(ids), return_index=True)
    number, row = np.concatenate(sources)[first], np.concatenate(rows)[first]
    return Finished(case_id, file=number, row=row, files=kept, damaged=damaged)


def _check_columns(store: h5py.File, count: int) -> None:
    """Raise ValueError unless what a case has is there as numbers, for each case."""
    for name, stored in store.items():
        if name in METRICS or name in PER_CASE or name in SCREENED:
            shape = np.shape(stored) if isinstance(stored, h5py.Dataset) else ()
            dims = label_of(name)[0]
            if (
                shape[:1] != (count,)
                or len(shape) != 1 + len(dims)
                or stored.dtype.kind not in "if"
            ):
                raise ValueError(f"{name} is not a table of numbers for {count} cases")


def check_results(path: Path) -> None:
    """Raise StudyError if `results.h5` is not the file this sweep wrote."""
    results = path / RESULTS
    if not results.is_file():
        return
    digest = file_hash(results)
    if not digest or digest not in read_manifest(path).get("results", []):
        raise StudyError(
            f"{results}: damaged, or not of this sweep; put the right one back, or remove it "
            "and run its cases again with --resume"
        )


def ranges(numbers: np.ndarray) -> str:
    """Ascending numbers in short form: "3, 8-11"."""
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return ", ".join(str(p[0]) if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts if len(p))


def file_hash(path: Path) -> str:
    """First 16 digits of the SHA-256 of an HDF5 file, "" for anything else."""
    try:
        with open_regular(path) as file:
            return file_digest(file, "sha256").hexdigest()[:16] if h5py.is_hdf5(path) else ""
    except OSError:
        return ""


def _chunk_files(folder: Path) -> list[tuple[int, Path]]:
    if not folder.is_dir():
        return []
    matches = ((_CHUNK.fullmatch(path.name), path) for path in folder.iterdir())
    return sorted((int(match[1]), path) for match, path in matches if match)


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def git_state() -> str:
    """Commit of the sources, "unknown" outside a repository."""
    command = ["git", "-C", str(_SOURCES), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip()
