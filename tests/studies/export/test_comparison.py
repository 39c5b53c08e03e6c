"""`studies export --compare`: one controller in several arithmetics and at several sample rates."""

import json
from types import SimpleNamespace
from unittest import mock

import jsonschema
import pytest
from rich.console import Console

from studies.documents import schema
from studies.engine.design import load_design
from studies.errors import StudyError
from studies.export import comparison
from studies.export.comparison import ComparedVariants, Variant, cheapest, compare_variants
from tests.exports import DESIGNS, needs_compiler, write_study
from tests.pages import tables_of, text_of
from tests.studies.export.test_firmware import needs_target
from tests.studies.test_cli import refused


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


def compared(study, out, pil=None):
    """Variants and table of a comparison at 10 kHz."""
    with mock.patch.object(comparison, "RATES", (10e3,)):  # is part of no program: they are kept
        compare_variants(load_design(study), out, pil=pil, console=Console(quiet=True))
    document = json.loads((out / "comparison.json").read_text())
    jsonschema.validate(document, schema("comparison"))
    (table,) = tables_of((out / "comparison.html").read_text())["Comparison"]
    worst = max(x["residual_rms"] or 0.0 for x in document["variants"])
    assert document["uncontrolled"] > worst
    return document["variants"], table


@pytest.fixture(scope="module")
def on_a_processor(study, tmp_path_factory):
    needs_target()
    return compared(study, tmp_path_factory.mktemp("compared"), "cortex-m4f")


def test_arithmetics_side_by_side(on_a_processor):
    (single, fixed, short), table = on_a_processor
    assert [x["is_exportable"] for x in (single, fixed, short)] == [True, True, False]
    assert fixed["gain_margin"] == pytest.approx(single["gain_margin"], rel=1e-4)
    assert fixed["residual_rms"] == pytest.approx(single["residual_rms"], rel=0.02)
    assert single["rounding"] == 0 < fixed["rounding"] < 0.01 < 10 < short["rounding"]
    assert short["gain_margin"] == pytest.approx(single["gain_margin"], rel=0.05)
    assert table["arithmetic"][0] == "single precision" and len(table["gain margin"]) == 3


def test_instructions_and_flash(on_a_processor):
    variants, table = on_a_processor
    single, fixed, short = variants
    # a unit for single precision needs less than products of 64 bits, and so do those of 32
    assert 0 < single["instructions"] < short["instructions"] < fixed["instructions"] < 6000
    assert all(500 < x["flash"] < 6000 and 0 < x["load"] < 1 for x in variants)
    assert table["load at 168 MHz"][1].endswith("%")
    assert table["sample rate [kHz]"][0] == "10 (own)"


def variant(rate, word, margin, residual, load):
    figures = {"gain_margin": margin, "residual_rms": residual, "load": load}
    return Variant(sample_rate=rate, word=word, **figures)


def test_the_cheapest_of_those_as_good_is_recommended():
    made = [
        variant(5e3, 0, 1.8, 1.00e-7, 0.01),  # no margin
        variant(5e3, 32, 2.5, 1.20e-7, 0.02),  # more vibration
        variant(10e3, 16, 2.5, 1.00e-7, 0.02),  # not exported
        variant(10e3, 0, 2.5, 1.02e-7, 0.05),
        variant(20e3, 0, 2.5, 1.00e-7, 0.10),
        variant(20e3, 32, 2.5, 0.99e-7, 1.10),  # takes too long
    ]
    found = ComparedVariants(
        study=None,
        motion="",
        board=None,
        dac_bits=12,
        variants=tuple(made),
        uncontrolled=1e-5,
    )
    assert cheapest(found) is made[3]
    assert cheapest(found.replace(variants=tuple(made[:1]))) is None
    # the stillest of those that may be used decides what counts as much vibration
    some = (made[1], made[3], variant(10e3, 32, 2.5, 0.5e-7, 0.5))
    assert cheapest(found.replace(variants=some)) is some[2]


def test_rows_of_the_table():
    """Of what is exported, what rounds too much and what there is not, without a processor."""
    made = (
        variant(10e3, 0, 2.5, 1.234567e-7, None),
        variant(10e3, 32, 2.25, 2e-6, None).replace(rounding=0.25),
        variant(20e3, 16, 2.5, 1e-7, None).replace(rounding=20.0),
        Variant(20e3, 32, fault="control.gain_factor = 5"),
    )
    study = SimpleNamespace(electronics=SimpleNamespace(sample_rate_hz=10e3))
    rows = comparison._rows(SimpleNamespace(study=study, variants=made, board=None))
    written = "studies export writes it"
    assert rows[0] == ["10 (own)", "single precision", "2.5", "0.1235", "no bound", written]
    assert [row[0] for row in rows] == ["10 (own)", "10 (own)", "20", "20"]
    assert rows[1][2:] == ["2.25", "2", "0.25", written]
    assert rows[2][2:5] == ["2.5", "0.1", "20"] and rows[2][5] != written
    assert rows[3][2:] == ["", "", "", "none: control.gain_factor = 5"]


def test_a_study_without_sampled_controller_is_refused(tmp_path):
    needs_compiler()
    ideal = DESIGNS["paper"] | {"control": {"feedback": "ideal"}}
    study = write_study(tmp_path / "ideal.toml", ideal)
    with pytest.raises(StudyError, match="control.feedback = 'ideal'; allowed: 'sampled'"):
        compare_variants(load_design(study), tmp_path / "out", console=Console(quiet=True))
    assert not (tmp_path / "out").exists()


def test_a_rate_without_controller_has_a_row(tmp_path):
    """Gains that are stable at no rate: the reason is in every row."""
    needs_compiler()
    strong = DESIGNS["paper"] | {"control": {"velocity_gain": [3.1, 3.5, 3.4], "gain_factor": 5.0}}
    study = write_study(tmp_path / "strong.toml", strong)
    variants, table = compared(study, tmp_path / "out")
    page = text_of((tmp_path / "out" / "comparison.html").read_text())
    assert "--pil cortex-m4f" in page and "None keeps a gain margin of 2" in page
    assert not any(x["is_exportable"] for x in variants)
    assert all("control.gain_factor = 5" in x["fault"] for x in variants)
    assert table["gain margin"] == [""] * 3
