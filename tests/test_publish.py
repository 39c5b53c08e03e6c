"""Folders of results: whole or not at all, and the same for every command."""

import os

import pytest

from studies.errors import StudyError
from studies.publish import publish


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
