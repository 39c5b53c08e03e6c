"""The command line: what it writes, and that bad input ends in one message and exit code 2.

All short runs are of one small study.
"""

import ast
import contextlib
import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray
from rich.table import Table

import studies
from studies import cli, sources
from studies.cli import app, console, main
from studies.engine.modes import machine_modes
from studies.job import resumable
from studies.single.say import machine_notes
from studies.study.files import READY
from studies.study.margin import margin_in_db
from studies.study.spec import load_study
from studies.study.template import toml_text
from tests import canonical
from tests.bare import parse_study
from tests.canonical import HOME, MACHINE
from tests.pages import TITLE, parsed, rendered, text_of

HOME_PHI = HOME[2]
SHORT = canonical.text_of(MACHINE)
#: Bare links that keep their length.
KEPT = {"basis": "pinned_pinned", "stretch": False}


def run(capsys, *arguments):
    """Exit code, stdout and stderr of a command."""
    code = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_titles_and_names_send_no_control_sequences_to_the_terminal(capsys, tmp_path):
    console.print("title \x1b]0;owned\x07 \x9b31m \u202e", soft_wrap=True)
    table = Table("head \x1b[2J")
    table.add_row("cell \x1b[2J")
    console.print(table)
    out = capsys.readouterr().out
    assert "title \\x1b]0;owned\\x07 \\x9b31m \\u202e" in out and "cell \\x1b[2J" in out
    assert not set(out) & set("\x1b\x07\x9b\u202e")
    code, _, err = run(capsys, "simulate", tmp_path / "\x1b[2J.toml", "--out", tmp_path / "x.h5")
    assert code == 2 and "\\x1b[2J.toml" in err and "\x1b" not in err


def test_names_that_are_no_utf_8_are_refused(capsys, tmp_path):
    name = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.toml")
    Path(name).write_text(SHORT)
    assert "not UTF-8 text; rename" in refused(capsys, "simulate", name, "--out", tmp_path / "x.h5")
    assert load_study(name).link.modes == 3


def refused(capsys, *arguments):
    """Its last line on stderr, of a command that must fail; unlikely sizes may come first."""
    code, _, err = run(capsys, *arguments)
    *sizes, message = err.splitlines()
    assert code == 2 and message.startswith("studies: "), err
    assert all("is far from what machines have" in line for line in sizes), err
    return message


def refused_study(capsys, folder, text):
    """The message of `studies simulate` on a bad study, which must leave no file."""
    (folder / "bad.toml").write_text(text)
    message = refused(capsys, "simulate", folder / "bad.toml", "--out", folder / "run.h5")
    assert [entry.name for entry in folder.iterdir()] == ["bad.toml"]
    return message


@pytest.fixture(scope="module")
def short_folder(tmp_path_factory):
    """A run with its report, under a name with a blank."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "short.toml").write_text(f"title = '{TITLE}'\n{SHORT}")
    shown = io.StringIO()
    out = folder / "my run.h5"
    with contextlib.redirect_stdout(shown):
        main(["simulate", str(folder / "short.toml"), "--out", str(out), "--report"])
    assert "status: ok" in shown.getvalue() and "[µm]" in shown.getvalue()
    assert f"written: {out}\nreport: {folder / 'my run.html'}\n" in shown.getvalue()
    return folder


@pytest.fixture(scope="module")
def short_run(short_folder):
    with xarray.open_dataset(short_folder / "my run.h5", engine="h5netcdf") as data:
        return data.load()


TRAJECTORIES = {
    "time": (("time",), "s"),
    "pose": (("time", "pose_axis"), "m; m; rad"),
    "pose_error": (("time", "pose_axis"), "m; m; rad"),
    "slider": (("time", "slider_axis"), "m"),
    "modal_coordinate": (("time", "link", "mode"), "m"),
    "chord_deflection": (("time", "link"), "m"),
    "chord_deflection_stations": (("time", "link", "station"), "m"),
    "sensor_voltage": (("time", "link", "patch"), "V"),
    "actuator_voltage": (("time", "link", "patch"), "V"),
    "slider_force": (("time", "slider_axis"), "N"),
}


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_simulate_writes_labelled_trajectories(short_run, name):
    dims, units = TRAJECTORIES[name]
    assert short_run[name].dims == dims
    assert short_run[name].attrs["units"] == units
    assert short_run[name].attrs["long_name"]
    assert short_run[name].dtype == np.float64
    assert np.all(np.isfinite(short_run[name]))


def test_simulate_writes_a_consistent_run(short_run):
    axes = {"time": 500, "link": 3, "station": 3, "mode": 3, "patch": 3, "pose_axis": 3}
    assert {name: short_run.sizes[name] for name in axes} == axes
    np.testing.assert_allclose(short_run.time, np.arange(500) * 1e-4, rtol=0, atol=1e-15)
    np.testing.assert_allclose(short_run.station, [0.25, 0.5, 0.75])
    assert list(short_run.pose_axis.values) == ["x", "y", "phi"]
    np.testing.assert_allclose(short_run.spectrum_point, np.linspace(0.9, 1.1, 9))
    ratio = short_run.spectrum_frequency / short_run.spectrum_frequency.sel(spectrum_point=1.0)
    np.testing.assert_allclose(ratio, np.broadcast_to(short_run.spectrum_point, ratio.shape))
    assert int(short_run.status) == 0 and float(short_run.gain_margin) > 1
    assert json.loads(short_run.attrs["study"])["title"] == TITLE
    # the platform arrives, and middle and mid-span station are one place
    assert np.all(abs(short_run.pose[-1] - [0, 0.01, HOME_PHI]) < [5e-5, 5e-5, 1e-4])
    middle = short_run.chord_deflection_stations.sel(station=0.5)
    np.testing.assert_allclose(short_run.chord_deflection, middle, rtol=1e-12, atol=1e-18)
    assert float(abs(short_run.actuator_voltage).max()) > 0.1


def test_simulate_prints_its_answer_without_a_file(short_folder, short_run, capsys):
    before = sorted(short_folder.iterdir())
    code, out, err = run(capsys, "simulate", short_folder / "short.toml")
    assert (code, err) == (0, "") and out.startswith("status: ok\n")
    for link in range(3):
        assert f"{1e6 * float(short_run.residual_rms[link].max()):.4g}" in out
    assert "written" not in out and sorted(short_folder.iterdir()) == before
    assert ("Less than 2 um is left: joints" in out) == (short_run.residual_rms.max() < 2e-6)


def test_what_a_real_machine_would_do_beside_is_said():
    def notes(residual, friction=0.0, strain=1e-4):
        study = SimpleNamespace(
            machine=SimpleNamespace(joint_friction=friction),
            patches=SimpleNamespace(strain_limit=4e-4),
        )
        peaks = {"patch_strain_peak": np.array([0.0, strain])}
        metrics = SimpleNamespace(residual_rms=np.array([1e-7, residual]), **peaks)
        return machine_notes(SimpleNamespace(study=study, result=SimpleNamespace(metrics=metrics)))

    said = [notes(1.9e-6), notes(2.1e-6), notes(1.9e-6, 1e-4), notes(float("nan"))]
    assert [len(x) for x in said] == [1, 0, 0, 0] and "joints that rub" in said[0][0]
    strained = "Ceramics strained up to 0.00041, patches.strain_limit = 0.0004."
    assert notes(1.0, strain=4.1e-4) == [strained]


def test_simulate_warns_of_patches_that_are_strained_too_far(
    short_folder, short_run, capsys, tmp_path
):
    study, peak = tmp_path / "short.toml", float(short_run.patch_strain_peak.max())
    strained = "status: patches strained beyond patches.strain_limit\nnext step: move more slowly"
    for factor, wanted, said in ((1.001, 0, "status: ok\n"), (0.999, 1, strained)):
        limit = f"\n[patches]\nstrain_limit = {factor * peak}\n"
        study.write_text((short_folder / "short.toml").read_text() + limit)
        code, out, _ = run(capsys, "simulate", study)
        assert code == wanted and out.startswith(said)


def test_the_metrics_agree_with_the_trajectories(short_run):
    after = short_run.time > float(short_run.command_end) - 0.5e-4
    within = short_run.time < float(short_run.command_end) + 0.015 - 0.5e-4
    window = short_run.chord_deflection_stations[(after & within).values]
    rms = np.sqrt((window**2).mean("time"))
    np.testing.assert_allclose(short_run.residual_rms, rms, rtol=1e-9)
    peak = abs(short_run.actuator_voltage).max(("time", "patch"))
    np.testing.assert_allclose(short_run.peak_voltage, peak, rtol=1e-12)


def test_the_report_of_a_run_is_whole(short_folder, short_run):
    names = {f"my run{end}" for end in (".h5", ".html")}
    figures = {f"my run-{name}.png" for name in ("deflection", "error", "voltage", "machine")}
    assert {path.name for path in short_folder.iterdir()} == names | figures | {"short.toml"}
    found = parsed((short_folder / "my run.html").read_text(encoding="utf-8"))
    assert found.title == f"{TITLE}: one run" and TITLE in found.text
    # links, platform, three tracked modes, versions
    assert len(found.images) == 4 and found.rows == [[8] * 4, [4] * 4, [3] * 4, [2] * 9]
    rms = f"{1e6 * float(short_run.residual_rms[1].max()):.4g}"
    margin = f"gain margin {margin_in_db(float(short_run.gain_margin))}, the factor"
    watched = f"the run ends {50 - 1e3 * float(short_run.command_end):.4g} ms after"
    for part in (
        "Status: ok.",
        watched,
        f" 2 {rms} ",
        margin,
        "settling time [ms]",
        "φ [µrad]",
        "flexlink-studies",
        "residual_length = 0.015",
    ):
        assert part in " ".join(found.text.split())
    assert "/" not in found.text.partition("Versions")[2].partition("Study file")[0]  # no path


@pytest.mark.parametrize("width", [1280, 600])
def test_a_browser_shows_all_of_a_report(short_folder, tmp_path, width):
    html = (short_folder / "my run.html").read_text(encoding="utf-8")
    *whole, cut = rendered(html, tmp_path, width)
    assert whole == [4, 0, 0] and (cut == 0) == (width == 1280)


def test_reports_that_cannot_be_are_refused_before_the_run(capsys, tmp_path):
    study = tmp_path / "short.toml"
    study.write_text(SHORT)
    assert "name their file with --out" in refused(capsys, "simulate", study, "--report")
    arguments = ("simulate", study, "--report", "--out")
    assert "allowed: a file .h5" in refused(capsys, *arguments, tmp_path / "run.html")
    (tmp_path / "run.html").mkdir()
    assert "run.html: cannot write there, it is a" in refused(
        capsys, *arguments, tmp_path / "run.h5"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"short.toml", "run.html"}


def columns(document):
    """Frequencies [Hz], damping ratios and descriptions of the modes in a document."""
    rows = ([x["frequency"], x["damping_ratio"], x["description"]] for x in document["modes"])
    return tuple(zip(*rows, strict=True))


def test_modes_as_json_and_as_table(capsys, tmp_path):
    code, out, err = run(capsys, "modes", "--n-modes", 2, "--json")
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert list(found) == ["format", "format_version", "modes"]
    frequency, ratio, names = map(list, columns(found))
    moves = [f"drive, platform {x}, 100 %" for x in ("translates", "translates", "turns")]
    assert names[:9] == [
        *moves,
        *(f"links 1 2 3, mode {k}, 100 %" for k in (1, 1, 1, 2, 2, 2)),
    ]
    assert all(name.startswith("links 1 2 3 lengthen, ") for name in names[9:])
    drive, link = found["modes"][2], found["modes"][8]
    told = {"kind": "drive", "links": [], "order": None, "platform": "turns"}
    assert drive == drive | told and drive["share"] == pytest.approx(1, abs=5e-3)
    told = {"kind": "link", "links": [1, 2, 3], "order": 2, "platform": None}
    assert link == link | told and link["share"] == pytest.approx(1, abs=5e-3)
    told = {"kind": "stretch", "links": [1, 2, 3], "order": None, "platform": None}
    assert all(x == x | told and x["share"] > 0.9 for x in found["modes"][9:])
    assert len(frequency) == len(ratio) == 3 + 3 * (2 + 1)
    assert np.all(np.diff(frequency) >= 0)
    np.testing.assert_allclose(ratio, 0.0, atol=1e-12)
    # the links vibrate near the frequencies of bare pinned links
    assert np.all(np.abs(np.array(frequency[3:6]) / 114.39 - 1) < 0.01)
    kept = tmp_path / "kept.toml"
    kept.write_text(toml_text({"link": KEPT}))
    damped = ("--n-modes", 2, "--kd", 60, "--damping", 0.01, "--locked")
    code, out, _ = run(capsys, "modes", kept, *damped)
    assert code == 0 and "damping ratio" in out and "114.388" in out and "0.01000" in out
    assert "links 1 2 3, mode 2, 100 %" in out


UNLIKE = {"link": {"modes": 2, "damping_ratio": 0.0, "thickness": [2e-3, 2.2e-3, 1.7e-3]}}


def test_modes_name_their_link():
    study = parse_study(UNLIKE | {"drive": {"kd": 0.0}, "metrics": {"residual_delay": 0.0}})
    locked, free = machine_modes(study, locked=True), machine_modes(study)
    by_thickness = [f"link {i}, mode {j}, 100 %" for j in (1, 2) for i in (3, 1, 2)]
    assert locked.names == by_thickness
    np.testing.assert_allclose(locked.link_share.max(axis=(1, 2)), 1.0, rtol=1e-9)
    assert free.names[3:] == by_thickness and all("drive" in name for name in free.names[:3])
    rigid = machine_modes(study, kp=0.0)
    assert rigid.names == ["rigid motion"] * 3 + by_thickness
    assert [x.links for x in rigid.modes] == [(), (), ()] + [(3,), (1,), (2,)] * 2
    largest = rigid.link_share[3:].max(axis=(1, 2))
    np.testing.assert_allclose([x.share for x in rigid.modes[3:]], largest)


@pytest.mark.parametrize(
    ("thickness", "stretch"),
    [(UNLIKE["link"]["thickness"], False), (2e-3, False), (UNLIKE["link"]["thickness"], True)],
)
def test_shares_of_modes_are_what_their_frequencies_gain_from_stiffness(thickness, stretch):
    """d ln f^2 / d ln k is the share of k in the potential energy; in groups of equal frequency."""
    step, study = 1e-4, parse_study(UNLIKE | {"metrics": {"residual_delay": 0.0}})
    study = study.change(link__thickness=thickness, drive__kd=0.0, drive__kp=2e4)
    study = study.change(link__stretch=stretch, link__stretch_damping=0.0)

    def gained(**change):
        high, low = (
            machine_modes(study.change(**{name: f(sign) for name, f in change.items()}))
            for sign in (step, -step)
        )
        return np.log(high.frequency / low.frequency) / step

    found = machine_modes(study)
    of_link = gained(link__stiffness_factor=lambda x: (1.0, 1.0 + x, 1.0))
    of_drive = gained(drive__kp=lambda x: 2e4 * (1 + x))
    assert [x.kind for x in found.modes[9:]] == ["stretch"] * 3 * stretch
    alone = np.arange(9 + 3 * stretch)
    kinds = [slice(0, 3), slice(3, 6), slice(6, 9)] if thickness == 2e-3 else alone
    for kind in kinds:
        share = found.link_share[kind][..., 1, :].sum(axis=-1)
        np.testing.assert_allclose(np.sum(of_link[kind]), np.sum(share), atol=2e-6)
        np.testing.assert_allclose(np.sum(of_drive[kind]), found.drive_share[kind].sum(), atol=2e-6)


@pytest.mark.long  # in short: two poses of a five-bar, and a pose of a loaded machine
def test_modes_at_another_pose_differ(capsys):
    moved = run(capsys, "modes", "--n-modes", 2, "--pose", "0.01,0.005,0.6", "--json")
    home = run(capsys, "modes", "--n-modes", 2, "--json")
    moved, home = (np.array(columns(json.loads(out))[0]) for _, out, _ in (moved, home))
    assert 1e-4 < np.max(np.abs(moved / home - 1)) < 0.2


def test_modes_of_a_study_are_those_of_its_own_machine(capsys, tmp_path):
    """Patches, joint inertia and damping; a load changes the links' frequencies.

    Of links that keep their length: those that lengthen mix in the damping of their elongations.
    """
    measured, links = tmp_path / "measured.toml", "[link]\nstretch = false\n"
    measured.write_text((READY / "measured.toml").read_text().replace("[link]\n", links))
    out = run(capsys, "modes", measured, "--locked", "--json")[1]
    found, ratio, _ = columns(json.loads(out))
    frequency = np.array(found).reshape(-1, 3)
    np.testing.assert_allclose(frequency[:2, 0], [92.5, 240.2], atol=0.1)
    np.testing.assert_allclose(ratio, 0.01, rtol=1e-6)
    study = tmp_path / "loaded.toml"
    load = "[load]\nwrench = [20, 0, 0]\n[motion]\nmove_time = [0.1, 0.1, 0.1, 0.2]\n"
    study.write_text(f'{links}basis = "pinned_pinned"\n{load}')
    out = run(capsys, "modes", study, "--kd", 0, "--pose", f"0,0,{np.pi / 6}", "--json")[1]
    np.testing.assert_allclose(
        columns(json.loads(out))[0][3:6], [108.19, 118.16, 118.47], rtol=2e-4
    )  # finite elements


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--kp", -1), "drive.kp = -1.0; allowed: a finite number >= 0 and <= 1e+08 [N/m]"),
        (("--kp", "stiff"), "Invalid value for '--kp'"),
        (("--kd", "inf"), "kd = inf; allowed: a finite number"),
        (("--damping", 1.5), "link.damping_ratio = 1.5; allowed: a finite number >= 0 and < 1,"),
        (("--n-modes", 0), "link.modes = 0; allowed: a whole number >= 1 and <= 16 [1]"),
        (("--n-modes", 17), "link.modes = 17; allowed: a whole number >= 1 and <= 16 [1]"),
        (("--basis", "pinned_pined"), "did you mean 'pinned_pinned'?"),
        (("--locked", "--basis", "pinned_free"), "allowed: pinned_pinned or loaded, where"),
        (("--pose", "1,x"), "--pose = '1,x'; allowed: numbers with commas between them"),
        (("--pose", "1,2"), "= [1.0, 2.0]; allowed: 3 finite numbers"),
        (("--pose", "nan,0,0.5"), "= nan; allowed: a finite number"),
        (
            ("--n-modes", 2, "--pose", "0.5,0,0.5"),
            "guide_offsets moves it) (here: pose out of reach; link 1 is 0.2 m long",
        ),
        (("--n-modes", 2, "--pose", "0.09526,0.055,-1.047"), "(here: singular pose: a link along"),
        (("--poze", 1, 2, 3), "No such option: --poze (Possible options:"),
    ],
)
def test_modes_refuses(capsys, arguments, words):
    assert words in refused(capsys, "modes", *arguments)


changed = partial(canonical.text_of, MACHINE)
# 110 mm against the normal of guide 1 every link stands well at phi = 0 and at -120 deg; turning
# from one to the other takes h of link 1 from 29 mm through 0 (parallel to the guide) to -6 mm.
X, Y = 0.0952627944, 0.055
TURN = [[X, Y, 0.0], [X, Y, -2 * math.pi / 3]]


def ideal(gain):
    return {"feedback": "ideal", "velocity_gain": [gain, 1.0, 1.0]}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            changed(motion={"waypoints": [HOME, [0.3, 0.0, HOME_PHI]]}),
            "motion.waypoints.1 = [0.3, 0.0, 0.523598775598",
        ),
        (
            changed(motion={"waypoints": TURN}),
            "(here: singular pose: a link along or across the path of its",
        ),
        (
            changed(run={"duration": 0.035}, shaper={"kind": "ei"}),
            "run.duration = 0.035; allowed: at least 0.0388, the end of the motion with its shaper",
        ),
        (
            changed(metrics={"residual_length": 0.04}),
            "metrics.residual_length = 0.04; allowed: 0.0001 to 0.02, from one sample to what "
            "run.duration = 0.05 leaves",
        ),
        (
            changed(metrics={"residual_delay": 0.03}),
            "run.duration = 0.05; allowed: 0.08 or more: nothing is left for the residual window "
            "after the shaped motion of 0.03 s and metrics.residual_delay = 0.03; metrics.resid",
        ),
        (
            changed(control=ideal(1e6)),
            "control.gain_factor = 1.0; allowed: gains low enough for 200 plant steps per sample",
        ),
        (
            changed(link=KEPT, control=ideal(1e3), run={"substeps": 1}),
            "run.substeps = 1; allowed: ",
        ),
        (
            changed(electronics={"lowpass_ratio": [3.0, 11.0]}),
            "low-pass corners below half the sample rate, 5000 Hz; the highest of the 3 is at 1132",
        ),
        (changed(link={"length": 0.01}), "patches.actuator_length = 0.03; allowed: at"),
        (
            changed(link=KEPT | {"thickness": 0.1, "youngs_modulus": 2e12, "density": 1.0}),
            "link.modes = 3; allowed: modes up to 1.592e+05 Hz at electronics.sample_rate_hz",
        ),
        ("[patches]\ncenters = [0.05, 0.06, 0.15]", "so that no patches overlap [m]"),
        (
            "[patches]\ncenters = [0.02, 0.04, 0.06, 0.1, 0.12, 0.14, 0.16]",
            "0.16]; allowed: 6 at most, so that patches 0.03 m long do not overlap on a link 0.2 m",
        ),
        ("[control]\nmodes = 4", "control.modes = 4; allowed: 1 to 3, the number of patch pairs"),
        ("[run]\nduration = ", "not valid TOML"),
    ],
)
def test_simulate_refuses(capsys, tmp_path, text, words):
    assert words in refused_study(capsys, tmp_path, text)


def test_a_binary_file_is_refused(capsys, tmp_path):
    (tmp_path / "bad.toml").write_bytes(b"\x89HDF\r\n\x1a\n\xff")
    message = refused(capsys, "simulate", tmp_path / "bad.toml", "--out", tmp_path / "run.h5")
    assert "not UTF-8 text" in message
    message = refused(capsys, "simulate", tmp_path / "none.toml", "--out", tmp_path / "run.h5")
    assert "No such file" in message
    assert [entry.name for entry in tmp_path.iterdir()] == ["bad.toml"]


def test_a_target_that_cannot_be_written_is_refused_before_the_run(capsys, tmp_path):
    (tmp_path / "short.toml").write_text(SHORT)
    inside = tmp_path / "missing" / "run.h5"
    message = refused(capsys, "simulate", tmp_path / "short.toml", "--out", inside)
    assert "missing is not a folder; create it first" in message
    message = refused(capsys, "simulate", tmp_path / "short.toml", "--out", tmp_path)
    assert "it is a folder or a device; name a file" in message
    below = tmp_path / "short.toml" / "run.h5"
    assert "is not a folder" in refused(capsys, "simulate", tmp_path / "short.toml", "--out", below)
    assert [entry.name for entry in tmp_path.iterdir()] == ["short.toml"]


def test_a_bad_precision_or_command_is_refused(capsys, tmp_path):
    (tmp_path / "short.toml").write_text(SHORT)
    arguments = ("simulate", tmp_path / "short.toml", "--out", tmp_path / "run.h5")
    message = refused(capsys, *arguments, "--precision", "float16")
    assert "precision = 'float16'; allowed: float64 or float32; did you mean 'float64'?" in message
    assert "--out: name a folder" in refused(capsys, "tune", "tune")
    assert "No such command 'simulat'" in refused(capsys, "simulat")
    code, out, _ = run(capsys)
    assert code == 2 and "simulate" in out


def test_init_writes_a_study_once(capsys, tmp_path):
    target = tmp_path / "my.toml"
    code, out, _ = run(capsys, "init", target)
    assert code == 0 and "written" in out
    text = target.read_text()
    assert run(capsys, "init")[1] == text
    whole = run(capsys, "init", "--all")[1]
    assert len(whole.splitlines()) > 5 * len(text.splitlines())
    assert "leave one of them out" in refused(capsys, "init", "--all", "--from", "placement")
    assert "exists already; name a new file" in refused(capsys, "init", target)
    capsys.readouterr()
    main(["init", "--from", "placement"])
    assert capsys.readouterr().out == (READY / "placement.toml").read_text()
    assert "did you mean 'placement'" in refused(capsys, "init", "--from", "placment")
    assert target.read_text() == text
    assert "is not a folder" in refused(capsys, "init", tmp_path / "missing" / "my.toml")
    assert [entry.name for entry in tmp_path.iterdir()] == ["my.toml"]


def test_info_names_versions_devices_and_precision(capsys):
    code, out, _ = run(capsys, "info")
    assert code == 0
    for word in ("flexlink-studies", "jax", "devices", "float64", "cache", "traced kernel"):
        assert word in out


def test_an_unstable_loop_is_said_loudly_and_beside_no_control(capsys, tmp_path):
    (tmp_path / "loud.toml").write_text(changed(control={"gain_factor": 20.0}))
    out = tmp_path / "run.h5"
    code, text, _ = run(capsys, "simulate", tmp_path / "loud.toml", "--out", out, "--report")
    assert code == 1 and "UNSTABLE LOOP" in text
    report = text_of((tmp_path / "run.html").read_text())
    assert "**UNSTABLE LOOP" in report
    # the column beside is what the same study leaves without control
    (tmp_path / "open.toml").write_text(changed(control={"links": [False] * 3}))
    alone = tmp_path / "open.h5"
    run(capsys, "simulate", tmp_path / "open.toml", "--out", alone)
    with xarray.open_dataset(alone) as data:
        wanted = 1e6 * data["residual_rms"].values.max(axis=1)
    table = [row.split("|") for row in report.splitlines() if row.startswith("| ")]
    column = [cell.strip() for cell in table[0]].index("residual rms without control [µm]")
    found = [float(row[column]) for row in table[1:4]]
    np.testing.assert_allclose(found, wanted, rtol=1e-3)


def test_every_public_verb_is_a_command():
    """And commands that are none only read files, or are of the program itself."""
    known = {one.name or one.callback.__name__ for one in app.registered_commands}
    verbs = {verb.__name__ for verb in cli.VERBS}
    assert all(getattr(studies, name) in cli.VERBS for name in verbs - {"bench"})
    others = {"show", "best", "sensitivity", "plot"}
    assert known == verbs | others | {"cache", "info", "init", "schema"}


def test_the_version_is_that_of_the_package(capsys):
    assert run(capsys, "--version") == (0, f"flexlink-studies {studies.__version__}\n", "")


#: Packages of extras.
OPTIONAL = ("distributed", "dask", "diffrax", "pyuff", "blackjax", "control")


def imported(path):
    """What a file imports when it is imported: not in functions, nor for type checkers."""
    waiting, names = list(ast.parse(path.read_bytes()).body), set()
    for node in waiting:
        if isinstance(node, ast.Import):
            names |= {part.name for part in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module, *(f"{node.module}.{part.name}" for part in node.names)}
        elif not isinstance(node, ast.FunctionDef) and "TYPE_CHECK" not in ast.unparse(node)[:20]:
            waiting += [x for x in ast.iter_child_nodes(node) if isinstance(x, ast.stmt)]
    return names | {name.partition(".")[0] for name in names}


def test_only_what_runs_on_a_cluster_imports_its_package():
    """When it is used: all commands work after an install without extras."""
    files = (sources.TOP / "studies").rglob("*.py")
    modules = {".".join(x.relative_to(sources.TOP).with_suffix("").parts): x for x in files}
    imports = {module: imported(path) for module, path in modules.items()}
    lacking, found = None, set()
    while found != lacking:  # also what imports these
        lacking = found
        found = {module for module, names in imports.items() if names & {*OPTIONAL, *lacking}}
    assert not lacking


@pytest.mark.long  # in short: as the files say
def test_only_what_runs_on_a_cluster_needs_its_package():
    text = f"""
import importlib, pkgutil, sys
for name in {OPTIONAL}:
    sys.modules[name] = None
import studies
lacking = []
for module in pkgutil.walk_packages(studies.__path__, "studies."):
    try:
        importlib.import_module(module.name)
    except ImportError:
        lacking.append(module.name)
print(*sorted(lacking))
"""
    run = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=120)
    assert run.stdout.split() == [], run.stderr


def test_sigterm_interrupts_as_ctrl_c_does(monkeypatch, capsys, tmp_path):
    """What batch systems end a job with; the command that goes on is named where there is one."""
    arguments = ["tune", "x.toml", "--out", str(tmp_path)]

    def ended(**_):
        with resumable(tmp_path):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(cli, "app", ended)
    try:
        with pytest.raises(SystemExit) as error:
            main(arguments)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert error.value.code == 130
    again = f"continue with: studies {' '.join(arguments)} --resume"
    assert again in capsys.readouterr().err
