"""Free numbers of a tuning, its objective and limits, and their derivatives."""

import jax
import numpy as np
import pytest

from jaxmodel.sampled_loop import loop_report
from studies import cli
from studies.cases import as_arrays, build_case, build_structure
from studies.errors import StudyError
from studies.runs import run_study
from studies.spec import load_study, paper_study, parse_study
from studies.sweeps.axes import set_value
from studies.tuning.evaluate import Evaluator, scenario_columns, with_margin_modes
from studies.tuning.optimise import advance, optimise
from studies.tuning.run import load_progress, save_progress
from studies.tuning.spec import parse_tuning

HOME = list(paper_study().motion.waypoints[0])
SMALL = {
    "run": {"duration": 0.06},
    "link": {"modes": 2},
    "control": {"modes": 2, "ratios": [[1.0, 0.3]] * 3},
    "motion": {"waypoints": [HOME, [0.0, 0.01, HOME[2]]], "move_time": 0.03},
    "shaper": {"kind": "none"},
    "metrics": {"residual_delay": 0.002, "residual_length": 0.02},
}


def tuning(free, **tune):
    """A tuning of a small machine."""
    return parse_tuning({**SMALL, "tune": {"free": free, **tune}})


GAIN = {"control.gain_factor": {"from": 0.05, "to": 2.0, "scale": "log"}}
EVERY_KIND = {
    **GAIN,
    "control.velocity_gain": {"from": 1.0, "to": 100.0, "scale": "log"},
    "control.ratios[1]": {"from": 0.0, "to": 2.0},
    "electronics.lowpass_ratio[0]": {"from": 1.0, "to": 5.0},
    "electronics.highpass_hz": {"from": 20.0, "to": 100.0},
    "shaper.tolerance": {"from": 0.01, "to": 0.2},
    "drive.kp": {"from": 1e4, "to": 4e4},
    "patches.centers[1]": {"from": 0.08, "to": 0.12},
    "machine.platform_mass": {"from": 0.1, "to": 0.4},
}


# --- free numbers ---------------------------------------------------------------------------------


def test_free_numbers_get_to_where_the_study_would_put_them():
    """Placed into a case they give what a study file with these values gives."""
    spec = tuning(EVERY_KIND)
    values = spec.free.values(np.random.default_rng(0).uniform(0.2, 0.8, len(spec.free.names)))
    study = spec.study
    for name, value in zip(spec.free.names, values, strict=True):
        study = parse_study(set_value(study, name, float(value)))
    placed = spec.free.place(as_arrays(build_case(spec.study)), values)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13),
        placed, as_arrays(build_case(study)),
    )  # fmt: skip
    assert len(values) == 1 + 3 + 2 + 6


def test_the_start_is_the_study_itself():
    spec = tuning(EVERY_KIND)
    values = dict(zip(spec.free.names, spec.free.values(spec.free.places()), strict=True))
    assert values["control.gain_factor"] == pytest.approx(spec.study.control.gain_factor)
    assert values["control.ratios[1][1]"] == pytest.approx(0.3)
    assert values["drive.kp"] == pytest.approx(2e4)


def test_slopes_are_those_of_the_values():
    spec = tuning(EVERY_KIND)
    u, step = np.random.default_rng(1).uniform(0.2, 0.8, len(spec.free.names)), 1e-6
    change = (spec.free.values(u + step) - spec.free.values(u - step)) / (2 * step)
    np.testing.assert_allclose(spec.free.slopes(u), change, rtol=1e-6)


@pytest.mark.parametrize("kind", ["same", "per_link"])
def test_patches_stay_on_the_link_and_apart(kind):
    spec = tuning({"placement": {"kind": kind}})
    case = as_arrays(build_case(spec.study))
    start = spec.free.place(case, spec.free.values(spec.free.places())).machine.patches.center
    np.testing.assert_allclose(start, case.machine.patches.center, atol=1e-12)
    pitch, length = 0.03, 0.2
    random = np.random.default_rng(0)
    corners = (np.zeros(len(spec.free.names)), np.ones(len(spec.free.names)))
    for u in [*corners, *random.uniform(size=(50, len(spec.free.names)))]:
        center = np.asarray(spec.free.place(case, spec.free.values(u)).machine.patches.center)
        assert center.shape == (3, 3)
        assert center.min() >= pitch / 2 - 1e-12 and center.max() <= length - pitch / 2 + 1e-12
        assert np.diff(center, axis=1).min() >= pitch - 1e-12


def test_poles_become_gains():
    """(22)-(23): k_d = 2 alpha, k_p = alpha^2 + beta^2 - omega^2 with omega of the bare link."""
    data = {**SMALL, "control": {**SMALL["control"], "gain_unit": "1/s"}}
    free = {
        "poles.decay": {"from": 5.0, "to": 50.0},
        "poles.frequency_hz": {"from": 80.0, "to": 200.0},
    }
    spec = parse_tuning({**data, "tune": {"free": free}})
    values = np.array([10.0, 20.0, 30.0, 100.0, 110.0, 120.0])
    control = spec.free.place(as_arrays(build_case(spec.study)), values).control
    np.testing.assert_allclose(control.velocity_gain, 2 * values[:3])
    link = spec.study.link
    inertia = link.width * link.thickness**3 / 12
    mass = link.density * link.width * link.thickness
    omega = (np.pi / link.length) ** 2 * np.sqrt(link.youngs_modulus * inertia / mass)
    wanted = values[:3] ** 2 + (2 * np.pi * values[3:]) ** 2 - omega**2
    np.testing.assert_allclose(control.position_gain, wanted, rtol=1e-9)


@pytest.mark.parametrize(
    ("tune", "message"),
    [
        ({}, "tune.free = .*: allowed one free field or more"),
        ({"free": {"control.gainfactor": {}}}, "did you mean 'control.gain_factor'"),
        ({"free": {"run.duration": {"from": 0.1, "to": 1.0}}}, "cannot be free; fields that can"),
        ({"free": {"control.gain_factor": {"from": 0.6, "to": 2.0}}},
         "control.gain_factor = 0.5: allowed 0.6 to 2, the bounds"),
        ({"free": {"control.gain_factor": {"from": -1.0, "to": 2.0}}}, "a finite number >= 0"),
        ({"free": {"control.gain_factor": {"from": 2.0, "to": 1.0}}}, "= 1.0: allowed more than"),
        ({"free": {"poles.decay": {"from": 1.0, "to": 2.0}}}, "needs poles.frequency_hz beside it"),
        ({"free": {**GAIN, "control.velocity_gain": {"from": 1.0, "to": 100.0},
                   "control.velocity_gain[0]": {"from": 1.0, "to": 100.0}}}, "free twice"),
        ({"free": {"placement": {"from": 0, "to": 1}}}, "allowed {kind = 'same'}"),
        ({"free": GAIN, "objective": {"residual": 1.0}}, "did you mean 'residual_rms'"),
        ({"free": GAIN, "objective": {"residual_rms": -1.0}}, "allowed a number > 0"),
        ({"free": GAIN, "objective": {"gain_margin": 1.0}}, "'gain_margin' is no metric"),
        ({"free": GAIN, "limits": {"peak_volt": 1.0}}, "did you mean 'peak_voltage'"),
        ({"free": GAIN, "scenarios": {"spread": {"link.basis": 5.0}}}, "for a number"),
        ({"free": GAIN, "starts_": 3}, "starts_"),
    ],
)  # fmt: skip
def test_faults_are_named(tune, message):
    with pytest.raises(StudyError, match=message):
        parse_tuning({**SMALL, "tune": tune})


# --- objective and limits -------------------------------------------------------------------------

JUDGED = {
    "objective": {"residual_rms": 1e6, "control_energy": 1e-3},
    "limits": {"peak_voltage": 50.0, "gain_margin": 3.0, "slowest_decay": 20.0},
    "scenarios": {"count": 2, "spread": {"link.youngs_modulus": 5.0}},
}


@pytest.fixture(scope="module")
def judged():
    """A tuning with free numbers of several kinds, and its evaluator."""
    free = {
        **GAIN,
        "control.velocity_gain[0]": EVERY_KIND["control.velocity_gain"],
        "drive.kp": EVERY_KIND["drive.kp"],
    }
    spec = tuning({**free, "placement": {"kind": "same"}}, **JUDGED, starts=13, iterations=6)
    return spec, Evaluator(spec, 13)


@pytest.fixture(scope="module")
def evaluated(judged):
    """The evaluation of a design and of its neighbours along each free number."""
    spec, evaluator = judged
    u = np.clip(spec.free.places() + 0.02, 0.1, 0.9)
    step = 1e-4 * np.eye(len(u))
    designs = np.concatenate([[u], u + step, u - step])
    return spec, evaluator.limit_names, u, evaluator.evaluate(spec.free.values(designs))


def test_gradients_are_those_of_central_differences(evaluated):
    spec, names, u, found = evaluated
    p = len(u)
    assert names == ("peak_voltage", "gain_margin", "slowest_decay") and (found.status == 0).all()
    for value, slope in ((found.objective, found.slope[0]), *zip(
        found.limits.T, found.limit_slope[0], strict=True
    )):  # fmt: skip
        central = (value[1 : p + 1] - value[p + 1 :]) / 2e-4
        own = slope * spec.free.slopes(u)
        assert np.abs(own - central).max() < 1e-4 * np.abs(central).max()
        assert np.abs(central).max() > 1e-3


def test_figures_can_be_recomputed_from_runs(evaluated):
    """The objective and the limit from runs of the studies themselves, one by one."""
    spec, _, u, found = evaluated
    values, columns = spec.free.values(u), scenario_columns(spec, 2, 0)
    case = as_arrays(build_case(spec.study))
    centers = spec.free.place(case, values).machine.patches.center[0]
    sizes, peaks = [], []
    for k in range(2):
        study = spec.study.change(
            run__smooth=True, run__seed=int(columns["run.seed"][k]),
            link__youngs_modulus=float(columns["link.youngs_modulus"][k]),
            control__gain_factor=float(values[0]), drive__kp=float(values[2]),
            control__velocity_gain=(float(values[1]), *spec.study.control.velocity_gain[1:]),
            patches__centers=tuple(map(float, centers)),
        )  # fmt: skip
        metrics = run_study(study, has_record=False, has_loop=False).result.metrics
        rms = np.sqrt(np.mean(metrics.residual_rms**2))
        sizes.append(1e6 * rms + 1e-3 * float(metrics.control_energy))
        peaks.append(metrics.peak_voltage.max())
    assert sizes[0] != sizes[1]
    np.testing.assert_allclose(found.objective[0], np.mean(sizes), rtol=1e-8)
    np.testing.assert_allclose(found.limits[0, 0], np.max(peaks) / 50.0 - 1, rtol=1e-6)


def test_margin_is_violated_where_the_loop_says_so(evaluated):
    """gain_margin = 3 holds exactly where the loop's own margin is above it, nearly."""
    spec, _, u, found = evaluated
    study = with_margin_modes(spec.study)
    case = spec.free.place(as_arrays(build_case(study)), spec.free.values(u))
    margin = loop_report(build_structure(study), case, np.array(HOME)).gain_margin
    assert (found.limits[0, 1] > 0) == (margin < 3.0)
    assert abs(margin - 3.0) > 0.01


# --- downhill -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tuned(judged):
    """Where an uninterrupted tuning ends, and every iteration of it."""
    spec, evaluator = judged
    seen = []
    return optimise(spec, evaluator, None, seen.append), seen


def test_tuning_goes_downhill_within_limits(judged, tuned):
    spec, _ = judged
    end, seen = tuned
    assert int(end.iteration) == len(seen) == spec.tune.iterations
    k = end.winner
    assert end.best_limits[k].max() <= 1e-3
    assert end.best_objective[k] < 0.97 * end.history[0, 0, 0]  # the study's own design
    assert np.all((end.best_place >= 0) & (end.best_place <= 1))


def test_resumed_tuning_equals_an_uninterrupted_one(judged, tuned, tmp_path):
    """Bit by bit, through the file that is kept."""
    spec, evaluator = judged
    end, seen = tuned
    save_progress(tmp_path / "progress.npz", seen[2])
    again = optimise(spec, evaluator, load_progress(tmp_path / "progress.npz"), lambda at: None)
    jax.tree.map(np.testing.assert_array_equal, again, end)


def test_a_start_that_fails_spoils_no_other(judged, tuned):
    spec, evaluator = judged
    _, seen = tuned
    at = seen[2]
    broken = at.place.copy()
    broken[4, 0] = np.nan
    wanted, found = (
        advance(spec, evaluator, at),
        advance(spec, evaluator, at._replace(place=broken)),
    )
    others = np.arange(13) != 4
    assert not found.is_frozen.any()
    np.testing.assert_array_equal(found.place[others], wanted.place[others])
    assert found.place[4, 0] == at.best_place[4, 0]  # back to where it was well
    assert np.isfinite(found.place[4]).all()
    assert found.best_objective[4] == at.best_objective[4]
    assert np.isnan(found.history[3, 4]).all()
    no_best = np.where(others, at.best_objective, np.inf)
    lost = advance(spec, evaluator, at._replace(place=broken, best_objective=no_best))
    assert lost.is_frozen[4] and not lost.is_frozen[others].any()
    np.testing.assert_array_equal(lost.place[others], wanted.place[others])


def test_a_number_that_changes_nothing_is_named(judged, monkeypatch):
    spec, evaluator = judged
    found = evaluator.evaluate(spec.free.values(np.repeat(spec.free.places()[None], 13, axis=0)))
    others = np.array(spec.free.names) != "drive.kp"
    found = found._replace(slope=found.slope * others, limit_slope=found.limit_slope * others)
    monkeypatch.setattr(evaluator, "evaluate", lambda values: found)
    with pytest.raises(StudyError, match=r"neither .* depends on drive.kp; leave that out"):
        optimise(spec, evaluator, None, lambda at: None)


FILE = """
run = { duration = 0.06 }
link = { modes = 2 }
control = { modes = 2, ratios = [[1.0, 0.3], [1.0, 0.3], [1.0, 0.3]] }
shaper = { kind = "none" }
metrics = { residual_delay = 0.002, residual_length = 0.02 }

[motion]
waypoints = [[0.0, 0.0, 0.5235987755982988], [0.0, 0.01, 0.5235987755982988]]
move_time = 0.03

[tune]
starts = 2
iterations = 3
free = { "control.gain_factor" = { from = 0.05, to = 2.0, scale = "log" } }
limits = { peak_voltage = 60.0, gain_margin = 2.0 }
scenarios = { count = 2, check = 3, spread = { "link.youngs_modulus" = 5.0 } }
"""


@pytest.mark.long
def test_a_tuning_from_its_file_to_its_report(tmp_path, capsys):
    file, out = tmp_path / "t.toml", tmp_path / "out"
    file.write_text(FILE)
    cli.main(["tune", str(file), "--out", str(out)])
    text = (out / "report.md").read_text()
    assert "| objective, mean |" in text and "worst disagreement is" in text
    tuned = load_study(out / "tuned.toml")
    assert tuned.control.gain_factor != paper_study().control.gain_factor
    before = (out / "tune.h5").read_bytes()
    cli.main(["tune", str(file), "--out", str(out), "--resume", "--quiet"])
    assert (out / "tune.h5").read_bytes() == before
    for more, message in (([], "holds a tuning already"), (["--audit"], "")):
        code = 0
        try:
            cli.main(["tune", str(file), "--out", str(out), *more])
        except SystemExit as end:
            code = end.code
        said = capsys.readouterr()
        assert (code, message in said.err) == ((2, True) if message else (0, True))
    file.write_text(FILE.replace("iterations = 3", "iterations = 4"))
    with pytest.raises(SystemExit, match="2"):
        cli.main(["tune", str(file), "--out", str(out), "--resume"])
    assert "another tuning file" in capsys.readouterr().err
