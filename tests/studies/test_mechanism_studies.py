"""Commands on machines of other sizes: a five-bar, and a mechanism from a user's file."""

import json
import os
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import studies
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.numbers import case_of
from jaxmodel.simulate import simulate
from studies import sources
from studies.atlas import drawing
from studies.cli import main
from studies.engine.preflight import check_run
from studies.extensions import VARIABLE, extend
from studies.space.spec import parse_sweep
from studies.study.cases import build_structure
from studies.study.numbers import one_study
from studies.study.spec import Study
from studies.sweeps.run import make_plan
from studies.verify.machine import check_machine
from tests import TOP
from tests.bare import parse_study

GANTRY = TOP / "tests" / "gantry.py"
SHORT = """
[run]
duration = 0.16
[link]
modes = 2
[control]
modes = 2
[machine]
kind = "{kind}"
[motion]
waypoints = [[0.0, {y}], [0.0, {end}]]
[metrics]
residual_length = 0.04
"""
PLACES = {"five_bar": (0.25, 0.26), "gantry": (0.14, 0.15)}
#: The five-bar's physics and control are checked in tests/jaxmodel, its commands in campaigns.
KINDS = ["gantry", pytest.param("five_bar", marks=pytest.mark.long)]


@pytest.fixture(scope="module")
def gantry():
    before = dict(MECHANISMS._entries)
    extend(GANTRY)
    yield "gantry"
    MECHANISMS._entries = before
    sources.OUTSIDE.remove(GANTRY)
    os.environ.pop(VARIABLE, None)
    jax.clear_caches()


@pytest.fixture(params=KINDS)
def kind(request, gantry):
    return request.param


def written(tmp_path, kind, more=""):
    y, end = PLACES[kind]
    path = tmp_path / "study.toml"
    path.write_text(SHORT.format(kind=kind, y=y, end=end) + more)
    return str(path)


def swept(tmp_path, kind):
    more = f"""
[sweep.axes]
gain = {{ from = 0.5, to = 1.0, count = 2 }}
link_subsets = "all"
"machine.kinds.{kind}.{"crank_length" if kind == "five_bar" else "rail_height"}" = {
        [0.15, 0.16] if kind == "five_bar" else [0.0, 0.01]
    }
"""
    main(["sweep", written(tmp_path, kind, more), "--out", str(tmp_path / "sweep")])
    return tmp_path / "sweep"


def test_a_sweep_judges_and_damps(kind, tmp_path):
    data = studies.load(swept(tmp_path, kind)).data
    rms, margin = (np.asarray(data[x]) for x in ("residual_rms", "gain_margin"))
    assert rms.shape == (2, 4, 2, 2, 3) and np.all(np.asarray(data["status"]) == 0)
    assert np.isfinite(margin).all() and margin.min() > 1.5
    assert list(np.asarray(data["link_subsets"])) == ["none", "1", "2", "1+2"]
    assert rms[:, 3].max() < rms[:, 0].max() / 3


@pytest.mark.long  # sizes of tables and figures; in short: drawings of its links, below
def test_a_case_is_drawn_and_run_again_with_its_report(kind, tmp_path, capsys):
    folder = str(swept(tmp_path, kind))
    main(["explore", folder])
    assert (tmp_path / "sweep" / "explorer.html").stat().st_size > 1e4
    out = str(tmp_path / "run.h5")
    main(["simulate", folder, "--case", "13", "--out", out, "--report"])
    assert (tmp_path / "run.html").stat().st_size > 1e4
    said = capsys.readouterr().out.partition("largest relative difference of a metric: ")[2]
    assert float(said.split()[0]) < 1e-6


def test_an_exported_controller_equals_the_loop(kind, tmp_path, capsys):
    main(["export", written(tmp_path, kind), "--target", "c", "--out", str(tmp_path / "c")])
    assert "comparisons agree" in capsys.readouterr().out
    header = (tmp_path / "c" / "flexlink.h").read_text()
    assert "_N_LINKS 2" in header and "_N_POSE 2" in header
    assert MECHANISMS[kind].text in header


@pytest.mark.long  # in short: the gradient by length and gain of a five-bar
def test_a_tuning_finds_less_vibration(tmp_path, capsys):
    more = """
[tune]
starts = 1
iterations = 4
[tune.free]
"control.velocity_gain" = { from = 0.5, to = 20.0, scale = "log" }
[tune.objective]
residual_rms = 1.0
"""
    main(["tune", written(tmp_path, "five_bar", more), "--out", str(tmp_path / "tune")])
    before = Study().change(machine__kind="five_bar").control.velocity_gain
    tuned = studies.load(tmp_path / "tune" / "tuned.toml")
    assert len(tuned.control.velocity_gain) == 2 and tuned.control.velocity_gain != before


@pytest.mark.long
def test_a_five_bar_is_certified(tmp_path, capsys):
    main(["certify", written(tmp_path, "five_bar"), "--out", str(tmp_path / "certificate")])
    assert (tmp_path / "certificate" / "report.html").stat().st_size > 1e4


@pytest.mark.parametrize(
    ("basis", "count"),
    [("pinned_free", 3), pytest.param("pinned_pinned", 4, marks=pytest.mark.long)],
)
def test_a_mechanism_of_ones_own_has_the_accelerations_of_its_lagrangian(gantry, basis, count):
    """With nothing but its file: what it declares suffices for the independent reference, too."""
    rows = check_machine(Study().change(machine__kind=gantry, link__basis=basis, link__modes=2))
    assert len(rows) == count and all(row.is_passed for row in rows if not row.left_out)


def test_a_pose_has_as_many_numbers_as_the_platform(capsys):
    lowest = []
    for pose in ("0,0.25", "0.02,0.24"):
        main(["modes", "five_bar", "--pose", pose, "--json"])
        lowest.append(json.loads(capsys.readouterr().out)["modes"][0]["frequency"])
    assert lowest[0] != pytest.approx(lowest[1], rel=1e-3)
    with pytest.raises(SystemExit):
        main(["modes", "five_bar", "--pose", "0,0.25,0"])
    assert "allowed: 2 finite numbers" in capsys.readouterr().err


def test_modes_of_two_links_are_named(gantry):
    study = parse_study(tomllib.loads(SHORT.format(kind=gantry, y=0.14, end=0.15)))
    modes = studies.modes(study)
    assert modes.link_share.shape[1:] == (2, 2)
    assert np.all(np.isfinite(modes.frequency)) and len(modes.frequency) == 6
    bending = modes.shape[:, 2].real
    parts = drawing.mode_skeleton(study, np.array(study.motion.waypoints[0]), bending)
    assert parts.near.shape == (3, 2, 2)
    # drawn as far to either side as the larger of both bends
    moved = np.abs(parts.link[1:] - parts.link[0]).max()
    assert 0.05 < moved / study.link.length < 0.2
    # and where mode 1 is positive, to the left of the way from B to C
    chord, middle = parts.joint[1] - parts.near[1], parts.link[1, :, parts.link.shape[2] // 2]
    away = middle - (parts.joint[1] + parts.near[1]) / 2
    left = chord[:, 0] * away[:, 1] - chord[:, 1] * away[:, 0]
    np.testing.assert_array_equal(np.sign(left), np.sign(bending[2:].reshape(2, -1)[:, 0]))


def test_defaults_follow_the_mechanism_and_what_was_given_stays():
    bar = Study().change(machine__kind="five_bar", drive__kp=3e4)
    assert bar.control.links == (True, True) and bar.motion.waypoints[0] == (0.0, 0.25)
    assert bar.drive.kp == 3e4
    back = bar.change(machine__kind="prrr")
    assert back == Study().change(drive__kp=3e4)
    assert parse_study(json.loads(bar.model_dump_json())) == bar


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"control": {"links": [True] * 3}}, "control.links = .*allowed: 2 values true or false"),
        ({"motion": {"waypoints": [[0.0, 0.25, 0.0]]}}, "waypoints.0 = .*allowed: 2 finite"),
        ({"link": {"length": [0.2, 0.2, 0.2]}}, "link.length.*or a list of 2"),
        ({"load": {"inertia": 1e-3}}, "load.inertia = 0.001; allowed: 0: the platform is a point"),
        (
            {"machine": {"kind": "five_bar", "kinds": {"five_bar": {"crank_length": [0.2] * 3}}}},
            r"five_bar.crank_length = \[0.2.*allowed: a finite number, or a list of 2",
        ),
        ({"motion": {"waypoints": [[0.0, 0.6]]}}, "0.6.*reach each joint.*0.608.*pivot"),
    ],
)
def test_bad_five_bars_are_refused(given, message):
    with pytest.raises(studies.StudyError, match=message):
        study = parse_study({"machine": {"kind": "five_bar"}} | given)
        check_run(study)


def test_a_sweep_over_machines_of_other_sizes_is_refused(tmp_path, capsys):
    path = tmp_path / "kinds.toml"
    path.write_text('[sweep.axes]\n"machine.kind" = ["prrr", "five_bar"]\n')
    with pytest.raises(SystemExit) as error:
        main(["sweep", str(path), "--out", str(tmp_path / "sweep")])
    assert error.value.code == 2
    assert "'five_bar'; allowed: machines of as many links: prrr, rrr" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["five_bar", pytest.param("rrr", marks=pytest.mark.long)])
def test_gradients_by_crank_and_gain_are_those_of_differences(kind):
    """Exact derivatives of a whole controlled move, through closure and dynamics of the cranks."""
    home = MECHANISMS[kind].home
    study = Study().change(
        machine__kind=kind,
        motion__waypoints=(home, (home[0], home[1] + 0.01, *home[2:])),
        run__duration=0.08,
        run__smooth=True,
        metrics__residual_length=0.02,
        metrics__residual_delay=0.02,
        link__modes=2,
        control__modes=1,
    )
    structure = build_structure(study)
    numbers = one_study(study, structure)
    structure = structure._replace(metrics=("residual_rms", "pose_error_rms"))
    names = (f"machine.kinds.{kind}.crank_length", "control.velocity_gain", "link.thickness")

    def figure(factor):
        own = {name: numbers[name] * factor[k] for k, name in enumerate(names)}
        metrics = simulate(structure, case_of(structure, numbers | own)).metrics
        return 1e6 * jnp.sum(metrics.residual_rms) + 1e6 * jnp.sum(metrics.pose_error_rms[:2])

    at, step = np.ones(len(names)), 1e-4
    both = jax.jit(lambda x, way: jax.jvp(figure, (x,), (way,)))
    for unit in np.eye(len(names)):
        found = [both(at + place * step * unit, unit) for place in (-2, -1, 0, 1, 2)]
        a, b, _, c, d = (float(value) for value, _ in found)
        slope = float(found[2][1])
        assert slope == pytest.approx((a - 8 * b + 8 * c - d) / (12 * step), rel=1e-6)
        assert abs(slope) > 1e-6


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"machine.kinds.rrr.crank_length": [0.15, 12.0]}, "crank_length = 12.0; allowed: 0.001"),
        (
            {"machine.kind": ["rrr", "prrr"]},
            "'prrr' has its home elsewhere; write motion.waypoints",
        ),
    ],
)
def test_axes_that_no_machine_can_have_are_refused(axes, message):
    with pytest.raises(studies.StudyError, match=message):
        spec = parse_sweep({"machine": {"kind": "rrr"}, "sweep": {"axes": axes}})
        make_plan(spec)
