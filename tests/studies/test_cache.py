"""`studies cache`: what is counted and removed, and what is left alone."""

import json
import os
import threading
from itertools import chain

import pytest

from studies import cache
from studies.cache import VARIABLE, cache_contents
from studies.kernels import compilation
from studies.kernels.compilation import ObjectCache
from tests.studies.test_cli import refused, run

HASH = "0f" * 32
#: Files by kind, and their sizes.
OWN = {
    "program": [f"program-{HASH}"],
    "data": [f"data-{HASH}"],
    "passport": [f"passport-{HASH}"],
    "kernel": [f"kernel-{HASH}", f".kernel-{HASH}.0a1b2c3d.tmp"],
    "xla": [f"jit__lambda_-{HASH}-cache", f"jit_simulate-{HASH}-atime"],
}
OTHERS = ["key", "notes.txt", f"kernel-{HASH}.bak", "kernel-12", f"{HASH}-cache", "results.h5"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The cache folder of a user, with files of each kind, and others."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "flexlink-studies"
    folder.mkdir(mode=0o700)
    for name in [*chain(*OWN.values()), *OTHERS]:
        (folder / name).write_bytes(b"0" * 1000)
    (folder / f"program-{HASH[::-1]}").mkdir()  # a folder, and a link to somebody's file
    (tmp_path / "precious").write_text("")
    (folder / f"data-{HASH[::-1]}").symlink_to(tmp_path / "precious")
    return folder


LEFT = {*OTHERS, f"program-{HASH[::-1]}", f"data-{HASH[::-1]}"}


def test_kept_programs_are_counted_and_removed(capsys, folder):
    code, out, _ = run(capsys, "cache")
    assert code == 0 and f"folder: {folder}\n" in out and "in all" in out
    found = cache_contents()
    assert {x.kind: x.files for x in found.kinds} == {k: len(names) for k, names in OWN.items()}
    assert (found.folder, found.files, found.bytes) == (str(folder), 7, 7000)
    code, out, _ = run(capsys, "cache", "--clear", "--json")
    kinds = json.loads(out)["kinds"]
    assert code == 0 and sum(x["files"] for x in kinds) == 7 and kinds[0]["bytes"] == 2000
    assert {path.name for path in folder.iterdir()} == LEFT
    assert (folder.parent / "precious").exists()
    code, out, _ = run(capsys, "cache", "--clear")
    assert code == 0 and "removed" in out and cache_contents().files == 0


def test_programs_of_others_in_a_shared_folder_are_left(capsys, folder, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(folder))
    assert cache_contents().files == 7
    code, out, _ = run(capsys, "cache", "--clear")
    assert code == 0 and f"{VARIABLE} names a folder where other programs" in out
    assert {path.name for path in folder.iterdir()} == {*LEFT, *OWN["xla"]}


@pytest.mark.parametrize(
    ("mode", "others", "said"),
    [(0o777, False, "can be written by others"), (0o700, True, "belongs to another user")],
)
def test_a_folder_of_others_is_refused(capsys, folder, monkeypatch, mode, others, said):
    folder.chmod(mode)
    if others:
        monkeypatch.setattr(cache.os, "getuid", lambda: folder.stat().st_uid + 1)
    before = set(folder.iterdir())
    for arguments in ([], ["--clear"], ["--json"]):
        assert said in refused(capsys, "cache", *arguments)
    assert set(folder.iterdir()) == before


def test_no_folder_and_what_is_none(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "missing"))
    assert cache_contents(is_cleared=True).files == 0 and not (tmp_path / "missing").exists()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file"))
    assert "file: cannot be cleared (Not a directory)" in refused(capsys, "cache", "--clear")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file" / "below"))
    assert cache_contents().files == 0


def test_a_file_that_vanishes_meanwhile_is_not_missed(folder, monkeypatch):
    scandir = os.scandir

    def slow(path):
        entries = list(scandir(path))
        (folder / OWN["program"][0]).unlink()
        return entries

    monkeypatch.setattr(cache.os, "scandir", slow)
    found = {x.kind: x.files for x in cache_contents(is_cleared=True).kinds}
    assert found == {"program": 0, "data": 1, "kernel": 2, "xla": 2, "passport": 1}


def test_clearing_beside_processes_that_keep_and_take(folder, monkeypatch):
    """They find what they need or nothing, and never fail."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: str(folder))
    compilation._key.cache_clear()
    failed, stop = [], threading.Event()

    def use(name):
        try:
            while not stop.is_set():
                ObjectCache("program", name).keep(name.encode())
                assert ObjectCache("program", name).take() in (None, name.encode())
        except Exception as error:
            failed.append(error)

    users = [threading.Thread(target=use, args=(f"program {k}",)) for k in range(2)]
    for user in users:
        user.start()
    removed = sum(cache_contents(is_cleared=True).files for _ in range(100))
    stop.set()
    for user in users:
        user.join()
    compilation._key.cache_clear()
    assert failed == [] and removed > 6
