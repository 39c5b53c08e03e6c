"""A tuning from its file to its folder: results, resume, audit, what is refused."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from scipy.stats import spearmanr

from studies import cli, tune
from studies.engine.results import read_sweep
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.explore import explore
from studies.job import working
from studies.results.labelled import Variables
from studies.show.pages import page
from studies.space.spec import parse_sweep
from studies.store import read_store
from studies.study import spec as spec_module
from studies.study.files import read_toml
from studies.study.spec import load_study
from studies.sweeps.show import ranked_cases
from studies.tuning import audit as audit_module
from studies.tuning import results
from studies.tuning import run as tuning_run
from studies.tuning import say as say_module
from studies.tuning.audit import Disagreement
from studies.tuning.check import JudgedDesign, OwnRun
from studies.tuning.evaluate import Evaluation, Evaluator
from studies.tuning.findings import TuneFindings, best_family
from studies.tuning.folder import CHECKED, PROGRESS, fixed_part, load_progress
from studies.tuning.loop_figures import DesignFigures
from studies.tuning.objective import objective_of
from studies.tuning.optimise import begin, is_compatible
from studies.tuning.say import n_outside, rank_correlation, say
from studies.tuning.spec import load_tuning
from tests.bare import paper_study, parse_tuning
from tests.pages import about, parsed, text_of
from tests.sweeps import run_sweep
from tests.tunings import GAIN, SMALL, tuning

FILE = """
run = { duration = 0.06 }
link = { modes = 2, length = [0.2, 0.21, 0.2], thickness = [2.0e-3, 2.1e-3, 1.95e-3] }
machine = { slider_mass = [0.15, 0.16, 0.15], guide_offsets = [0.0, 0.005, 0.0] }
load = { mass = 0.05, offset = [0.01, -0.005] }
control = { modes = 2, ratios = [[1.0, 0.3], [1.0, 0.3], [1.0, 0.3]] }
shaper = { kind = "none" }
metrics = { residual_delay = 0.002, residual_length = 0.02 }

[motion]
waypoints = [[0.0, 0.0, 0.5235987755982988], [0.0, 0.01, 0.5235987755982988]]
move_time = 0.03

[tune]
starts = 2
iterations = 3
samples = 20
limits = { peak_voltage = "baseline", gain_margin = 1.0 }
pareto = { limit = "peak_voltage", values = [20.0, 40.0], family = "all" }
scenarios = { count = 2, check = 3, spread = { "link.youngs_modulus" = 5.0 } }

[tune.free]
"control.gain_factor" = { from = 0.05, to = 2.0, scale = "log" }
placement = { kind = "same" }

[tune.families]
gains = { free = ["control.gain_factor"] }
all = {}
loud = { free = [], set = { "control.gain_factor" = 1.0 } }
"""


def table_of(text, title):
    """Rows of the first table below a heading of a report, by their first cell."""
    part = text.split(f"## {title}")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    heads, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: dict(zip(heads, row, strict=True)) for row in rows}


def simulated(study):
    """What a run of a study says, in the units of the report, and its objective's size."""
    run = run_study(study, has_record=False)
    metrics, links = run.result.metrics, list(np.flatnonzero(study.control.links))
    return {
        "residual_rms [µm]": 1e6 * metrics.residual_rms[links].max(),
        "settling_time [ms]": 1e3 * metrics.settling_time[links].max(),
        "peak_voltage [V]": metrics.peak_voltage[links].max(),
        "gain margin": run.loop.gain_margin,
        "rms": np.sqrt(np.mean(metrics.residual_rms[links] ** 2)),
    }


def same(told, value):
    """Whether a number of a report is this one, to the digits that it has."""
    told = told.removeprefix("not within ")
    digits = len(told.replace(".", "").replace("-", "").lstrip("0"))
    return abs(float(told) - value) <= 0.51 * 10.0 ** (1 - min(digits, 4)) * max(abs(value), 1e-9)


def check_report(out):
    """Every number of its tables, from the files of the designs, on the machines of the file."""
    text, data = (
        text_of((out / "report.html").read_text(encoding="utf-8")),
        read_store(out / "tune.h5")[0],
    )
    own = table_of(text, "On the nominal machine")
    fresh = table_of(text, "On fresh machines")
    files = {name: row["file"].strip("`") for name, row in own.items() if row["file"] != "-"}
    compared = ["without control", "gain_factor alone"]
    assert list(own) == list(fresh) == ["baseline", *data["family"].data, *compared]
    assert len(files) == len(own) - 3  # nor has a family that moves nothing a file
    moduli = data["link.youngs_modulus"].data
    seeds = data["run.seed"].data.tolist()
    assert load_study(out / "study.toml").link.youngs_modulus not in moduli
    first = None
    for name, file in files.items():
        study = load_study(out / file)
        runs = [
            simulated(study),
            *(
                simulated(study.change(link__youngs_modulus=modulus, run__seed=seed))
                for modulus, seed in zip(moduli, seeds, strict=True)
            ),
        ]
        first = first or runs
        shares = np.array([a["rms"] / b["rms"] for a, b in zip(runs, first, strict=True)])
        assert same(own[name]["objective"], shares[0])
        assert same(fresh[name]["objective, mean"], shares[1:].mean())
        assert same(fresh[name]["objective, worst"], shares[1:].max())
        for head in ("residual_rms [µm]", "settling_time [ms]", "peak_voltage [V]"):
            assert same(own[name][head], runs[0][head]), (name, head)
            assert same(fresh[name][head], max(run[head] for run in runs[1:])), (name, head)
        assert same(own[name]["gain margin"], runs[0]["gain margin"])
        if name in data["family"].data:
            row = list(data["family"].data).index(name)
            wanted = [1e-6 * run["residual_rms [µm]"] for run in runs[1:]]
            np.testing.assert_allclose(data["fresh_residual_rms"].data[row], wanted, rtol=1e-9)


def check_explorer(out):
    """Its page tells when the folder has been begun with another file since."""
    said = about(explore(out, progress=False).folder.read_text(encoding="utf-8"))
    assert said["free"] == "control.gain_factor, placement[0][0], placement[0][1], placement[0][2]"
    assert said["starting points"] == "8 starting points: 8 descended"
    manifest = out / "tune.json"
    before = manifest.read_text()
    stale = "is of another tuning file than"
    assert stale not in (out / "explorer.html").read_text(encoding="utf-8")
    manifest.write_text(before.replace('"iterations": 3', '"iterations": 7'))
    assert stale in explore(out, progress=False).folder.read_text(encoding="utf-8")
    manifest.write_text(before)


def test_a_baseline_without_a_stable_loop_is_refused(tmp_path, capsys):
    file = tmp_path / "t.toml"
    limits = 'limits = { peak_voltage = "baseline", gain_margin = 1.0 }'
    assert limits in FILE
    text = FILE.replace(
        limits, 'limits = { peak_voltage = "baseline" }\nobjective = { spillover = 1 }'
    )
    file.write_text(text.replace("ratios =", "velocity_gain = [3e3, 3e3, 3e3], ratios ="))
    with pytest.raises(SystemExit, match="2"):
        cli.main(["tune", str(file), "--out", str(tmp_path / "out"), "--no-progress"])
    message = capsys.readouterr().err
    assert "tune.objective.spillover: the loop of the baseline is unstable on machine 1" in message
    assert "1/s; allowed: > 0 on every machine" in message and "Traceback" not in message


@pytest.mark.long
def test_a_margin_can_be_a_goal_beside_a_metric(tmp_path, capsys):
    """Both improve; the tables say on which machines, from the studies' own loops."""
    file, out = tmp_path / "t.toml", tmp_path / "out"
    free = '[tune.free]\n"control.gain_factor" = { from = 0.05, to = 2.0, scale = "log" }\n'
    wanted = """
starts = 2
iterations = 5
samples = 20
objective = { residual_rms = 1.0, disk_margin = 0.5 }
limits = { disk_margin = "baseline" }
scenarios = { count = 2, check = 3, spread = { "link.youngs_modulus" = 5.0 } }
"""
    file.write_text(FILE.partition("starts =")[0] + wanted + free)
    cli.main(["tune", str(file), "--out", str(out)])
    said = capsys.readouterr().out
    data, text = read_store(out / "tune.h5")[0], text_of((out / "report.html").read_text())
    own, fresh = (
        table_of(text, f"On {x} machine{y}") for x, y in (("the nominal", ""), ("fresh", "s"))
    )
    assert float(fresh["tuned"]["objective, worst"]) < 0.9
    for table in (own, fresh):
        rms, margin = (
            [float(table[x][y]) for x in ("tuned", "baseline")]
            for y in ("residual_rms [µm]", "disk margin")
        )
        assert rms[0] < rms[1] and margin[0] > 1.1 * margin[1]
    assert "on the worst of 2 machines, the nominal one among them" in text
    margins = []
    for name in ("tuned", "study"):
        study = load_study(out / f"{name}.toml")
        machines = [study.change(link__youngs_modulus=x) for x in data["link.youngs_modulus"].data]
        margins.append(
            [
                run_study(x, has_record=False, has_margins=True).loop.robustness["disk_margin"]
                for x in (*machines, study)
            ]
        )
    np.testing.assert_allclose(data["fresh_disk_margin"].data[0], margins[0][:3], rtol=1e-4)
    np.testing.assert_allclose(data["fresh_baseline_disk_margin"].data, margins[1][:3], rtol=1e-4)
    assert same(fresh["tuned"]["disk margin"], min(margins[0][:3]))
    assert same(own["tuned"]["disk margin"], margins[0][3])
    metric = data["fresh_residual_rms"].data[0], data["baseline_residual_rms"].data
    assert f"on the worst of them disk_margin {min(margins[0][:3]):.4g}" in said
    assert metric[0].mean() < metric[1].mean()
    cli.main(["tune", str(file), "--audit"])


def test_a_report_says_what_its_numbers_are():
    """Of made-up results: units, peaks, what has not settled, what must be warned of."""
    spec = parse_tuning(
        {
            **SMALL,
            "control": {**SMALL["control"], "links": [True, False, True]},
            "tune": {"free": GAIN, "starts": 1, "iterations": 40, "limits": {"peak_voltage": 30.0}},
        }
    )
    at = begin(spec, SimpleNamespace(linear=None))
    at = at._replace(
        iteration=np.array(14),
        best_objective=np.array([0.5]),
        best_limits=np.array([[0.1]]),
        best_place=np.array([[0.7]]),
        best_peaks=np.array([[33.0]]),
    )

    def judged(share, margin, settling):
        metrics = {"residual_rms": share * 8e-6, "peak_voltage": 33.0, "settling_time": settling}
        return JudgedDesign(
            np.array([share, share + 0.1]),
            {name: np.array([value, 1.1 * value]) for name, value in metrics.items()},
            np.zeros(2, int),
            np.full(2, 0.03),
            DesignFigures(margin, 70.0, 1.0, 0.5),
            OwnRun(share, metrics, 0, 0.03),
        )

    audited = [Disagreement("control.gain_factor", "tuned", 0, "objective", 1.0, 1.0, 0.0)]
    nothing = np.full(1, np.nan)
    found = TuneFindings(
        spec,
        at,
        judged(1.0, 3.0, 0.02995),
        [judged(0.5, 1.3, 0.012)],
        audited,
        nothing,
        nothing,
        None,
        0.1,
        14,
    )
    text = text_of(page(say(found)))
    head = text.split("## ")[0]
    for words in (
        "the least residual_rms of links 1 and 3 with peak_voltage at most 30",
        "Ended after 14 of 40 iterations: for 12 no family had gained 0.1 %.",
        "residual_rms -50 % (4 instead of 8 µm), settling_time 12 instead of not within 30 ms, "
        "peak_voltage +0 % (33 instead of 33 V), slowest_decay +0 % (70 instead of 70 1/s), "
        "spillover +0 % (1 instead of 1), "
        "but gain_margin 1.3 (2.3 dB) instead of 3 (9.5 dB) on the nominal machine",
        "**CAUTION: a gain margin of 1.3; below 2 a machine may go unstable.**",
        "**a limit is violated**",
        "`studies simulate tuned.toml",
    ):
        assert words in head, words
    own = table_of(text, "On the nominal machine")
    assert own["tuned"]["peak_voltage [V]"] == "33" and own["tuned"]["residual_rms [µm]"] == "4"
    fresh = table_of(text, "On fresh machines")
    assert fresh["baseline"]["settling_time [ms]"] == "not within 30"
    assert fresh["tuned"]["residual_rms [µm]"] == "4.4"
    assert "Of links 1 and 3, the controlled ones, the largest value counts" in text


def loud_and_calm():
    """A tuning whose better family exceeds its limit; results of it that no run has given."""
    spec = tuning(GAIN, starts=1, limits={"peak_voltage": 30.0}, families={"loud": {}, "calm": {}})
    at = begin(spec, SimpleNamespace(linear=None))
    at = at._replace(
        best_limits=np.array([[0.1], [0.0]]),
        best_place=np.array([[0.9], [0.2]]),
        best_objective=np.array([0.5, 0.8]),
    )
    judged = [SimpleNamespace(objective=np.array([share])) for share in (0.5, 0.8)]
    return spec, SimpleNamespace(spec=spec, at=at, judged=judged)


def test_a_family_that_keeps_the_limits_comes_before_a_better_one():
    assert best_family(*loud_and_calm()) == 1


def test_the_machine_shown_is_the_recommended_one():
    spec, found = loud_and_calm()
    made_up = {"tuned_study": lambda *x: spec.study.change(control__gain_factor=x[2][0])}
    with mock.patch.multiple(say_module, **made_up):
        study = say_module._best_study(found)
    loud, calm = spec.free.values(found.at.best_place)[:, 0]
    assert study.control.gain_factor == calm != loud
    with mock.patch.multiple(tuning_run, **made_up):
        written = tuning_run.tuned_studies(spec, found.at)["tuned_calm.toml"]
    assert written == study.change(title=written.title) and "calm" in written.title


def test_each_family_has_one_best_start():
    spec, found = loud_and_calm()
    at = found.at._replace(
        family=np.array([0, 0, 1, 1]),
        best_place=np.full((4, 1), 0.5),
        best_objective=np.array([0.9, 0.5, 0.8, 0.7]),
        best_limits=np.zeros((4, 1)),
    )
    with mock.patch.object(results, "patch_centers", lambda *_: 0.0):  # compiles
        starts = Variables()
        results._put_starts(starts, spec, SimpleNamespace(at=at, linear=np.full(4, np.nan)))
    assert starts["is_best"].data.tolist() == [False, True, False, True]


def test_the_rank_correlation_is_spearmans():
    a, b = np.random.default_rng(0).random((2, 20))
    assert rank_correlation(a, b) == pytest.approx(spearmanr(a, b).statistic)
    assert rank_correlation(a, -np.exp(a)) == pytest.approx(-1)


@pytest.mark.long
def test_a_tuning_from_its_file_to_its_report(tmp_path, capsys):
    file, out = tmp_path / "t.toml", tmp_path / "out"
    file.write_text(FILE)
    cli.main(["tune", str(file), "--out", str(out)])
    text = text_of((out / "report.html").read_text(encoding="utf-8"))
    for part in (
        "Which design has the least residual_rms of all links with peak_voltage at most",
        "| gains |",
        "| loud |",
        "| all, peak_voltage 20 |",
        "worst disagreement is",
        "Sobol designs of all",
        "Linear fidelity",
        "**Next steps:** `studies simulate",
    ):
        assert part in text
    shown = parsed((out / "report.html").read_text())
    for name in ("descent", "gains", "front"):
        assert (out / f"{name}.png").stat().st_size > 10_000 and f"![{name}]" in text
    assert len(shown.images) == 4  # the sketch of the machine, then these
    assert shown.images[0][1].startswith("The machine at its first way-point")
    assert "[tune.free]" in shown.text
    tuned = load_study(out / "tuned_gains.toml")
    assert tuned.control.gain_factor != paper_study().control.gain_factor
    check_report(out)
    check_explorer(out)
    before, _ = read_store(out / "tune.h5")
    cli.main(["tune", str(file), "--out", str(out), "--resume", "--no-progress"])
    after, _ = read_store(out / "tune.h5")
    assert set(before) == set(after)
    for name, variable in before.items():
        np.testing.assert_array_equal(variable.data, after[name].data, err_msg=name)
    cli.main(["tune", str(file), "--audit"])  # exits with 1 where derivatives are wrong
    assert "below 0.0001" in capsys.readouterr().out
    file.write_text(FILE.replace("iterations = 3", "iterations = 4"))
    cli.main(["tune", str(file), "--out", str(out), "--resume", "--no-progress"])
    assert read_store(out / "tune.h5")[0]["trial_objective"].data.shape == (4, 8)
    file.write_text(FILE.replace("starts = 2", "starts = 3"))
    for more, message in (
        ([], "holds a tuning already"),
        (["--resume"], "another tuning file"),
        (["--audit"], "--audit: writes no files"),
    ):
        with pytest.raises(SystemExit, match="2"):
            cli.main(["tune", str(file), "--out", str(out), *more])
        assert message in capsys.readouterr().err


@pytest.mark.long
def test_placement_by_gradient_is_as_good_as_the_sweep(tmp_path):
    """The ready sweep of 4,096 placements and gains, and `tune_placement`, as they are run."""
    specs = Path(spec_module.__file__).parents[1] / "specs"
    spec = load_tuning(specs / "tune_placement.toml")
    asked = read_toml(specs / "placement.toml")
    for section in ("run", "link", "motion", "shaper", "drive", "metrics"):
        assert spec.data.get(section) == asked.get(section)
    swept = run_sweep(parse_sweep(asked), tmp_path / "sweep")
    data = read_sweep(tmp_path / "sweep")
    best = ranked_cases(data, "residual_rms", "gain_margin >= 2", 15)
    residual = np.max(data["residual_rms"], axis=(1, 2))
    # it is the links' own vibration that ranks them: what no run decides ranks alike
    safe = (data["status"] == 0) & (data["gain_margin"] >= 2)
    safe &= np.isfinite(data["damping_ratio"][:, 0])
    damping = data["damping_ratio"][safe, 0]
    assert spearmanr(residual[safe], damping).statistic < -0.98
    assert damping.max() > 3 * damping.min()
    # the question discriminates: among the best 15 of 4,096, and against the middle of what is safe
    assert residual[best].max() > 1.1 * residual[best].min()
    assert np.median(residual[safe]) > 2 * residual[best].min()
    found = tune(spec, tmp_path / "tune", progress=False)
    tuned = run_study(load_study(tmp_path / "tune" / "tuned.toml"), has_record=False)
    assert tuned.status == 0 and tuned.loop.gain_margin >= 2 * (1 - 1e-3)
    # one of 4,096 may be a little better than where 16 descents end
    left = tuned.result.metrics.residual_rms.max()
    assert left <= 1.03 * residual[best].min()
    differentiated = int(found.at.iteration) * (1 + spec.tune.starts)
    # what each costs is measured where compilers do their best: docs/reference/tuning.md
    assert swept.n_run == 4096 and differentiated <= 4096 // 10


# --- the folder -----------------------------------------------------------------------------------


def opened(out, is_resumed, **other):
    request = {"spec": {"tune": {"iterations": 3}}, "code": "a", "jaxlib": "1", "precision": "x"}
    with working("tune", out, request | other, (), is_resumed, False, CHECKED, fixed_part):
        return load_progress(out / PROGRESS)


def test_a_folder_of_other_things_is_left_alone(tmp_path):
    (tmp_path / "report.html").write_text("precious")
    with pytest.raises(StudyError, match="holds other files .report.html.; name a new or empty"):
        opened(tmp_path, False)
    assert [file.name for file in tmp_path.iterdir() if file.name[0] != "."] == ["report.html"]


def test_a_folder_belongs_to_its_tuning(tmp_path):
    assert opened(tmp_path, False) is None
    (tmp_path / ".tune.h5.0123abcd.tmp").write_text("left by a kill")
    assert opened(tmp_path, True) is None and not list(tmp_path.glob("*.tmp"))
    longer = {"tune": {"iterations": 9}}
    assert opened(tmp_path, True, spec=longer) is None  # more of the same
    with pytest.raises(StudyError, match="holds a tuning already"):
        opened(tmp_path, False)
    for other, word in (
        ({"spec": {"tune": {"seed": 1}}}, "tuning file"),
        ({"code": "b"}, "program"),
        ({"jaxlib": "2"}, "jaxlib"),
        ({"precision": "y"}, "precision"),
        ({"spec": {"tune": {"iterations": 9, "method": "adam"}}}, "tuning file"),
    ):
        with pytest.raises(StudyError, match=f"begun with another {word}"):
            opened(tmp_path, True, **other)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("tune.json", b"[" * 100_000),
        ("tune.json", b"\xff"),
        ("tune.json", b"[]"),
        ("progress.npz", b""),
        ("progress.npz", b"PK"),
        ("progress.npz", "array"),
    ],
)
def test_damaged_files_are_named(tmp_path, name, content):
    opened(tmp_path, False)
    if content == "array":
        with open(tmp_path / name, "wb") as file:
            np.save(file, np.zeros(3))
    else:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(StudyError, match=f"{name}: damaged|begun with another"):
        opened(tmp_path, True)


def test_a_tuning_that_fails_at_once_leaves_the_folder_free(tmp_path):
    refused = pytest.raises(StudyError, match="nothing depends")
    with refused, working("tune", tmp_path, {}, (), progress=False):
        raise StudyError("nothing depends on it")
    assert opened(tmp_path, False) is None


def test_progress_of_other_shapes_is_damaged():
    spec = tuning(GAIN, starts=2, iterations=3)
    linear = SimpleNamespace(screen=lambda k, values: np.zeros((2, len(values))))
    at = begin(spec, SimpleNamespace(linear=linear))
    assert is_compatible(spec, at) and is_compatible(spec._replace(tune=spec.tune.model_copy()), at)
    assert not is_compatible(spec, at._replace(best_place=at.best_place[:1]))
    assert not is_compatible(tuning(GAIN, starts=3, iterations=3), at)


def test_starting_points_that_never_keep_the_limits_are_counted():
    violation = np.array([[0.5, 0.5, np.nan], [0.0, 0.1, np.nan], [0.3, 0.2, np.nan], [9, 0, 0]])
    history = np.stack([np.ones_like(violation), violation], axis=-1)
    at = SimpleNamespace(history=history, iteration=np.array(3))
    assert n_outside(at) == 2  # the last row is of an earlier, longer request


def test_own_limits_need_something_to_be_a_share_of():
    silent = {**SMALL, "control": {**SMALL["control"], "velocity_gain": [0.0, 0.0, 0.0]}}
    spec = parse_tuning(
        {
            **silent,
            "tune": {
                "free": {"drive.kp": {"from": 1e4, "to": 4e4}},
                "limits": {"peak_voltage": "baseline"},
            },
        }
    )
    checked = SimpleNamespace(spec=spec, families=list(spec.families), goal=objective_of(spec))
    metrics = SimpleNamespace(residual_rms=np.ones((1, 3, 3)), peak_voltage=np.zeros((1, 3)))
    with pytest.raises(StudyError, match="peak_voltage = 'baseline': the baseline has 0"):
        Evaluator._check_baseline(checked, np.array([0]), metrics)


def test_neighbours_of_a_corner_do_not_fail_an_audit(monkeypatch):
    """|x - a| has a derivative wherever x is not a, however near that is; a wrong one is found."""
    spec = tuning(GAIN, starts=1)
    own = float(spec.free.places()[0])

    def designs(spec, evaluator, places, sign=1.0):
        x, zero = places[:, 0], np.zeros((len(places), 0))
        slope = sign * np.sign(x - own - 2e-5)[:, None] / spec.free.slopes(places)
        return Evaluation(
            np.abs(x - own - 2e-5), slope, zero, np.zeros((len(x), 0, 1)), zero, zero, x
        )

    for sign, is_fine in ((1.0, True), (0.9, False), (-1.0, False)):
        monkeypatch.setattr(audit_module, "_evaluate", partial(designs, sign=sign))
        monkeypatch.setattr(audit_module, "Evaluator", lambda spec, families: None)
        (one,) = audit_module.audit(spec, np.array([[own]]))
        assert (one.share < audit_module.ALLOWED) == is_fine
