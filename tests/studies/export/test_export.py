"""Exports of whole designs, by command: each does what the JAX controller does."""

import json
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import jsonschema
import numpy as np
import pytest

import studies
from jaxmodel.state_space import StateSpace
from studies.engine.controller import fixed_controller
from studies.export import run as export_run
from studies.export import sequences, targets
from studies.export.compiler import STRICT
from studies.export.document import _of_system, document, import_study, study_hash
from studies.export.verify import AIM
from studies.study.spec import load_study
from tests import TOP
from tests.bare import paper_study
from tests.canonical import MACHINE, with_sections
from tests.exports import (
    DESIGNS,
    needs_compiler,
    needs_cpp,
    needs_sanitizers,
    write_study,
)
from tests.pages import text_of
from tests.studies.test_cli import refused, run

TARGETS = ("json", "c", "c-fixed")


@pytest.fixture(scope="module", autouse=True)
def short_sequences():
    with mock.patch.object(sequences, "LENGTH", 300):  # is part of no program: they are kept
        yield


@pytest.fixture(scope="module")
def designs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("designs")
    return {name: write_study(folder / f"{name}.toml", data) for name, data in DESIGNS.items()}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Where a design's export is, by design and target; filled by the tests below."""
    return tmp_path_factory.mktemp("exports")


def exported(capsys, designs, folders, name, target):
    """Folder with an export, made once, and what the command said."""
    out = folders / f"{name}-{target}"
    if target != "json":
        needs_compiler()
    if not out.is_dir():
        code, text, _ = run(capsys, "export", designs[name], "--target", target, "--out", out)
        assert code == 0, text
        (folders / f"{out.name}.txt").write_text(text)
    return out, (folders / f"{out.name}.txt").read_text()


@pytest.mark.parametrize(
    "name, target",
    [
        # a controller built from the file alone is compiled anew: one design is enough for now
        pytest.param(n, t, marks=[pytest.mark.long] if t == "json" and n != "paper" else [])
        for n in DESIGNS
        for t in TARGETS
    ],
)
def test_export_is_verified(capsys, designs, folders, name, target):
    out, text = exported(capsys, designs, folders, name, target)
    report = text_of((out / "verification.html").read_text())
    assert report.startswith("# Verification: passed") and "FAILED" not in report
    assert "comparisons agree" in text
    files = {"json": {"flexlink.json", "flexlink.schema.json"}}.get(
        target, {"flexlink.h", "flexlink.c"}
    )
    assert {path.name for path in out.iterdir()} == files | {"verification.html"}
    if target == "c-fixed":
        assert "multiplications a sample" in text
        loss = float(re.search(r"Residual vibration: ([+-][\d.]+) % against", report)[1])
        assert abs(loss) < 100 * AIM
        assert re.search(r"\| bit by bit, recorded codes \| 0 of \d+ codes differ", report)
        assert re.search(
            r"\n\| signal \| Q \| base \| room \| reach \|\n\| sensors \| \d+ \|", report
        )
        code = (out / "flexlink.c").read_text()
        assert re.search(r"\bsignal {20,}Q {10,}base +room +reach\n.*\bsensors {20,}", code)
    else:
        found = [
            float(x) for x in re.findall(r"open loop, [^|]*codes \| ([\d.e+-]+) \| 1e-12", report)
        ]
        assert len(found) >= 2 and max(found) < 1e-12
    if target == "c":
        assert "With float, recorded codes" in text and "precise enough" in text
        assert re.search(r"faulty sensor: NaN \| sensor \d, sample 1 ", report)


@pytest.mark.long  # in short: the blocks of such a controller, in test_observers
def test_an_observer_at_50_khz(capsys, tmp_path):
    """Its poles crowd round 1: the verification failed by 8e-12."""
    needs_compiler()
    data = with_sections(
        MACHINE,
        run={"duration": 0.06},
        control={"law": "lqg"},
        electronics={"sample_rate_hz": 5e4},
        motion={"waypoints": [[0.0, 0.0, 0.5236], [0.0, 0.002, 0.5236]], "move_time": 0.02},
    )
    path = write_study(tmp_path / "lqg.toml", data)
    code, text, _ = run(capsys, "export", path, "--target", "c", "--out", tmp_path / "out")
    assert code == 0 and "verified: " in text and "FAILED" not in text, text


@pytest.mark.long
@pytest.mark.parametrize("target", ["c", "c-fixed"])
def test_the_papers_study_at_full_size(capsys, tmp_path, target):
    needs_compiler()
    paper = Path(studies.__file__).parent / "specs" / "paper.toml"
    code, text, _ = run(capsys, "export", paper, "--target", target, "--out", tmp_path / "out")
    assert code == 0 and "comparisons agree" in text
    loss = float(re.search(r"in the loop, C.*residual vibration by ([+-][\d.e-]+) %", text)[1])
    assert abs(loss) < (100 * AIM if target == "c-fixed" else 1e-6)


@pytest.mark.parametrize(
    "name, target",
    [
        ("single", "c"),
        ("tuned", "c-fixed"),
        *(pytest.param(*x, marks=pytest.mark.long) for x in (("paper", "c"), ("tuned", "c"))),
        *(pytest.param(x, "c-fixed", marks=pytest.mark.long) for x in ("paper", "single")),
    ],
)
def test_code_compiles_as_cpp_and_under_more_warnings(
    capsys, designs, folders, name, target, tmp_path
):
    out, _ = exported(capsys, designs, folders, name, target)
    strict = [*STRICT, "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Wstrict-prototypes"]
    made = ["-c", "-o", tmp_path / "object.o"]
    subprocess.run([*needs_compiler(), *strict, *made, out / "flexlink.c"], check=True, timeout=120)
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", *made, "-x", "c++"]
    subprocess.run([*needs_cpp(), *flags, out / "flexlink.c"], check=True, timeout=120)


STUBS = """
#include <stdint.h>
static void dac_write(const uint16_t *x) { (void)x; }
static void adc_read(uint16_t *x) { x[0] = 2048; }
static void amplifiers(int on) { (void)on; }
static void command_sliders(const int32_t *x) { (void)x; }
void start(const int32_t pose[3]);
void sample_interrupt(void);
"""


def test_the_example_of_the_documentation_compiles(capsys, designs, folders, tmp_path):
    out, _ = exported(capsys, designs, folders, "paper", "c-fixed")
    page = (TOP / "docs" / "reference" / "export.md").read_text()
    example = re.search(r"```c\n(#include.*?)```", page, re.DOTALL)[1]
    (tmp_path / "main.c").write_text(STUBS + example)
    made = ["-I", out, "-c", "-o", tmp_path / "main.o", tmp_path / "main.c"]
    subprocess.run([*needs_compiler(), *STRICT, *made], check=True, timeout=120)


def test_code_refuses_to_be_compiled_without_nan(capsys, designs, folders, tmp_path):
    out, _ = exported(capsys, designs, folders, "paper", "c")
    command = [*needs_compiler(), "-ffast-math", "-c", "-o", tmp_path / "o.o", out / "flexlink.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode and "leave out the check for NaN" in done.stderr


def fuzz(out, target, folder, samples, seeds, single=False):
    """Samples of anything at all under sanitizers; the last line that the program prints."""
    flags = ["-std=c99", "-O1", "-g", "-I", out]
    flags += ["-DFIXED"] if target == "c-fixed" else []
    flags += ["-DFLEXLINK_REAL=float"] if single else []
    program = folder / "fuzz"
    sources = ["tests/data/fuzz.c", out / "flexlink.c"]
    subprocess.run(
        [*needs_sanitizers(folder), *flags, "-o", program, *sources], check=True, timeout=120
    )
    for seed in range(seeds):
        done = subprocess.run(
            [program, str(samples), str(seed)],
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        assert done.returncode == 0, done.stdout + done.stderr[-3000:]
        assert re.fullmatch(rf"{samples} samples, [1-9]\d* faults\n", done.stdout)


@pytest.mark.parametrize("name, target", [("single", "c"), ("tuned", "c-fixed")])
def test_fuzzing_finds_nothing(capsys, designs, folders, name, target, tmp_path):
    out, _ = exported(capsys, designs, folders, name, target)
    fuzz(out, target, tmp_path, 100_000, 1)


HELD = """
#include <math.h>
#include <stdio.h>
#include "flexlink.h"

int main(void)
{
    flexlink_shaper shaper;
    double pose[3] = {1, 2, 3}, bad[3] = {1, NAN, 3}, shaped[3];
    int k;

    flexlink_shape_init(&shaper, pose);
    pose[0] = 5;
    flexlink_shape_step(&shaper, pose, shaped);
    for (k = 0; k < 2 * FLEXLINK_SHAPER_LENGTH; k++) {
        bad[0] = k % 2 ? INFINITY : 7;
        flexlink_shape_step(&shaper, bad, shaped);
    }
    printf("%.9g %.9g %.9g", shaped[0], shaped[1], shaped[2]);
    flexlink_shape_init(&shaper, bad);
    flexlink_shape_step(&shaper, bad, shaped);
    printf(" %.9g %.9g %.9g", shaped[0], shaped[1], shaped[2]);
    return 0;
}
"""


def test_the_shaper_holds_the_last_finite_reference(capsys, designs, folders, tmp_path):
    """And begins at zero where there is none; without a start, it stays in its memory."""
    out, _ = exported(capsys, designs, folders, "single", "c")
    (tmp_path / "held.c").write_text(HELD)
    command = [*needs_compiler(), "-std=c99", "-I", out, "-o", tmp_path / "held"]
    subprocess.run([*command, tmp_path / "held.c", out / "flexlink.c"], check=True, timeout=120)
    done = subprocess.run(
        [tmp_path / "held"], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout == "5 2 3 0 0 0"


@pytest.mark.long
@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("target", ["c", "c-fixed"])
def test_long_fuzzing_finds_nothing(capsys, designs, folders, name, target, tmp_path):
    out, _ = exported(capsys, designs, folders, name, target)
    fuzz(out, target, tmp_path, 3_000_000, 3)
    if target == "c":
        fuzz(out, target, tmp_path, 3_000_000, 1, single=True)


def test_fuzzing_notices_a_fault(capsys, designs, folders, tmp_path):
    out, _ = exported(capsys, designs, folders, "single", "c")
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "flexlink.h").write_text((out / "flexlink.h").read_text())
    code = (out / "flexlink.c").read_text()
    (broken / "flexlink.c").write_text(
        code.replace("volts > LIMIT ? LIMIT", "volts > 2 * LIMIT ? 2 * LIMIT")
    )
    with pytest.raises(AssertionError, match="out of range"):
        fuzz(broken, "c", tmp_path, 10_000, 1)


def test_wrong_code_is_not_written(capsys, designs, tmp_path, monkeypatch):
    needs_compiler()
    right = targets.floating_source

    def wrong(*arguments):
        source = right(*arguments)
        return source._replace(code=re.sub(r"R\((-?\d\.\d{8})\d+", r"R(\1", source.code))

    monkeypatch.setattr(targets, "floating_source", wrong)
    out = tmp_path / "wrong"
    code, text, _ = run(capsys, "export", designs["paper"], "--target", "c", "--out", out)
    assert code == 1 and "FAILED: open loop, recorded codes" in text
    assert {path.name for path in out.iterdir()} == {"verification-failed.html"}
    assert "no code was written" in text_of((out / "verification-failed.html").read_text())
    monkeypatch.undo()
    code, text, _ = run(capsys, "export", designs["paper"], "--target", "c", "--out", out)
    assert code == 0
    files = {"flexlink.h", "flexlink.c", "verification.html"}
    assert {path.name for path in out.iterdir()} == files


def test_json_follows_its_schema_and_says_what_everything_is(capsys, designs, folders):
    out, _ = exported(capsys, designs, folders, "tuned", "json")
    data = json.loads((out / "flexlink.json").read_text())
    schema = json.loads((out / "flexlink.schema.json").read_text())
    jsonschema.validate(data, schema)
    for name, number in data["numbers"].items():
        assert number["unit"] and number["meaning"], name
        assert np.ndim(number["value"]) == len(number["axes"]), name
    assert data["masks"]["links"] == [True] * 3 and data["numbers"]["voltage_limit"]["value"] == 100
    assert data["study_hash"] == study_hash(load_study(designs["tuned"]))
    weights = data["numbers"]["shaper_weight"]["value"]
    assert sum(weights) == pytest.approx(1.0, abs=1e-14)
    del data["numbers"]["sample_rate"]["unit"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data, schema)


@pytest.mark.parametrize("name", DESIGNS)
def test_import_gives_the_study_back_exactly(capsys, designs, folders, name, tmp_path):
    out, _ = exported(capsys, designs, folders, name, "json")
    back = tmp_path / "back.toml"
    assert run(capsys, "init", back, "--from", out / "flexlink.json")[0] == 0
    assert load_study(back) == load_study(designs[name])
    again = tmp_path / "again"
    arguments = ("--target", "json", "--no-verify", "--out", again)
    assert run(capsys, "export", back, *arguments)[0] == 0
    assert {p.name for p in again.iterdir()} == {"flexlink.json", "flexlink.schema.json"}
    assert (again / "flexlink.json").read_bytes() == (out / "flexlink.json").read_bytes()


def change(value):
    """A number next to the given one, anywhere in nested lists."""
    return [change(value[0]), *value[1:]] if isinstance(value, list) else value + 1e-3


@pytest.mark.parametrize("name", ["velocity_gain", "modal_filter", "low_pass_a1", "shaper_weight"])
def test_import_refuses_changed_numbers(capsys, designs, folders, name, tmp_path):
    out, _ = exported(capsys, designs, folders, "paper", "json")
    data = json.loads((out / "flexlink.json").read_text())
    data["numbers"][name]["value"] = change(data["numbers"][name]["value"])
    (tmp_path / "changed.json").write_text(json.dumps(data))
    arguments = ("init", tmp_path / "back.toml", "--from", tmp_path / "changed.json")
    message = refused(capsys, *arguments)
    assert f"numbers.{name}[0" in message and "export it again" in message
    assert not (tmp_path / "back.toml").exists()


@pytest.mark.parametrize(
    "edit, message",
    [
        (lambda data: data["study"]["control"].update(gain_factor=0.7), "study was changed after"),
        (lambda data: data["study"]["control"].update(gain_factr=0.7), "gain_factr"),
        (lambda data: data["numbers"].pop("adc_step"), "numbers.adc_step: missing"),
        (lambda data: data["numbers"]["adc_step"].update(value=[1.0, "x"]), "adc_step"),
        (lambda data: data["numbers"]["adc_step"].update(value=[1.0]), "shape"),
        (lambda data: data.update(format_version=2), "format_version = 2"),
        (lambda data: data.update(format="other"), "not a controller"),
        (lambda data: data.pop("masks"), "masks"),
        (lambda data: data["masks"].update(links=[False] * 3), "masks = "),
        (lambda data: data.update(law="srf"), "law = 'srf'"),
        (lambda data: data.update(title="other"), "title = 'other'"),
        (lambda data: data["numbers"]["adc_step"].update(unit="mV"), "adc_step.unit = 'mV'"),
        (lambda data: data["numbers"]["adc_step"].update(axes=["x"]), "adc_step.axes"),
        (lambda data: data["numbers"]["adc_step"].update(value="0.1"), "adc_step"),
        (lambda data: data["numbers"]["shaper_weight"].update(value=[10**400]), "shaper_weight"),
        (lambda data: data["study"].update(run=5), "changed.json: study: run = 5"),
    ],
)
def test_import_refuses_other_files(capsys, designs, folders, edit, message, tmp_path):
    out, _ = exported(capsys, designs, folders, "paper", "json")
    data = json.loads((out / "flexlink.json").read_text())
    edit(data)
    (tmp_path / "changed.json").write_text(json.dumps(data))
    assert message in refused(
        capsys, "init", tmp_path / "back.toml", "--from", tmp_path / "changed.json"
    )


@pytest.mark.parametrize(
    "content", [b"{", b'{"a": 1, "a": 1}', b"\xff\xfe", b"[]", b"[" * 100_000, b'{"format": NaN}']
)
def test_import_refuses_what_is_no_json(capsys, content, tmp_path):
    (tmp_path / "bad.json").write_bytes(content)
    refused(capsys, "init", tmp_path / "back.toml", "--from", tmp_path / "bad.json")


def test_import_refuses_targets(capsys, designs, folders, tmp_path):
    out, _ = exported(capsys, designs, folders, "paper", "json")
    (tmp_path / "there.toml").write_text("")
    there = ("init", tmp_path / "there.toml", "--from", out / "flexlink.json")
    assert "exists already" in refused(capsys, *there)
    missing = ("init", tmp_path / "back.toml", "--from", tmp_path / "missing.json")
    assert "cannot be read" in refused(capsys, *missing)
    assert import_study(out / "flexlink.json").title == "paper's gains"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--target", "cpp"), "json, c, c-fixed"),
        (("--target", "c", "--name", "2x"), "--name"),
        (("--target", "c", "--name", "a b"), "--name"),
        (("--target", "c-fixed", "--dac-bits", "3"), "--dac-bits"),
        (("--target", "c", "--case", "4"), "leave --case out"),
        (("--target", "c", "--dac-bits", "12"), "not allowed with --target c"),
        (("--target", "c", "--name", "stdint"), "--name"),
    ],
)
def test_export_refuses_arguments(capsys, designs, arguments, message, tmp_path):
    out = tmp_path / "out"
    assert message in refused(capsys, "export", designs["paper"], *arguments, "--out", out)
    assert not out.exists()


def test_export_refuses_folders_it_cannot_write(capsys, designs, tmp_path):
    (tmp_path / "file").write_text("")
    arguments = ("export", designs["paper"], "--target", "json", "--out")
    assert "is not a folder" in refused(capsys, *arguments, tmp_path / "file")
    assert "is not a folder" in refused(capsys, *arguments, tmp_path / "file" / "deeper")


def test_without_a_compiler_code_is_written_and_said_to_be_unverified(
    capsys, designs, tmp_path, monkeypatch
):
    monkeypatch.setattr(export_run, "find_compiler", list)
    arguments = ("export", designs["paper"], "--target", "c", "--out", tmp_path / "out")
    assert "no C compiler" in refused(capsys, *arguments, "--verify")
    code, text, _ = run(capsys, *arguments)
    assert code == 0 and "not verified: no C compiler" in text
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"flexlink.h", "flexlink.c"}


def test_designs_of_a_tuning(capsys, designs, tmp_path):
    folder = tmp_path / "tune"
    folder.mkdir()
    (folder / "tune.json").write_text("{}")
    arguments = ("export", folder, "--target", "json", "--no-verify", "--out", tmp_path / "out")
    assert "not finished" in refused(capsys, *arguments)
    (folder / "tuned_gains.toml").write_text(designs["tuned"].read_text())
    (folder / "study.toml").write_text(designs["paper"].read_text())
    assert run(capsys, *arguments)[0] == 0
    (folder / "tuned_filters.toml").write_text(designs["paper"].read_text())
    assert "filters, gains, the families of" in refused(capsys, *arguments)
    assert "did you mean 'gains'" in refused(capsys, *arguments, "--case", "gain")
    assert run(capsys, *arguments, "--case", "gains")[0] == 0
    assert json.loads((tmp_path / "out" / "flexlink.json").read_text())["title"] == "tuned"


def test_document_names_the_case_of_a_sweep(designs):
    found = fixed_controller(load_study(designs["paper"]))
    assert document(found, "0123456789abcdef").case_id == "0123456789abcdef"


def test_a_system_s_anti_windup_is_described_where_it_has_one():
    system = StateSpace(*(np.zeros((1, 1, 1, 1)) for _ in range(3)), np.zeros((1, 1, 1)))
    assert "anti_windup" not in _of_system(system)
    told = _of_system(system._replace(anti_windup=np.full((1, 1, 1, 1), 0.5)))
    assert told["anti_windup"].value == [[[[0.5]]]]


def test_headers_count_links_from_1():
    study = paper_study().change(control__links=(True, False, True))
    header = " ".join(export_run._origin(SimpleNamespace(study=study), ""))
    assert "controlled links 1+3," in header


def test_a_motion_at_the_end_of_the_adc_is_refused(capsys, tmp_path):
    data = {**DESIGNS["paper"], "electronics": {"conditioner_gain": 30.0}}
    data["control"] = {"gain_factor": 0.001}
    path = write_study(tmp_path / "clipped.toml", data)
    out = tmp_path / "out"
    text = refused(capsys, "export", path, "--target", "json", "--out", out)
    assert "conditioner_gain = 30.0" in text and "taken for a broken sensor" in text
    assert not out.exists()


@pytest.mark.parametrize("title", ["*\\ int evil; ", "a ???/", "/* */ */ \n #error", "*/ ü"])
def test_a_title_stays_a_comment(capsys, tmp_path, title):
    path = write_study(tmp_path / "titled.toml", {**DESIGNS["paper"], "title": title})
    arguments = ("--target", "c", "--no-verify", "--out", tmp_path / "out")
    assert run(capsys, "export", path, *arguments)[0] == 0
    made = ["-c", "-o", tmp_path / "object.o", tmp_path / "out" / "flexlink.c"]
    subprocess.run([*needs_compiler(), *STRICT, *made], check=True, timeout=120)
    assert "evil" not in re.sub(
        r"/\*.*?\*/", "", (tmp_path / "out" / "flexlink.c").read_text(), flags=re.DOTALL
    )


@pytest.mark.parametrize("command", ["gcc 'unclosed", "true", "nonsense-compiler", "false"])
def test_a_bad_compiler_is_named(capsys, designs, tmp_path, monkeypatch, command):
    monkeypatch.setenv("CC", command)
    arguments = ("--target", "c", "--verify", "--out", tmp_path / "out")
    text = refused(capsys, "export", designs["paper"], *arguments)
    assert "CC" in text and not (tmp_path / "out").exists()


def test_files_are_written_together_or_not_at_all(capsys, designs, tmp_path):
    (tmp_path / "flexlink.c").mkdir()
    arguments = ("--target", "c", "--no-verify", "--out", tmp_path)
    assert "is a folder" in refused(capsys, "export", designs["paper"], *arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["flexlink.c"]
