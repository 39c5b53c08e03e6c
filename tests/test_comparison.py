"""`studies export --compare`: one controller in several arithmetics and at several sample rates."""

import json

import jsonschema
import pytest

from studies.export import comparison
from studies.show.document import schema
from tests.exports import DESIGNS, needs_compiler, write_study
from tests.pages import tables_of, text_of
from tests.test_cli import refused, run
from tests.test_firmware import needs_target


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("study") / "paper.toml", DESIGNS["paper"])


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--compare", "--target", "c"], "--compare: not allowed with --target"),
        (["--compare", "--verify"], "--compare: not allowed with --verify"),
        ([], "--target: missing; allowed: json, c, c-fixed"),
        (["--compare", "--pil", "cortex-m5"], "--pil = 'cortex-m5'.*cortex-m4"),
        (["--compare", "--dac-bits", "3"], "--dac-bits = 3; allowed: 4 to 16"),
    ],
)
def test_what_cannot_be_compared_is_refused(capsys, study, arguments, message, tmp_path):
    refused(capsys, message, "export", study, "--out", tmp_path / "out", *arguments)
    assert not (tmp_path / "out").exists()


def compared(capsys, monkeypatch, study, out, *arguments):
    monkeypatch.setattr(comparison, "RATES", (10e3,))
    code, text, _ = run(capsys, "export", study, "--compare", "--out", out, *arguments)
    assert code == 0, text
    document = json.loads((out / "comparison.json").read_text())
    jsonschema.validate(document, schema("comparison"))
    (table,) = tables_of((out / "comparison.html").read_text())["Comparison"]
    return document["variants"], table


def test_arithmetics_side_by_side(capsys, monkeypatch, study, tmp_path):
    needs_compiler()
    variants, table = compared(capsys, monkeypatch, study, tmp_path / "out")
    single, fixed, short = variants
    assert [x["is_exportable"] for x in variants] == [True, True, False]
    assert fixed["gain_margin"] == pytest.approx(single["gain_margin"], rel=1e-4)
    assert fixed["residual_rms"] == pytest.approx(single["residual_rms"], rel=0.02)
    assert single["rounding"] == 0 < fixed["rounding"] < 0.01 < 10 < short["rounding"]
    assert short["gain_margin"] == pytest.approx(single["gain_margin"], rel=0.05)
    assert table["arithmetic"][0] == "single precision" and len(table["gain margin"]) == 3
    assert "With `--pil`: instructions" in text_of((tmp_path / "out/comparison.html").read_text())


def test_instructions_and_flash(capsys, monkeypatch, study, tmp_path):
    needs_target()
    board = "cortex-m4f"
    variants, table = compared(capsys, monkeypatch, study, tmp_path / "out", "--pil", board)
    single, fixed, short = variants
    # a unit for single precision needs less than products of 64 bits, and so do those of 32
    assert 0 < single["instructions"] < short["instructions"] < fixed["instructions"] < 6000
    assert all(500 < x["flash"] < 6000 and 0 < x["load"] < 1 for x in variants)
    assert table["load at 168 MHz"][1].endswith("%")


def test_a_rate_without_controller_has_a_row(capsys, monkeypatch, tmp_path):
    """Gains that are stable at no rate: the reason is in every row."""
    needs_compiler()
    strong = DESIGNS["paper"] | {"control": {"velocity_gain": [3.1, 3.5, 3.4], "gain_factor": 5.0}}
    study = write_study(tmp_path / "strong.toml", strong)
    variants, table = compared(capsys, monkeypatch, study, tmp_path / "out")
    assert not any(x["is_exportable"] for x in variants)
    assert all("control.gain_factor = 5" in x["fault"] for x in variants)
    assert table["gain margin"] == [""] * 3
