"""Folders of results: job scripts can run again as they are; what is refused leaves no trace."""

import json
from typing import NamedTuple

import numpy as np
import pytest

import studies
import studies.sweeps.run as sweep_run
from jaxmodel.metrics import Metrics
from studies import job
from studies.cli import main
from studies.engine.folder import make_manifest
from studies.errors import StudyError
from studies.job import KINDS, locked_folder, working
from studies.parts import kept_part, packed
from studies.results.labelled import Labelled, labelled, told
from studies.store import numbers_digest
from studies.study.spec import Study
from studies.verify.rows import Assumption
from tests.canonical import TINY, study_of
from tests.jobs import quiet_job
from tests.sweeps import small_spec

MANIFEST = make_manifest({"sweep": {}})


def open_sweep(folder, request, is_resumed):
    """Its request is kept later on."""
    return working("sweep", folder, None, ("only",), is_resumed, progress=False)


def open_job(folder, request, is_resumed):
    return working("fit", folder, request, ("only",), is_resumed, progress=False)


@pytest.mark.parametrize("opened", [open_sweep, open_job])
def test_resume_begins_where_nothing_is_yet(opened, tmp_path):
    with opened(tmp_path / "new", MANIFEST, True):
        assert (tmp_path / "new").is_dir()


@pytest.mark.parametrize("opened", [open_sweep, open_job])
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


@pytest.mark.parametrize("verb", KINDS)
@pytest.mark.parametrize("is_taken", [False, True])
def test_folders_are_refused_before_jax_starts(verb, is_taken, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("studies.commands.start", forbidden)
    name, words = (
        (KINDS[verb].mark, f"holds {KINDS[verb].what} already; add --resume")
        if is_taken
        else ("thesis.tex", "holds other files (thesis.tex)")
    )
    (tmp_path / name).write_text("x")
    with pytest.raises(SystemExit, match="2"):
        main([verb, "none.toml", "--out", str(tmp_path)])
    assert words in capsys.readouterr().err
    assert [x.name for x in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "command",
    [*(f"{verb} none.toml" for verb in KINDS), "export none.toml --target c", "init --from x.json"],
)
def test_files_in_the_way_are_refused_before_jax_starts(command, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("studies.commands.start", forbidden)
    monkeypatch.setattr("studies.cli.start", forbidden)
    (tmp_path / "mine").write_text("x")
    out = [str(tmp_path / "mine")]
    with pytest.raises(SystemExit, match="2"):
        main([*command.split(), *(out if command.startswith("init") else ["--out", *out])])
    words = "exists already" if command.startswith("init") else "is not a folder"
    assert words in capsys.readouterr().err and (tmp_path / "mine").read_text() == "x"


def test_a_sweep_is_not_expanded_for_a_folder_that_is_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_run, "build_table", forbidden)
    (tmp_path / "sweep.json").write_text("{}")
    with pytest.raises(StudyError, match="holds a sweep already; add --resume"):
        studies.sweep(small_spec(), tmp_path)


# --- jobs -----------------------------------------------------------------------------------------

REQUEST = {"spec": {"a": 1}, "code": "a", "jaxlib": "1", "precision": "float64"}


def begun(out, is_resumed=False, verb="fit", **other):
    with working(verb, out, REQUEST | other, ("only",), is_resumed, progress=False) as work:
        return work.part("One", lambda: 1.5)


def test_a_job_goes_on_only_with_what_it_was_begun_with(tmp_path):
    out = tmp_path / "out"
    assert begun(out) == 1.5
    names = {x.name for x in out.iterdir()}
    assert names == {".lock", "request.json", "parts"}
    (out / ".fit.json.0123abcd.tmp").write_text("left by a kill")
    (out / ".unfinished-x").write_text("the same")
    assert begun(out, True) == 1.5 and {x.name for x in out.iterdir()} == names
    with pytest.raises(StudyError, match="holds a fit already; add --resume to go on with it"):
        begun(out)
    for other, word in (
        ({"spec": {"a": 2}}, "input;"),
        ({"code": "b"}, r"program \(a, now b\);"),
        ({"jaxlib": "2"}, "jaxlib"),
        ({"precision": "float32"}, r"precision \(float64, now float32\)"),
    ):
        with pytest.raises(StudyError, match=f"begun with another {word}"):
            begun(out, True, **other)
    for verb in ("tune", "certify"):
        with pytest.raises(StudyError, match="holds a fit; name a new folder"):
            begun(out, True, verb)
    assert {x.name for x in out.iterdir()} == names
    for content in ("[]", "{", "\0"):
        (out / "request.json").write_text(content)
        with pytest.raises(StudyError, match="request.json: damaged; name a new folder"):
            begun(out, True)


def test_an_interrupted_job_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(job, "command", ())
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt), working("fit", out, REQUEST, ("x",), progress=False):
        raise KeyboardInterrupt
    said = "studies: finished work is safe; continue with: resume=True\n"
    assert capsys.readouterr().err == said
    with pytest.raises(StudyError, match="--resume: name the folder with --out"):
        begun(None, True)
    assert begun(None) == 1.5


# --- parts ----------------------------------------------------------------------------------------


class Pair(NamedTuple):
    first: object
    second: object = None


class Judged(Labelled):
    """A result."""

    study: Study = told("the study")
    rows: tuple = told("in words")
    size: np.ndarray = labelled("m", "of it", "row")


# as of a module of this program
Pair.__module__ = Judged.__module__ = "studies.parts_of_a_test"


@pytest.fixture
def records(monkeypatch):
    """Types of this test as of a module of the program."""
    module = type(json)(Pair.__module__)
    module.Pair, module.Judged = Pair, Judged
    monkeypatch.setitem(__import__("sys").modules, Pair.__module__, module)


def whole():
    row = Assumption("a", "b", "c", np.float64(1e-3), np.inf)
    objects = np.empty((1, 2), object)
    objects[:] = [[Pair(1), Pair("x", np.float32(0.1))]]
    return {
        "pair": Pair([Pair(1, ()), (2.5, None, True)], {"é": 1 - 2j, 3: "\0"}),
        "judged": Judged(study_of(TINY, title="kept"), (row, row), np.array([1.0, np.nan])),
        "objects": objects,
        "texts": np.array(["one", "three"]),
        "wide": np.arange(6, dtype=np.int8).reshape(2, 1, 3)[..., ::2],
        "number": 0.1 + 0.2,
        "metrics": Metrics({"residual_rms": np.ones((3, 1)), "settling_time": None}),
    }


def test_a_part_is_what_it_was(records, tmp_path):
    made, calls = whole(), []
    parts = quiet_job(tmp_path)
    parts.part("All of it!", lambda: calls.append(1) or made)
    assert [x.name for x in (tmp_path / "parts").iterdir()] == ["all_of_it.npz"]
    found = parts.part("All of it!", lambda: calls.append(1))
    assert calls == [1] and list(found) == list(made)
    assert found["pair"] == made["pair"] and type(found["pair"].first[0]) is Pair
    judged = found["judged"]
    assert type(judged) is Judged and judged.study == made["judged"].study
    assert judged.study.model_fields_set == made["judged"].study.model_fields_set
    assert judged.rows[0].difference == 1e-3 and judged.rows[0].allowed == np.inf
    np.testing.assert_array_equal(judged.size, [1.0, np.nan])
    assert found["objects"].shape == (1, 2) and found["objects"][0, 1] == made["objects"][0, 1]
    for name in ("texts", "wide"):
        np.testing.assert_array_equal(found[name], made[name], strict=True)
    assert found["number"] == 0.1 + 0.2
    metrics = found["metrics"]
    assert type(metrics) is Metrics and metrics.residual_rms.shape == (3, 1)
    assert list(metrics) == ["residual_rms", "settling_time"] and metrics.settling_time is None


def forged(form, **arrays):
    """Contents of a part's file with a right digest."""
    written = {"form": np.array(json.dumps(form)), **arrays}
    return written | {"digest": np.array(numbers_digest(written)), "of": np.array("")}


@pytest.mark.parametrize(
    "form",
    [
        {"record": "pathlib:PurePath", "fields": {}},
        {"record": "studies.job:Path", "fields": {}},
        {"record": "studies.job:subprocess", "fields": {}},
        {"model": "studies.job:json", "fields": {}},
        {"record": "studies.none:X", "fields": {}},
        {"record": "studies.job:Kind", "fields": {"what": {"item": "x"}}},
        {"array": "x0"},
        {"of": [], "as": "studies.parts:packed"},
        {"of": [], "as": "collections:Counter"},
        {"objects": [{"item": 1}], "shape": [3]},
        {},
        [],
        {"tuple": 3},
    ],
    ids=str,
)
def test_files_of_other_programs_are_no_parts(form, tmp_path):
    kept_part(tmp_path, "one", "", lambda: 1)
    np.savez(tmp_path / "parts" / "one.npz", **forged(form))
    assert kept_part(tmp_path, "one", "", lambda: 2) == 2
    assert kept_part(tmp_path, "one", "", lambda: 3) == 2


def test_damaged_parts_and_those_of_something_else_are_found_again(tmp_path):
    file = tmp_path / "parts" / "one.npz"
    assert kept_part(tmp_path, "one", "a", lambda: np.arange(3.0)).tolist() == [0, 1, 2]
    assert kept_part(tmp_path, "one", "b", lambda: 2) == 2
    content = file.read_bytes()
    for damaged in (b"", content[:-30], content[:200] + b"x" + content[201:], b"PK" + content[:99]):
        file.write_bytes(damaged)
        assert kept_part(tmp_path, "one", "b", lambda: 2.5) == 2.5
    with pytest.raises(TypeError, match="PosixPath: no part of work can hold it"):
        packed([tmp_path], {})
