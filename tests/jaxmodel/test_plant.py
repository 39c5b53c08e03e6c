"""`studies plant`: what a controller designed elsewhere acts on."""

import json

import jax
import numpy as np
import pytest
from scipy.io import loadmat

from jaxmodel.defaults import HOME
from jaxmodel.sampled_response import controller_response
from studies.engine.preflight import check_run, preflight
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.export.in_the_loop import replay
from studies.single.plant import _plant, controller_of, plant_of, write_system
from studies.study.template import study_template
from tests.bare import parse_study
from tests.jaxmodel.kept import without_run
from tests.jaxmodel.test_state_space import PERIOD, SHORT, study_with, thirty  # noqa: F401
from tests.studies.test_cli import refused, run

ELECTRONICS = [
    pytest.param({}, marks=pytest.mark.long),
    {"amplifier_hz": 2_000.0, "sensor_highpass_hz": 5.0},
]


def closed(plant, matrices):
    """Transition matrix of the plant with u = C x + D y around it."""
    a, b, c, d = matrices
    around = plant.b @ d @ plant.c
    return np.block([[plant.a + around, plant.b @ c], [b @ plant.c, a]])


@pytest.mark.parametrize("electronics", ELECTRONICS, ids=["plain", "amplified"])
def test_a_controller_around_it_has_the_poles_of_the_loop(thirty, electronics):  # noqa: F811
    matrices, path, _ = thirty
    study = study_with(path, electronics=electronics)
    report = loop_report(*without_run(study), np.array(HOME), 1)
    # judged with twelve modes a link: so is this plant, once it has them
    plant = plant_of(study.change(link__modes=12))
    poles = np.linalg.eigvals(closed(plant, matrices))
    assert abs(np.abs(poles).max() - report.spectral_radius) < 1e-9
    zeta = np.sort(report.damping_ratio[0])
    rate = np.log(poles[poles.imag > 1e-3]) / PERIOD
    found = -rate.real / np.abs(rate)
    near = np.abs(np.abs(rate)[:, None] / (2 * np.pi) - report.frequency_hz[0]).min(axis=1) < 1e-3
    np.testing.assert_allclose(np.sort(found[near]), zeta, rtol=1e-6)


def test_a_command_is_seen_after_its_delay_and_bends_as_statics_says():
    study = parse_study(SHORT | {"control": {"gain_factor": 0.1}})
    plant = plant_of(study)
    assert plant.inputs[:4] == ("actuator 1.1", "actuator 1.2", "actuator 1.3", "actuator 2.1")
    assert plant.outputs[-1] == "sensor 3.3" and plant.sample_time == pytest.approx(PERIOD)
    x = plant.b[:, 0]
    responses = []
    for _ in range(3):
        responses.append(plant.c @ x)
        x = plant.a @ x
    # a sample of delay, then the hold and the filter
    assert np.abs(responses[0]).max() == 0 and np.abs(responses[1][0]) > 0
    assert np.abs(np.linalg.eigvals(plant.a)).max() < 1 + 1e-9  # on its drive, damped
    still = np.linalg.solve(np.eye(len(plant.a)) - plant.a, plant.b)
    # statics of a pinned link: docs/theory.md, "Static correction"
    np.testing.assert_allclose((plant.c @ still)[np.arange(9), np.arange(9)], 0.050075, rtol=1e-4)


@pytest.mark.parametrize(
    "delay, later, count", [(0.0, 0.0, 0), (0.3, 0.0, 1), (0.7, 0.3, 1), (1.3, 0.0, 2), (3.0, 1, 4)]
)
def test_the_plant_has_the_commands_that_its_delay_needs(delay, later, count):
    """As many a patch as samples begun, each controllable and observable, and nothing changed."""
    study = parse_study(SHORT | {"electronics": {"delay": delay, "unmodelled_delay": later}})
    plant = plant_of(study)
    states = 6 + 2 * 9 + 2 * 9  # pose, three modes of three links, filters of nine sensors
    assert len(plant.a) == states + 9 * count
    order = len(plant.a)
    for tested in (np.hstack([plant.a, plant.b]), np.vstack([plant.a, plant.c]).T):
        rows = tested / np.abs(tested).max(axis=1, keepdims=True)
        assert np.linalg.matrix_rank(rows) == order  # z I - A at z = 0
    structure, case = check_run(study)
    whole = _plant(structure._replace(n_steps=1, substeps=1), case, np.array(HOME))
    a, b, c = map(np.asarray, whole)
    assert len(a) == states + 9 * 4
    reached = [plant.b, b]
    for _ in range(400):  # samples after a pulse
        wanted = c @ reached[1]
        np.testing.assert_allclose(plant.c @ reached[0], wanted, rtol=0, atol=1e-10 * 0.05)
        reached = [plant.a @ reached[0], a @ reached[1]]


@pytest.mark.parametrize("end", ["npz", "mat", "json"])
def test_files_hold_the_same(tmp_path, end):
    study = parse_study(SHORT)
    plant = plant_of(study)
    path = tmp_path / f"plant.{end}"
    write_system(plant, path)
    if end == "npz":
        with np.load(path) as read:
            data = dict(read)
    elif end == "mat":
        data = loadmat(path, simplify_cells=True)
    else:
        data = json.loads(path.read_text())
    for name, wanted in zip("ABC", (plant.a, plant.b, plant.c), strict=True):
        np.testing.assert_array_equal(np.array(data[name]), wanted)
    assert np.array(data["D"]).shape == (9, 9) and not np.any(data["D"])
    assert float(data["dt"]) == plant.sample_time
    assert [str(x) for x in data["inputs"]] == list(plant.inputs)
    assert [str(x) for x in data["outputs"]] == list(plant.outputs)
    assert {p.name for p in tmp_path.iterdir()} == {path.name}


def test_the_command(tmp_path, capsys):
    (tmp_path / "study.toml").write_text(study_template(parse_study(SHORT)))
    code, out, _ = run(capsys, "plant", tmp_path / "study.toml", "--out", tmp_path / "plant.npz")
    # pose, three modes of three links, filters of nine sensors and held commands
    text = f"{6 + 2 * 9 + 2 * 9 + 9} states, 9 actuators to 9 sensors, 100 µs a sample"
    assert code == 0 and text in out
    said = refused(capsys, "plant", "paper", "--out", tmp_path / "plant.csv")
    assert "--out" in said and ".json, .npz, .mat" in said
    said = refused(capsys, "plant", "paper", "--out", tmp_path / "none" / "plant.npz")
    assert "cannot write there" in said and "create it first" in said
    with pytest.raises(StudyError, match="control.feedback = 'none'; allowed: 'sampled'"):
        plant_of(parse_study(SHORT | {"control": {"feedback": "none"}}))


_response = jax.jit(controller_response)


@pytest.mark.parametrize(
    "control",
    [
        {},
        pytest.param({"law": "lqg"}, marks=pytest.mark.long),
        {"feedthrough_factor": 0.7, "notch_hz": [0.0, 800.0, 0.0]},
    ],
)
def test_a_controller_is_the_same_system_in_either_form(control):
    study = parse_study(SHORT | {"control": control})
    system = controller_of(study)
    structure, case = check_run(study)
    controller = preflight(structure, case).controller
    for z in np.exp(2j * np.pi * PERIOD * np.array([20.0, 114.0, 460.0, 3000.0])):
        states = np.linalg.solve(z * np.eye(len(system.a)) - system.a, system.b + 0j)
        wanted = _response(controller, z)
        np.testing.assert_allclose(system.c @ states + system.d, wanted, rtol=1e-9, atol=1e-9)


def test_a_controller_comes_back_from_its_file(tmp_path):
    study = parse_study(SHORT)
    write_system(controller_of(study), tmp_path / "imsc.npz")
    again = study_with(tmp_path / "imsc.npz")
    first, second = (preflight(*check_run(x)).controller for x in (study, again))
    codes = np.random.default_rng(1).integers(1500, 2500, (300, 3, 3)).astype(float)
    wanted = np.asarray(replay(first, codes))
    assert 1 < np.abs(wanted).max() < float(first.voltage_limit)
    np.testing.assert_allclose(replay(second, codes), wanted, atol=1e-9 * np.abs(wanted).max())


def test_a_law_that_switches_is_no_linear_system():
    with pytest.raises(
        StudyError, match="control.law = 'modified_imsc'; allowed: a law whose channels"
    ):
        controller_of(parse_study(SHORT | {"control": {"law": "modified_imsc"}}))
