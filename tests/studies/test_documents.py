"""JSON documents: what every reading command prints with --json, and the schemas of all of them.

The sweeps are made up; what runs is a small study.
"""

import copy
import json

import jsonschema
import numpy as np
import pytest
import typer

from jaxmodel import status
from studies.cli import app
from studies.documents import DOCUMENTS, schema
from studies.engine import results
from studies.engine.design import Design
from studies.errors import StudyError
from studies.results.breaking import BreakingChange, ChangedNumber
from studies.results.document import json_text
from studies.results.labelled import Labelled, labelled, told
from studies.single.verb import simulate
from studies.space.machines import TOLERANCES
from studies.sweeps.sensitivity import analyse
from tests.studies.sweeps.test_sweep_tables import (
    DAMPING,
    GAINS,
    MARGINS,
    RMS,
    VOLTS,
    designed,
    usual,
)
from tests.studies.test_cli import SHORT, refused, run

#: Commands whose results have no document of their own.
WITHOUT = {"atlas", "explore", "export", "plant", "plot", "tune"}
SWEEP = """
[sweep]
where = "gain < 0.9"
[sweep.axes]
gain = { from = 0.1, to = 1.0, count = 4 }
controlled_modes = [1, 2]
"""


@pytest.fixture
def document(capsys, monkeypatch):
    """The only thing on stdout of a command, valid by its schema; of a sweep that is made up."""

    def printed(*arguments, data=None):
        if data is not None:
            monkeypatch.setattr(results, "read_sweep", lambda *_: data)
        code, out, err = run(capsys, *arguments, "--json")
        assert (code, err) == (0, ""), err
        found = json.loads(out)
        jsonschema.validate(found, schema(arguments[0]))
        assert found["format"] == f"flexlink-{arguments[0]}"
        check_refusals(found, schema(arguments[0]))
        return found

    return printed


def check_refusals(found, rules):
    """The schema must miss each name, know no other, and tell another format."""
    for name in rules["required"]:
        with pytest.raises(jsonschema.ValidationError, match=f"'{name}' is a required property"):
            jsonschema.validate({key: x for key, x in found.items() if key != name}, rules)
    with pytest.raises(jsonschema.ValidationError, match="was expected"):
        jsonschema.validate(found | {"format_version": 99}, rules)
    if rules["additionalProperties"] is False:
        with pytest.raises(jsonschema.ValidationError, match="'another' was unexpected"):
            jsonschema.validate(found | {"another": 1}, rules)


def test_every_document_has_a_schema():
    group = typer.main.get_command(app)
    readers = {
        name
        for name, command in group.commands.items()
        if any("--json" in parameter.opts for parameter in command.params)
    }
    others = {"summary", "comparison"}  # the latter of export --compare
    assert readers - WITHOUT | others == set(DOCUMENTS)
    for command in DOCUMENTS:
        rules = schema(command)
        jsonschema.Draft202012Validator.check_schema(rules)
        assert rules["title"] == rules["properties"]["format"]["const"] == f"flexlink-{command}"


def test_best(document):
    data = usual(codes=[0, 0, 0, 0, 0, 0, 0, 4])
    wanted = ("--subject-to", "gain_margin >= 1.2", "--count", 3)
    found = document("best", "DIR", "--by", "residual_rms", *wanted, data=data)
    assert [case["case"] for case in found["cases"]] == [3, 4, 1]
    for case in found["cases"]:
        k = case["case"]
        assert case == {
            "case": k,
            "case_id": str(data["case_id"][k]),
            "control.gain_factor": GAINS[k],
            "residual_rms": RMS[k],
            "peak_voltage": VOLTS[k],
            "damping_ratio[controlled_mode=1]": DAMPING[k, 0],
            "gain_margin": MARGINS[k],
        }
    assert found["units"]["residual_rms"] == "m" and found["units"]["control.gain_factor"] == "1"
    assert found["direction"] == "smallest" and found["without_control"] is None
    assert [x["status_text"] for x in found["left_out"]] == [status.REASONS[4]]
    assert len(found["warnings"]) == 1 and "gain margin below 2" in found["warnings"][0]


def test_best_with_what_breaks_each(capsys, document, monkeypatch):
    from studies.sweeps import breaking

    units = TOLERANCES._replace(patch=0.0)
    change = BreakingChange(
        distance=2.0,
        change=None,
        parts=(ChangedNumber("delay", "delay 0.5 samples late", 2.0),),
        breaking="mode 3 of link 1 (958 Hz)",
        tolerances=units._asdict(),
    )
    monkeypatch.setattr(breaking, "load_design", lambda folder, case: Design(case, {}))

    def fixed(study):
        if study == 4:
            raise StudyError("no link is controlled")
        return study

    monkeypatch.setattr(breaking, "fixed_controller", fixed)
    monkeypatch.setattr(breaking, "smallest_change", lambda design, tolerances: change)
    wanted = ("best", "DIR", "--by", "residual_rms", "--count", 3, "--breaks")
    wanted += ("--tolerance", "patch=0")
    found = document(*wanted, data=usual(codes=[0, 0, 0, 0, 0, 0, 0, 4]))["smallest_changes"]
    by_case = {entry["case"]: entry for entry in found}
    assert len(found) == 3 and by_case[4]["fault"] == "not judged: no link is controlled"
    other = next(entry for entry in found if entry["case"] != 4)
    assert other["smallest_change"]["tolerances"]["patch"] == 0 and other["fault"] == ""
    text = run(capsys, *wanted)[1]
    assert f"case {other['case']}: {change.text}" in text and "case 4: not judged" in text
    said = refused(capsys, "best", "DIR", "--by", "residual_rms", "--tolerance", "patch=0")
    assert "--tolerance: for --breaks only" in said


def test_show(document):
    codes = [0, 0, 0, 0, 3, 0, 5, -1]
    data = usual(codes=codes, bad_time=np.arange(8) * 1e-3)
    found = document("show", "DIR", data=data)
    assert found["n_cases"] == 8 and found["axes"] == ["control.gain_factor"]
    counts = {row["status"]: row["cases"] for row in found["statuses"]}
    assert counts == {0: 5, 3: 1, 5: 1, -1: 1}
    assert [case["case"] for case in found["best"]["cases"]] == [1, 0, 5, 2]  # margins above 2
    assert found["best"]["subject_to"] == "gain_margin >= 2" and found["failed"] is None
    assert found["causes"][0]["name"] == "control.gain_factor"
    failed = document("show", "DIR", "--failed", data=data)["failed"]
    assert [(x["case"], x["status"], x["bad_time"]) for x in failed] == [(4, 3, 4e-3), (6, 5, None)]
    nothing = usual(codes=[-1] * 8)
    found = document("show", "DIR", "--failed", data=nothing)
    assert found["best"] is None and found["failed"] == []


@pytest.mark.parametrize(("method", "name"), [("morris", "mean_size"), ("saltelli", "total")])
def test_sensitivity(document, method, name):
    data, *_ = designed(method, 16)
    found, wanted = document("sensitivity", "DIR", data=data), analyse(data, "residual_rms")
    assert [row["factor"] for row in found["factors"]] == [row[0] for row in wanted.values]
    sizes = [row[name] for row in found["factors"]]
    assert sizes == sorted(sizes, reverse=True)
    assert found["n_rows"] == len(data.table.origin) and found["units"] == {"residual_rms": "m"}


def test_a_plan(document, tmp_path):
    (tmp_path / "sweep.toml").write_text(SHORT + SWEEP)
    found = document("sweep", tmp_path / "sweep.toml", "--dry-run")
    assert (found["n_cases"], found["n_left_out"], found["sample_fault"]) == (6, 2, "")
    gain, modes = found["axes"]
    assert (gain["name"], gain["n_values"], gain["smallest"]) == ("control.gain_factor", 3, 0.1)
    assert sum(program["n_cases"] for program in found["programs"]) == 6
    assert found["sample"]["case"] == 3 and found["sample"][gain["name"]] in (0.1, 0.4, 0.7)
    assert modes["name"] in found["sample"]


def test_a_run(document, tmp_path):
    (tmp_path / "short.toml").write_text(SHORT)
    found = document("simulate", tmp_path / "short.toml")
    again = simulate(tmp_path / "short.toml")
    wanted = again.run.result.metrics
    assert found["status"] == again.run.status == status.OK and found["status_text"] == "ok"
    np.testing.assert_array_equal(found["metrics"]["residual_rms"], wanted.residual_rms)
    assert found["axes"]["residual_rms"] == ["link", "station"]
    assert found["units"]["settling_time"] == "s"
    free = again.free.result.metrics.residual_rms
    np.testing.assert_array_equal(found["without_control"]["residual_rms"], free)
    assert found["loop"]["gain_margin"] == pytest.approx(float(again.run.loop.gain_margin))
    assert found["residual_length"] == 0.015
    assert set(found["metrics"]) | set(found["loop"]) == set(found["units"])


def test_settings_and_modes(document):
    assert document("info")["precision"] == "float64"
    assert len(document("modes", "--n-modes", 2)["modes"]) == 3 + 3 * (2 + 1)  # links lengthen
    free = document("modes", "--n-modes", 2, "--kp", 0)["modes"][0]
    assert (free["kind"], free["share"], free["links"]) == ("rigid", None, [])
    assert document("cache")["is_cleared"] is False


def test_a_mistake_leaves_stdout_empty(capsys, tmp_path):
    code, out, err = run(capsys, "best", tmp_path, "--by", "residual_rms", "--json")
    assert (code, out) == (2, "") and err.count("\n") == 1


def test_what_json_cannot_hold():
    class Odd(Labelled, command="odd", version=7):
        """What JSON has no words for."""

        numbers: np.ndarray = labelled("1", "with gaps", "row", "column")
        one: float = labelled("1", "in single precision")
        count: int = told("of NumPy")
        is_on: bool = told("the same")
        words: bytes = told("as bytes")
        title: str = told("with escapes")
        pair: tuple[int, None] = told("of two kinds")

    odd = Odd(
        numbers=np.array([[1.0, np.nan], [np.inf, 2.0]]),
        one=np.float32(0.5),
        count=np.int64(3),
        is_on=np.bool_(True),
        words=b"abc",
        title="\x9b31m \u202e",
        pair=(1, None),
    )
    text = json_text(odd)
    assert text.isascii() and "NaN" not in text
    found = json.loads(text)
    assert found["numbers"] == [[1.0, None], [None, 2.0]] and found["pair"] == [1, None]
    assert (found["one"], found["count"], found["is_on"], found["words"]) == (0.5, 3, True, "abc")
    assert (found["format"], found["format_version"]) == ("flexlink-odd", 7)


def test_schemas_are_printed(capsys):
    code, out, _ = run(capsys, "schema")
    assert code == 0 and out.split() == list(DOCUMENTS)
    for command in DOCUMENTS:
        assert json.loads(run(capsys, "schema", command)[1]) == schema(command)
    assert "did you mean 'best'?" in refused(capsys, "schema", "bst")
    assert "command = 'x/../best'" in refused(capsys, "schema", "x/../best")


def test_a_schema_refuses_a_wrong_unit_of_nesting():
    rules, case = schema("best"), {"case": 1, "case_id": "a", "residual_rms": 1e-6}
    whole = {"format": "flexlink-best", "format_version": 2, "by": "residual_rms"}
    whole |= {"direction": "smallest", "subject_to": "", "without_control": None, "cases": [case]}
    whole |= {"units": {"residual_rms": "m"}, "left_out": [], "warnings": []}
    whole |= {"environments": [], "over": "worst", "smallest_changes": None}
    jsonschema.validate(whole, rules)
    for name, part in (("cases", {"residual_rms": {"um": 1}}), ("units", {"residual_rms": 1})):
        wrong = copy.deepcopy(whole)
        wrong[name] = [part] if name == "cases" else part
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, rules)
