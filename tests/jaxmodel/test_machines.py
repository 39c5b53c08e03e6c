"""Own machines: three different links, guides, joints, a payload off the centre."""

import tomllib
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from jaxmodel import dynamics, kinematics, status
from jaxmodel.beam import build_basis
from jaxmodel.defaults import HOME
from jaxmodel.mechanisms.prrr.guides import Guides
from jaxmodel.plant import build_plant
from studies import cli
from studies.engine.columns import case_variables
from studies.engine.preflight import check_run
from studies.engine.results import SweepData, meets, metric_values, read_sweep
from studies.engine.runs import run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.reference import lagrangian as reference
from studies.results.labelled import Variable
from studies.show.figures import styled
from studies.show.sketch import link_parts, sketch, standing
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.numbers import build_cases
from studies.study.paths import EACH_LINK, field_value
from studies.study.spec import load_study
from studies.study.template import study_template
from studies.sweeps.dry_run import axis_rows
from studies.sweeps.plots import plot
from studies.tuning import verb
from studies.tuning.spec import parse_tuning
from tests import forms
from tests.bare import parse_study
from tests.machines import random_machine
from tests.sweeps import run_sweep

SEEDS = range(10)
R = 3


@pytest.fixture(scope="module")
def machines():
    """Ten machines, stacked."""
    cases = [as_arrays(build_case(random_machine(seed))) for seed in SEEDS]
    return jax.tree.map(lambda *x: jnp.stack(x), *(case.machine for case in cases))


def states(count):
    """Random states far from rest, and loads."""
    rng = np.random.default_rng(11)
    motion = reference.RigidState(
        pose=np.array(HOME) + [0.012, 0.012, 0.06] * rng.uniform(-1, 1, (count, 3)),
        pose_rate=rng.normal(size=(count, 3)) * [0.3, 0.3, 1.0],
        q=3e-3 * rng.uniform(-1, 1, (count, 3, R)) / np.arange(1, R + 1),
        q_rate=0.5 * rng.normal(size=(count, 3, R)),
    )
    return motion, reference.Loads(
        10 * rng.normal(size=(count, 3)), 3 * rng.normal(size=(count, 3, R))
    )


@partial(jax.jit, static_argnums=0)
@partial(jax.vmap, in_axes=(None, 0))
def build(kind, machine):
    basis = build_basis(kind, machine.beam, machine.patches, R, jnp.array([0.1]))
    return basis, build_plant(machine, basis, False, kind != "pinned_free", True)


@jax.jit
@jax.vmap
def by_lagrangian(machine, basis, motion, loads):
    return reference.by_lagrangian(machine, basis, motion, loads)


@pytest.mark.parametrize(
    ("kind", "shortening"),
    [
        ("pinned_pinned", "lumped"),
        ("pinned_free", "none"),
        ("loaded", "lumped"),
        ("loaded", "distributed"),
    ],
)
def test_ten_machines_accelerate_as_their_lagrangians_say(kind, shortening, machines):
    motion, loads = states(len(SEEDS))
    basis, plant = forms.reduced(*jax.tree.map(np.asarray, build(kind, machines)), shortening)
    _, found = forms.closed_form(forms.lanes_last(plant), motion, loads)
    wanted = by_lagrangian(machines, forms.general(machines, basis), motion, loads)
    forms.check_rows((found.pose, found.modal), wanted)


def test_a_payload_off_the_centre_matters_to_the_lagrangian(machines):
    """So that the comparison above would notice a payload that one of both leaves out."""
    _, plant = build("pinned_pinned", machines)
    at_centre = machines.masses._replace(payload_offset=0 * machines.masses.payload_offset)
    _, other = build("pinned_pinned", machines._replace(masses=at_centre))
    one, other = (
        forms.closed_form(forms.lanes_last(x), *states(len(SEEDS)))[1].pose for x in (plant, other)
    )
    assert np.abs(one - other).max(axis=1).min() > 1e-3 * np.abs(one).max()


SHORT = {
    "run": {"duration": 0.08},
    "link": {"modes": 4},
    "motion": {"waypoints": [HOME, (0.0, 0.01, HOME[2])], "move_time": 0.05},
    "shaper": {"kind": "none"},
    "control": {"gain_factor": 0.2},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.02},
}


def sections(study):
    """A study as the dictionary of its file."""
    return tomllib.loads(study_template(study))


@pytest.mark.long  # in short: cases of entries, below, and sweeps of others, in test_batch
def test_a_sweep_over_machines_is_their_single_runs(tmp_path):
    """All ten in one batch: links, patches, guides, joints, payload as columns."""
    studies = [random_machine(seed, **SHORT) for seed in SEEDS]
    names = [
        *EACH_LINK,
        "machine.guide_angles_deg",
        "machine.joint_angles_deg",
        "load.offset",
        "load.mass",
        "load.inertia",
        "link.damping_ratio",
        "patches.centers",
    ]
    axes = {name: [field_value(study, name) for study in studies] for name in names}
    axes = {name: values for name, values in axes.items() if len(set(values)) > 1}
    assert len(axes) == 20
    spec = parse_sweep(sections(studies[0]) | {"sweep": {"method": "zip", "axes": axes}})
    run_sweep(spec, tmp_path)
    swept = read_sweep(tmp_path)
    assert set(swept["status"]) == {status.OK}
    for case in (0, 7):
        run = run_study(studies[case], has_record=False)
        for name in ("residual_rms", "peak_voltage", "pose_error_rms"):
            wanted = getattr(run.result.metrics, name)
            np.testing.assert_allclose(swept[name][case], wanted, rtol=1e-8, err_msg=name)
        np.testing.assert_allclose(swept["gain_margin"][case], run.loop.gain_margin, rtol=0.02)


def one_thickness():
    """A study that gives one thickness of all links, and a sweep of two of its entries."""
    study = random_machine(0, **SHORT).change(link__thickness=2e-3)
    axes = {"link.thickness[1]": [2.0e-3, 2.2e-3], "link.thickness[0]": [2.0e-3, 2.1e-3]}
    return study, parse_sweep(sections(study) | {"sweep": {"axes": axes}})


def test_entries_of_one_number_for_all_links_are_swept():
    """`link.thickness[1]` of a study that gives one: as a whole it then has no value."""
    study, spec = one_thickness()
    table = build_table(spec)
    cases = build_cases(study, table.fields, build_structure(study))
    thickness = np.broadcast_to(cases.machine.beam.thickness, (4, 3))
    np.testing.assert_array_equal(thickness[3], [2.1e-3, 2.2e-3, 2e-3])
    assert sorted(map(tuple, thickness)) == [
        (2.0e-3, 2.0e-3, 2e-3),
        (2.0e-3, 2.2e-3, 2e-3),
        (2.1e-3, 2.0e-3, 2e-3),
        (2.1e-3, 2.2e-3, 2e-3),
    ]
    ok = Variable(np.zeros(4, np.int8), ("case",), "1", "status")
    data = SweepData(case_variables(table) | {"status": ok}, {}, spec, table)
    for ask in (
        lambda: metric_values(data, "link.thickness"),
        lambda: meets(data, "link.thickness > 0.0021", "--subject-to"),
        lambda: plot(data, "link.thickness", "link.thickness[1]", None),
    ):
        with pytest.raises(StudyError, match=r"differs between links here; name one, such as"):
            ask()
    assert metric_values(data, "link.thickness[1]").tolist() == [2.0e-3] * 2 + [2.2e-3] * 2
    assert metric_values(data, "link.thickness[2]").tolist() == [2.0e-3] * 4
    assert "link.thickness[1]" in data.variables


@pytest.mark.long
def test_a_sweep_of_entries_is_its_single_runs(tmp_path):
    study, spec = one_thickness()
    run_sweep(spec, tmp_path)
    data = read_sweep(tmp_path)
    same = run_study(study.change(link__thickness=(2.1e-3, 2.2e-3, 2e-3)), False, False)
    np.testing.assert_allclose(data["residual_rms"][3], same.result.metrics.residual_rms, rtol=1e-8)


@pytest.mark.parametrize(
    "change", [{"link__joint_inertia_b": (0.0, 0.0, 0.0)}, {"link__joint_inertia_c": 0.0}]
)
def test_joints_without_inertia_need_no_basis_of_their_own(change):
    parse_study({}).change(**change)
    with pytest.raises(StudyError, match="allowed: loaded, where a joint has rotary inertia"):
        parse_study({}).change(link__joint_inertia_b=(0.0, 1e-4, 0.0))


def test_angles_of_joints_may_be_swept_with_the_assemblys_own():
    study = parse_study(SHORT)
    axes = {"machine.joint_angles_deg": [[], [90.0, 210.0, 330.0], [92.0, 210.0, 330.0]]}
    table = build_table(parse_sweep(sections(study) | {"sweep": {"axes": axes}}))
    assert [row[2] for row in axis_rows(table).rows] == ["3"]
    angle = build_cases(study, table.fields, build_structure(study)).machine.geometry.joint_angle
    np.testing.assert_allclose(angle[0], angle[1], atol=1e-12)
    assert angle[2, 0] > angle[1, 0]


def tune(study, folder):
    """A few iterations of gain and placement."""
    free = {
        "control.gain_factor": {"from": 0.02, "to": 1.0, "scale": "log"},
        "placement": {"kind": "per_link"},
    }
    tuning = {
        "free": free,
        "starts": 2,
        "iterations": 3,
        "limits": {"gain_margin": 1.5},
        "scenarios": {"count": 1, "check": 2, "spread": {"link.youngs_modulus": 2.0}},
    }
    verb.tune(parse_tuning(sections(study) | {"tune": tuning}), folder, progress=False)


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_ten_machines_are_tuned_and_exported(seed, tmp_path):
    """In short: the machines of tests.tunings and tests.exports have three different links too."""
    study = random_machine(seed, **SHORT)
    tune(study, tmp_path / "tuned")
    found = tmp_path / "tuned" / "tuned.toml"
    tuned = load_study(found)
    assert tuned.link == study.link and tuned.machine == study.machine
    assert tuned.patches.centers != study.patches.centers
    for target in ("c", "json"):
        cli.main(["export", str(found), "--target", target, "--out", str(tmp_path / target)])
    file = tmp_path / "json" / "flexlink.json"
    cli.main(["import-gains", str(file), "--out", str(tmp_path / "again.toml")])
    assert load_study(tmp_path / "again.toml") == tuned


def test_computed_torque_moves_a_payload_as_wanted(machines):
    """Forces from the inverse dynamics give the rigid machine the acceleration asked for."""
    motion, _ = states(len(SEEDS))
    wanted = np.random.default_rng(5).normal(size=(len(SEEDS), 3)) * [3, 3, 30]

    @jax.jit
    @jax.vmap
    def found(machine, pose, pose_rate, acceleration):
        basis = build_basis("pinned_pinned", machine.beam, machine.patches, R, jnp.array([0.1]))
        plant = build_plant(machine, basis, False, False)
        force = dynamics.inverse_dynamics(plant, pose, pose_rate, acceleration)
        still = jnp.zeros((3, R))
        chain = dynamics.modal_chain(plant, pose, pose_rate, still, still)
        return dynamics.accelerations(
            plant, chain, pose_rate, still, still, force, still, is_coupled=False
        ).pose

    np.testing.assert_allclose(
        found(machines, motion.pose, motion.pose_rate, wanted), wanted, atol=1e-9
    )


def turned_machines():
    """A machine, and the same with guides and path turned by 40 deg."""
    angle, one = 40.0, random_machine(2, **SHORT)
    turn = np.radians(angle)
    alpha = tuple(a + angle for a in one.machine.guide_angles_deg)
    points = [
        (
            np.cos(turn) * x - np.sin(turn) * y,
            np.sin(turn) * x + np.cos(turn) * y,
            phi + turn,
        )
        for x, y, phi in one.motion.waypoints
    ]
    other = one.change(machine__guide_angles_deg=alpha, motion__waypoints=points)
    return one, other


def test_a_turned_machine_is_the_same_machine():
    """Its loop has the same margin, and links keep their frequencies and damping."""
    first, second = (
        loop_report(build_structure(x), as_arrays(build_case(x)), np.array(x.motion.waypoints[0]))
        for x in turned_machines()
    )
    for name in ("gain_margin", "frequency_hz", "damping_ratio"):
        mine, wanted = getattr(second, name), getattr(first, name)
        np.testing.assert_allclose(mine, wanted, rtol=1e-6, err_msg=name)


@pytest.mark.long
def test_a_turned_machine_bends_alike():
    first, second = (run_study(x, False, False).result.metrics for x in turned_machines())
    np.testing.assert_allclose(second.residual_rms, first.residual_rms, rtol=1e-6)


#: Link length that makes all links point at the centre of the platform where its joints do [m].
IN_LINE = (0.6 / np.sqrt(12) + 0.06) / np.sin(np.pi / 3)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"machine__guide_offsets": (0.0, 0.05, 0.0)}, "its joint lies 0.2232 m inside"),
        ({"machine__guide_offsets": (0.0, 0.0, -0.2)}, "its joint lies -0.0"),
        (
            {"machine__joint_angles_deg": (150.0, 270.0, 30.0), "link__length": IN_LINE},
            "do not meet in one point",
        ),
        ({"link__length": (0.2, 0.2, 0.16)}, "so that no patch leaves the link (link 3)"),
        ({"patches__actuator_length": (0.03, 0.06, 0.03)}, "so that no patches overlap (link 2)"),
        ({"patches__width": (0.01, 0.01, 0.02)}, "patches.width = 0.02; allowed: at most"),
        ({"link__length": (0.2, 0.2)}, "allowed: a finite number, or a list of 3, each >= 0.001"),
        ({"machine__joint_angles_deg": (0.0,)}, "allowed: an empty list, or 3 finite numbers"),
    ],
)
def test_a_machine_that_cannot_be_built_is_refused(change, words):
    with pytest.raises(StudyError) as error:
        check_run(parse_study({}).change(**change))
    assert words in str(error.value)


def test_links_in_line_with_one_point_hold_nothing():
    """`hold` is 1 where forces pull at right angles, and 0 where all links point at the centre."""
    plant, hold = build_plant_of(parse_study({})), jax.jit(kinematics.hold)
    chain = close(plant, np.array(HOME))
    assert 0.5 < float(hold(chain)) <= 1
    cx, cy = plant.length * chain.frame.x, plant.length * chain.frame.y
    assert float(hold(chain._replace(cx=cx, cy=cy))) < 1e-12


@jax.jit
def close(plant, pose):
    return kinematics.close_chain(plant, pose, jnp.zeros(3))


def build_plant_of(study):
    """Plant of a study's machine."""
    machine = as_arrays(build_case(study)).machine
    made = build("pinned_pinned", jax.tree.map(lambda x: np.asarray(x)[None], machine))[1]
    plant = jax.tree.map(lambda x: np.asarray(x)[0], made)
    return plant._replace(inward=None, centrifugal=None)


def test_a_sketch_stands_where_the_machine_does():
    study = random_machine(4)
    pose = np.array(study.motion.waypoints[0])
    slider, joint = standing(study, pose)
    plant = build_plant_of(study)
    chain = close(plant, pose)
    guide = plant.legs
    u = np.stack([guide.ux, guide.uy], axis=1)
    n = np.stack([-u[:, 1], u[:, 0]], axis=1)
    corner = -np.asarray(guide.s0)[:, None] * u - np.asarray(guide.h0)[:, None] * n
    np.testing.assert_allclose(slider, corner + np.asarray(chain.rho)[:, None] * u, atol=1e-12)
    centre = joint - pose[:2]
    np.testing.assert_allclose(centre, np.stack([chain.cx, chain.cy], axis=1), atol=1e-12)
    with styled():
        assert len(sketch(study).axes) == 2


def test_a_sketch_draws_each_link_and_patch_to_scale():
    """Faces in their own length and width, edges in their own thickness times one factor."""
    study = parse_study(
        {
            "link": {"length": [0.2, 0.26, 0.18], "width": [0.01, 0.02, 0.012], "thickness": 3e-3},
            "patches": {"sensor_length": [0.01, 0.03, 0.02], "thickness": [2e-4, 5e-4, 3e-4]},
        }
    )
    with styled():
        links = sketch(study).axes[1]
    drawn = [(x.get_x(), x.get_width(), x.get_height()) for x in links.patches]
    patches = study.patches
    wanted = [
        (0.0, length, width, thickness)
        for length, width, thickness in zip(
            study.link.length, study.link.width, (3e-3,) * 3, strict=True
        )
    ]
    for size in (patches.actuator_length, patches.sensor_length):
        for i, thickness in enumerate(patches.thickness):
            length = np.broadcast_to(size, (3,))[i]
            wanted += [(c - length / 2, length, patches.width, thickness) for c in patches.centers]
    pairs = [
        (1e3 * start, 1e3 * length, 1e3 * height)
        for start, length, width, thickness in wanted
        for height in (width, 5 * thickness)
    ]
    np.testing.assert_allclose(sorted(drawn), sorted(pairs), rtol=1e-9, atol=1e-9)


def test_parts_of_a_sketch_have_the_colours_of_its_caption():
    study = parse_study({"patches": {"actuator_length": 0.04, "sensor_length": 0.02}})
    channels = {part.length: "rgb"[np.argmax(to_rgb(part.color))] for part in link_parts(study, 0)}
    # blue: a link under control, orange: actuators, green: sensors
    assert channels == {study.link.length: "b", 0.04: "r", 0.02: "g"}


def test_links_across_their_guides_are_misplaced():
    """A joint must lie between 0 and the link's length inside its guide, with some margin."""
    guides = Guides(ux=np.ones(4), uy=np.zeros(4), s0=np.zeros(4), h0=np.zeros(4))
    found = guides.misplaced(np.zeros(4), np.array([0.0, 0.1, 0.2, 0.25]), np.full(4, 0.2))
    assert [text[:6] for text in found] == ["link 1", "link 3", "link 4"]
