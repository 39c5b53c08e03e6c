"""The commands of sweeps, in one process: sweep, dry run, show, best, plot, sensitivity, cases."""

import dataclasses
import json
import re
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import xarray
from PIL import Image

from studies.engine.design import load_design
from studies.engine.folder import BASELINE, MANIFEST
from studies.engine.frame import frame_of
from studies.engine.preflight import check_run
from studies.engine.results import metric_values, read_sweep
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.explorer.replays import rows_to_replay
from studies.show.pages import page as make_page
from studies.study.consistency import patch_centers
from studies.study.template import toml_value
from studies.sweeps import explore
from studies.sweeps.say import report_of
from tests import canonical
from tests.canonical import MACHINE
from tests.pages import about, parsed, text_of, unpacked
from tests.studies.test_cli import refused, run
from tests.sweeps import BASE, narrow_blocks

SWEEP = """
[sweep]
method = "{method}"
count = {count}
metrics = ["residual_rms", "peak_voltage", "control_energy"]
[sweep.axes]
gain = {{ from = 0.05, to = 1.0, scale = "log" }}
"drive.kp" = {{ from = 1e4, to = 4e4 }}
placement = {{ kind = "mirrored" }}
"""


def toml_of(sweep):
    lines = [f'title = "{BASE["title"]}"']
    for name, section in BASE.items():
        if isinstance(section, dict):
            lines += [f"[{name}]", *(f"{k} = {toml_value(v)}" for k, v in section.items())]
    return "\n".join(lines) + sweep


@pytest.fixture(autouse=True, scope="module")
def small_chunks():
    with narrow_blocks(16):
        yield


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    path = tmp_path_factory.mktemp("spec") / "small.toml"
    sweep = SWEEP.format(method="saltelli", count=8)
    path.write_text(canonical.text_of({"title": "small", **MACHINE}) + sweep)
    return path


def test_a_sweep_from_its_file_to_its_figures(capsys, spec, tmp_path):
    out = tmp_path / "s"
    code, text, _ = run(capsys, "sweep", spec, "--dry-run")
    assert code == 0 and "40 cases" in text and "sample: case 20" in text
    assert not out.exists() and "cannot run" not in text
    assert re.search(r"time: about \d+ s for 40 cases .* by 32 that were run", text)
    mebibytes = float(re.search(r"Storage: about (\S+) MiB", text)[1])
    code, text, _ = run(capsys, "sweep", spec, "--out", out, "--report")
    assert (
        code == 0
        and "40/40 cases" in text
        and "executor: traced kernel" in text
        and "results.h5" in text
    )
    assert f"report: {out / 'report.html'}\n" in text
    assert mebibytes == pytest.approx((out / "results.h5").stat().st_size / 2**20, rel=0.8)
    check_report(out)
    check_uncontrolled(capsys, spec, out)
    check_explorer(capsys, out)
    code, text, _ = run(capsys, "show", out)
    assert code == 0 and "ok" in text and "best cases by residual_rms" in text
    assert "residual_rms [µm]" in text
    assert run(capsys, "show", out, "--failed")[0] == 0
    code, text, _ = run(
        capsys,
        "best",
        out,
        "--by",
        "control_energy",
        "--subject-to",
        "peak_voltage<100 and gain > 0.1",
        "--count",
        "3",
    )
    assert code == 0 and "V2 s" in text
    code, text, _ = run(capsys, "sensitivity", out, "--by", "control_energy")
    assert code == 0 and "placement" in text and "first" in text
    code, text, _ = run(
        capsys, "simulate", out, "--case", "3", "--out", tmp_path / "run.h5", "--report"
    )
    assert code == 0 and "largest relative difference of a metric" in text
    assert (tmp_path / "run.h5").stat().st_size > 10_000
    page = parsed((tmp_path / "run.html").read_text(encoding="utf-8"))
    assert (
        len(page.images) == 4
        and "he sweep has: ok; largest relative difference of a metric" in page.text
    )
    _, text, _ = run(capsys, "best", out, "--by", "residual_rms", "--count", "1")
    number, name = re.search(r"(\d+) +│ ([0-9a-f]{8}) ", text).groups()
    assert load_design(out, f"id:{name}").study == load_design(out, int(number)).study
    design = load_design(out, int(number))
    assert re.fullmatch("[0-9a-f]{16}", design.case_id) and design.case_id.startswith(name)
    assert "fits 40 cases" in refused(capsys, "simulate", out, "--case", "id:")
    assert "allowed: 0 to 39" in refused(capsys, "simulate", out, "--case", "40")
    for options, name in (
        ((), "placement.png"),
        (("--x", "gain", "--hue", "drive.kp"), "points.pdf"),
        (("--x", "patches.centers[0]", "--y", "control_energy"), "energy.svg"),
    ):
        assert run(capsys, "plot", out, *options, "--out", tmp_path / name)[0] == 0
        assert (tmp_path / name).stat().st_size > 5_000
    assert Image.open(tmp_path / "placement.png").size[0] > 600
    for command, wrong, name in (
        (("plot", out, "--x"), "gian", "gain"),
        (("plot", out, "--x", "gain", "--hue"), "drive.pk", "drive.kp"),
        (("plot", out, "--y"), "residul_rms", "residual_rms"),
        (("best", out, "--by"), "placment", "placement"),
        (("best", out, "--by", "residual_rms", "--subject-to"), "gian > 1", "gain"),
    ):
        assert f"did you mean {name!r}?" in refused(capsys, *command, wrong)


def check_uncontrolled(capsys, spec, folder):
    """The baseline without control is a run of its own; resuming keeps it, older sweeps lack it."""
    data = read_sweep(folder)
    alone = run_study(data.spec.study.change(control__links=(False,) * 3), has_loop=False)
    wanted = alone.result.metrics["residual_rms"]
    np.testing.assert_allclose(data.baseline["residual_rms"].data, wanted, rtol=1e-9)
    step = frame_of(*check_run(data.spec.study)).adc_step
    np.testing.assert_allclose(data.baseline["adc_step"].data, step, rtol=1e-12)
    joined = xarray.open_dataset(folder / "results.h5", engine="h5netcdf")
    with joined, xarray.open_dataset(folder / BASELINE, engine="h5netcdf") as baseline:
        assert {"link", "station"} <= baseline.coords.keys() <= joined.coords.keys()
        for name in baseline.coords:
            xarray.testing.assert_identical(baseline[name], joined[name])
        assert baseline.attrs["case_id"] and baseline.attrs["precision"] == "float64"
    told = f"residual_rms of the baseline without control: {1e6 * wanted.max():.4g} µm"
    value, is_ok = np.nanmax(data["residual_rms"], axis=(1, 2)), data["status"] == 0
    text = run(capsys, "best", folder, "--by", "residual_rms", "--count", "99")[1]
    assert told in text
    worse = is_ok & (value > wanted.max())
    rows = [int(k) for k in re.findall(r"(?m)^│ (\d+) .* \* +│", text)]
    assert rows == [k for k in np.argsort(value, kind="stable") if worse[k]]
    assert told in text_of((folder / "report.html").read_text(encoding="utf-8")).partition("## ")[0]
    file = folder / BASELINE
    kept = data.baseline["residual_rms"].data
    before, whole = file.stat().st_mtime_ns, file.read_bytes()
    code, said, wrong = run(capsys, "sweep", spec, "--out", folder, "--resume", "--no-progress")
    assert (code, wrong) == (0, "") and said.startswith("0 cases in ") and said.count("\n") == 1
    assert file.stat().st_mtime_ns == before
    file.write_bytes(whole[:999])
    assert "damaged; remove it and go on with --resume" in refused(capsys, "show", folder)
    file.unlink()
    text = run(capsys, "show", folder)[1]
    assert "best cases by residual_rms" in text and "without control" not in text
    code, said, wrong = run(capsys, "sweep", spec, "--out", folder, "--resume", "--no-progress")
    assert (code, wrong) == (0, "") and said.startswith("0 cases in ") and said.count("\n") == 1
    np.testing.assert_array_equal(read_sweep(folder).baseline["residual_rms"].data, kept)


def check_explorer(capsys, out):
    with mock.patch.object(explore, "rows_to_replay", partial(rows_to_replay, most=2)):
        code, text, _ = run(capsys, "explore", out)
    assert code == 0 and text.endswith(f"explorer: {out / 'explorer.html'}\n")
    data, numbers = unpacked((out / "explorer.html").read_text(encoding="utf-8"))
    sweep = read_sweep(out)
    columns = {x["name"]: numbers(x["value"]) for x in data["columns"]}
    np.testing.assert_allclose(columns["drive.kp"], sweep["drive.kp"], rtol=1e-6)
    shown = 1e6 * metric_values(sweep, "residual_rms")
    np.testing.assert_allclose(columns["residual_rms"], shown, rtol=1e-6)
    for row in (3, 17):
        centers = 1e3 * np.asarray(patch_centers(load_design(out, row).study))
        np.testing.assert_allclose(numbers(data["placement"]["centers"])[row], centers, rtol=1e-6)
    replay = data["replays"][0]
    record = run_study(load_design(out, replay["row"]).study, has_loop=False).result.record
    pose = numbers(replay["motions"][0]["joint"]).mean(axis=1)  # of the platform's three joints
    last = float(numbers(replay["frameTime"])[-1])
    command_end = float(sweep["command_end"][replay["row"]])
    at = np.argmin(np.abs(record.time - command_end - 1e-3 * last))
    np.testing.assert_allclose(pose[-1], 1e3 * record.pose[at, :2], atol=1e-3)
    assert len(replay["motions"]) == 2 and "without control" not in data["reasons"].values()
    page = (out / "explorer.html").read_text(encoding="utf-8")
    said = about(page)
    assert said["varied"] == "control.gain_factor, drive.kp, patches.centers (saltelli)"
    assert said["cases"].startswith("40 cases: ") and "links of 200 mm" in said["baseline"]
    assert "not of this sweep" not in page
    check_strangers(capsys, out)


def check_strangers(capsys, out):
    """Cases of another sweep in the folder are neither shown nor called "not run" in silence."""
    manifest = out / MANIFEST
    before, page = manifest.read_bytes(), (out / "explorer.html").read_bytes()
    spec = json.loads(before)
    spec["spec"]["sweep"]["axes"]["drive.kp"]["to"] = 5e4
    manifest.write_text(json.dumps(spec))
    said = refused(capsys, "explore", out)
    assert (
        "no case has residual_rms; 40 finished cases in this folder are not of this sweep" in said
    )
    assert (out / "explorer.html").read_bytes() == page
    manifest.write_bytes(before)


def check_report(folder):
    """The report of the sweep against its data; then with other outcomes."""
    html = (folder / "report.html").read_text(encoding="utf-8")
    page, text = parsed(html), text_of(html)
    data = read_sweep(folder)
    code, gain = data["status"], data["control.gain_factor"]
    count = int(np.sum(code == 0))
    for part in (
        "\n8 base points of a Saltelli design of:\n",
        "\n- `gain` (`control.gain_factor`): 0.05 to 1, log scale.",
        "40 cases.",
        "| drive.kp | N/m |",
        f"| ok | {count} | {count / 0.4:.1f} |",
    ):
        assert part in text
    assert page.title == "small: sweep" and len(page.images) == 3 and "[sweep.axes]" in page.text
    safe = (code == 0) & (data["gain_margin"] >= 2)
    count = int(safe.sum())
    assert 10 < count < 40
    value = np.where(safe, np.nanmax(data["residual_rms"], axis=(1, 2)), np.inf)
    first = (
        f"**Result:** Best by residual_rms: case {np.argmin(value)} with {1e6 * value.min():.4g} µm"
    )
    head = text.partition("## ")[0]
    assert first in head and "40 cases of control.gain_factor, drive.kp, patches.cent" in head
    best = text.partition("## Best cases by residual_rms")[2].partition("\n## ")[0]
    rows = [int(k) for k in re.findall(r"(?m)^\| (\d+) ", best)]
    assert rows == np.argsort(value, kind="stable")[: min(count, 10)].tolist()

    def told(code):
        changed = {**data.variables, "status": data.variables["status"]._replace(data=code)}
        changed = dataclasses.replace(data, variables=changed)
        return text_of(make_page(report_of(changed)))

    loud = int(np.sum(gain > 0.5))
    text = told(np.where(gain > 0.5, 4, 0))
    assert 0 < loud < 40 and f"| non-finite number | {loud} | {loud / 0.4:.1f} |" in text
    first = text.partition("## What the failures depend on")[2].split("\n| ")[2]
    assert first.startswith("control.gain_factor | 1.00 |") and "| 0 % (<=" in first
    text = told(np.full(40, 4))
    assert "**Result:** No case has residual_rms. 0 of 40 cases ended ok (40: non-finite" in text
    assert re.findall(r"!\[(\w+)\]", text) == ["machine"]
    assert (
        "## What the failures depend on" not in text
    )  # where nothing is ok there is nothing to compare


def test_a_dry_run_says_why_its_sample_cannot_run(capsys, spec, tmp_path):
    short = tmp_path / "short.toml"  # the residual window does not fit; the program is the same
    text = spec.read_text()
    short.write_text(text.replace("residual_length = 0.015", "residual_length = 0.04"))
    code, text, _ = run(capsys, "sweep", short, "--dry-run")
    assert code == 0 and "the sample cannot run: metrics.residual_length = 0.04; allowed" in text


def test_a_folder_of_other_things_does_not_hide_a_ready_study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = Path("paper_gains")
    ready = load_design(name)
    name.mkdir()  # as left by studies certify paper_gains --out paper_gains
    (name / "report.html").write_text("-")
    assert load_design(name) == ready
    (name / "sweep.json").write_text("-")  # a sweep of that name is what is meant
    with pytest.raises(StudyError, match="damaged"):
        load_design(name)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("show", "nowhere"), "not the folder of a sweep"),
        (("best", "nowhere", "--by", "x"), "not the folder of a sweep"),
        (("plot", "nowhere"), "not the folder of a sweep"),
        (("simulate", "nowhere.toml"), "cannot be read"),
        (("simulate", "nowhere.toml", "--case", "1"), "leave --case out"),
        (("sweep", "nowhere.toml", "--out", "x"), "cannot be read"),
        (
            ("certify", "papr", "--out", "x"),
            "papr: cannot be read (no such file); did you mean 'paper'?",
        ),
        (("sweep", "gains"), "--out: name a folder"),
        (("sweep", "gains", "--dry-run", "--report"), "--dry-run produces no results"),
    ],
)
def test_commands_refuse(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert words in refused(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []
