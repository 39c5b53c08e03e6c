"""Folders of results: whole or not at all, and the same for every command."""

import os

import pytest

from studies.errors import StudyError
from studies.publish import publish, replacing


def write(folder, *names):
    for name in names:
        (folder / name).write_text(f"new {name}")


def test_files_appear_together_and_replace_their_like(tmp_path):
    out = tmp_path / "deep" / "out"
    out.mkdir(parents=True)
    for name in ("a", "mine", "left", "again"):
        (out / name).write_text("old")
    with publish(out, stale=("left", "again", "never")) as staging:
        write(staging, "a", "again")
        assert (out / "a").read_text() == "old"
    names = {path.name: path.read_text() for path in out.iterdir()}
    assert names == {"a": "new a", "mine": "old", "again": "new again"}


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failure_leaves_the_folder_as_it_was(tmp_path, error):
    (tmp_path / "a").write_text("old")
    expected = StudyError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected), publish(tmp_path, stale=("a",)) as staging:
        write(staging, "a", "b")
        raise error
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a", "old")]


def test_a_failure_leaves_no_new_folder(tmp_path):
    out = tmp_path / "new"
    message = f"^--out {out}: cannot write there \\(disk full\\)$"
    with pytest.raises(StudyError, match=message), publish(out) as staging:
        write(staging, "a")
        raise OSError(28, "disk full", str(staging / "a"))
    assert not out.exists()


def test_a_file_that_cannot_be_moved_holds_all_back(tmp_path):
    (tmp_path / "b").mkdir()
    with pytest.raises(StudyError, match="b: cannot write there"), publish(tmp_path) as staging:
        write(staging, "a", "b")
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_what_killed_processes_left_is_removed_and_what_others_prepare_is_not(tmp_path):
    dead = os.spawnlp(os.P_NOWAIT, "true", "true")
    os.waitpid(dead, 0)
    for name in (f".unfinished-{dead}-x", ".unfinished-killed", f".unfinished-{os.getppid()}-y"):
        (tmp_path / name).mkdir()
    with publish(tmp_path) as staging:
        write(staging, "a")
    assert {path.name for path in tmp_path.iterdir()} == {"a", f".unfinished-{os.getppid()}-y"}


def test_a_page_is_there_only_with_all_its_files(tmp_path, monkeypatch):
    """A kill between two moves leaves neither the old page nor the new one."""
    for name in ("a.h5", "report.html", "found.json", "old.png"):
        (tmp_path / name).write_text(f"old {name}")
    names, replace, seen = ("a.h5", "found.json", "report.html"), os.replace, []

    def watched(*pair):
        seen.append({path.name for path in tmp_path.glob("*.*") if path.is_file()})
        replace(*pair)

    monkeypatch.setattr(os, "replace", watched)
    with publish(tmp_path, stale=("old.png",)) as staging:
        write(staging, *names)
    assert seen == [{"a.h5"}, {"a.h5"}, {"a.h5", "report.html"}]
    assert {path.name for path in tmp_path.iterdir()} == set(names)


def test_temporary_files_of_killed_processes_are_removed(tmp_path):
    dead = os.spawnlp(os.P_NOWAIT, "true", "true")
    os.waitpid(dead, 0)
    left = f".a.{dead}-0123abcd.tmp"
    others = [f".a.{os.getppid()}-0123abcd.tmp", f".b.{dead}-0123abcd.tmp", ".a.b.0123abcd.tmp"]
    for name in (left, *others):
        (tmp_path / name).write_text("half")
    with replacing(tmp_path / "a") as temporary:
        temporary.write_text("new")
    assert {path.name for path in tmp_path.iterdir()} == {"a", *others}
