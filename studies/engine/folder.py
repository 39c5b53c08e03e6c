"""The folder of a sweep: every finished chunk survives however the run ends.

`sweep.json` records what is run and by which code. Each chunk is one file in `chunks/`, whose name
contains the hash of its bytes, so that half-written or damaged files are detected. At the end,
`results.h5`, whose hash is in `sweep.json`, joins them and they are deleted. A lock keeps a second
process out.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from hashlib import file_digest, sha256
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from jaxmodel.metrics import METRICS
from studies import config
from studies.engine.columns import PER_CASE, label_of
from studies.errors import StudyError
from studies.job import FORMAT, KINDS, LEFTOVER, make_request
from studies.publish import check_reserved, replacing
from studies.reading import open_hdf5, open_regular, read_json

RESULTS, MANIFEST, CHUNKS = "results.h5", KINDS["sweep"].mark, "chunks"
#: Key in the manifest that lists chunks that were given up.
GIVEN_UP = "given_up"
#: And what its cases hold.
CONTENT = "content"
#: The request of a sweep that keeps its best designs, from its first tally on.
SCREEN = KINDS["sweep"].marks[1]
#: The corresponding file in a tuning's folder.
TUNING = KINDS["tune"].mark
#: That of a fit.
FIT = "fit.h5"
#: The baseline of the sweep without control.
BASELINE = "baseline.h5"
#: Modules that determine the numbers of a sweep, with everything they import.
DECISIVE = ("studies.engine.fidelity", "studies.space.table")
#: Temporary name of the results.
JOINED = ".joined.h5"
#: To read a folder beside what replaces files in it.
ATTEMPTS = 100
_CHUNK = re.compile(r"(\d{6,})-([0-9a-f]{16})\.h5")


class Finished(NamedTuple):
    """Where finished cases are."""

    case_id: np.ndarray  # (n,)
    file: np.ndarray  # position in `files`, (n,)
    row: np.ndarray  # in that file, (n,)
    files: list[Path]
    damaged: Sequence[Path] = ()  # chunks that cannot be read


class SweepFolder:
    """One folder, which this process has locked."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def results(self) -> Path:
        return self.path / RESULTS

    def write_chunk(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Save a finished chunk: write to a temporary file, flush, rename.

        Args:
            arrays: contents, by the names of `label_of`, which labels them when they are joined.

        Raises:
            StudyError: the disk is full or not writable; nothing half-written remains.
        """
        folder = self.path / CHUNKS
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
        for left in (*self.path.iterdir(), *self.path.glob(f"{CHUNKS}/*.tmp")):
            is_own = left.parent != self.path or LEFTOVER.fullmatch(left.name)
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
            _remove_chunks(self.path / CHUNKS)
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


def make_manifest(data: dict[str, Any]) -> dict[str, Any]:
    """What determines a sweep's numbers, and what ran it; data: the sweep file as read."""
    return make_request(data, DECISIVE)


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
    except OSError:
        if os.path.isfile(path / TUNING):  # false for a name too long, too
            raise StudyError(
                f"{path}: holds a tuning, not a sweep; see its report.html, or tune.h5 with xarray"
            ) from None
        if os.path.isfile(path / SCREEN):
            raise StudyError(
                f"{path}: its sweep has not yet run the designs to keep; go on with --resume"
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


def finished_cases(path: Path) -> Finished:
    """Finished cases of a sweep's folder, each once."""
    check_results(path)
    files = [path / RESULTS] if (path / RESULTS).is_file() else []
    damaged = []
    for _, chunk in _chunk_files(path / CHUNKS):
        if file_hash(chunk) == _CHUNK.fullmatch(chunk.name)[2]:  # type: ignore[index]
            files.append(chunk)
        else:
            damaged.append(chunk)
    ids, sources, rows = [], [], []
    kept: list[Path] = []
    for file in files:
        try:
            with open_hdf5(file) as store:
                status, names = store["status"][()], store["case_id"][()]
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
        if name in METRICS or name in PER_CASE:
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
