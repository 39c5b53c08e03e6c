"""Folders of results: job scripts can run again as they are; what is refused leaves no trace."""

import pytest

import studies.sweeps.run as sweep_run
from studies.cli import main
from studies.engine.folder import locked_folder, make_manifest, open_folder
from studies.errors import StudyError
from studies.tuning.folder import open_tuning
from tests.sweeps import small_spec

MANIFEST = make_manifest({"sweep": {}}, ("studies.engine.folder",))


@pytest.mark.parametrize("opened", [open_folder, open_tuning])
def test_resume_begins_where_nothing_is_yet(opened, tmp_path):
    with opened(tmp_path / "new", MANIFEST, True):
        assert (tmp_path / "new").is_dir()


@pytest.mark.parametrize("opened", [open_folder, open_tuning])
@pytest.mark.parametrize("is_resumed", [False, True])
def test_folders_of_something_else_are_left_as_they_are(opened, is_resumed, tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with (
        pytest.raises(StudyError, match="holds other files .thesis.tex."),
        opened(tmp_path, MANIFEST, is_resumed),
    ):
        pass
    assert [x.name for x in tmp_path.iterdir()] == ["thesis.tex"]


def test_what_is_refused_leaves_no_folder(tmp_path):
    """Neither those made for it, nor a lock; what was written stays."""
    out = tmp_path / "a" / "b"
    with pytest.raises(StudyError, match="refused"), locked_folder(out, "sweep"):
        raise StudyError("refused")
    assert not (tmp_path / "a").exists()
    with pytest.raises(StudyError, match="late"), locked_folder(out, "sweep"):
        (out / "results").write_text("x")
        raise StudyError("late")
    assert (out / "results").exists()


def forbidden(*_, **__):
    raise AssertionError("long work before the folder is looked at")


@pytest.mark.parametrize(
    ("command", "package", "mark"),
    [
        ("sweep none.toml", "sweeps", "sweep.json"),
        ("tune none.toml", "tuning", "tune.json"),
        ("atlas none.toml", "atlas", "runs"),
    ],
)
@pytest.mark.parametrize("is_taken", [False, True])
def test_folders_are_refused_before_jax_starts(
    command, package, mark, is_taken, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(f"studies.{package}.commands.start", forbidden)
    name, words = (
        (mark, "holds a") if is_taken else ("thesis.tex", "holds other files (thesis.tex)")
    )
    (tmp_path / name).write_text("x")
    with pytest.raises(SystemExit, match="2"):
        main([*command.split(), "--out", str(tmp_path)])
    message = capsys.readouterr().err
    assert words in message and ("already; add --resume" in message) == is_taken
    assert [x.name for x in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("command", "package", "words"),
    [
        ("fit none.toml", "fitting", "is not a folder"),
        ("spillover none.toml", "spillover", "is not a folder"),
        ("export none.toml --target c", "export", "is not a folder"),
        ("import-gains none.json", "export", "exists already"),
    ],
)
def test_files_in_the_way_are_refused_before_jax_starts(
    command, package, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(f"studies.{package}.commands.start", forbidden)
    (tmp_path / "mine").write_text("x")
    with pytest.raises(SystemExit, match="2"):
        main([*command.split(), "--out", str(tmp_path / "mine")])
    assert words in capsys.readouterr().err and (tmp_path / "mine").read_text() == "x"


def test_a_sweep_is_not_expanded_for_a_folder_that_is_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_run, "build_table", forbidden)
    (tmp_path / "sweep.json").write_text("{}")
    with pytest.raises(StudyError, match="holds a sweep already; add --resume"):
        sweep_run.run_sweep(small_spec(), tmp_path)
