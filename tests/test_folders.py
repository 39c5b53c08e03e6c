"""Folders of results: job scripts can run again as they are; what is refused leaves no trace."""

import pytest

from studies.engine.folder import locked_folder, make_manifest, open_folder
from studies.errors import StudyError
from studies.tuning.folder import open_tuning

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
