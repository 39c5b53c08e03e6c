"""Mechanisms against the multiplier form, and the closure of their chains."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import kinematics, status
from jaxmodel.axial import stretch_error
from jaxmodel.case import uncontrolled
from jaxmodel.defaults import paper_machine
from jaxmodel.linear import linearise
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.check import check_mechanism
from jaxmodel.mechanisms.five_bar.cranks import FiveBarGeometry
from jaxmodel.mechanisms.rrr.cranks import CrankGeometry
from jaxmodel.prepare import prepare
from jaxmodel.sampled_response import assembled, plant_response
from jaxmodel.table import PartError
from studies.engine.runs import _simulate, run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.reference import lagrangian as reference
from studies.space.spec import parse_sweep
from studies.study.cases import build_case, build_structure
from studies.study.window import rigid_machine
from tests.bare import paper_study, parse_study
from tests.forms import (
    R,
    by_lagrangian,
    check_multipliers,
    check_rows,
    closed_form,
    lanes_last,
    make,
    one_lane,
)
from tests.studies.kernels.test_kernel import both, check_equal

N_STATES = 100
#: A 3-RRR: pivots on a circle, links as the paper's.
CRANKS = CrankGeometry(
    pivot_radius=0.30,
    pivot_angle=np.radians([210.0, 330.0, 90.0]),
    crank_length=0.16,
    elbow=1.0,
    zero_angle=np.radians([60.0, 180.0, 300.0]),
    joint_radius=0.07,
    joint_angle=np.radians([210.0, 330.0, 90.0]),
)
UNEQUAL = CRANKS._replace(
    pivot_radius=np.array([0.30, 0.31, 0.29]),
    crank_length=np.array([0.16, 0.15, 0.17]),
    elbow=np.array([1.0, -1.0, 1.0]),
    joint_radius=np.array([0.07, 0.06, 0.08]),
)


PAPER = paper_machine()


def with_cranks(geometry, **others):
    """The paper's machine with all numbers of cranks for every link: machines share programs."""
    n = len(geometry.zero_angle)
    geometry = jax.tree.map(lambda x: np.broadcast_to(x, n), geometry)
    masses = PAPER.masses._replace(slider_mass=np.full(n, PAPER.masses.slider_mass))
    return PAPER._replace(geometry=geometry, masses=masses, **others)


MACHINES = {
    "rrr": with_cranks(CRANKS),
    "rrr unequal": with_cranks(UNEQUAL),
    "five-bar": with_cranks(
        FiveBarGeometry(
            pivot_distance=0.1,
            crank_length=np.array([0.15, 0.16]),
            elbow=np.array([-1.0, 1.0]),
            zero_angle=np.radians([120.0, 60.0]),
        ),
        patches=PAPER.patches._replace(center=PAPER.patches.center[:2]),
        damping=PAPER.damping._replace(ratio=np.full((2, 1), 0.01), count=np.ones(2, int)),
    ),
}
#: Where the random poses are, and how far they are from there.
PLACES = {3: (np.zeros(3), np.array([0.02, 0.02, 0.1])), 2: (np.array([0.0, 0.24]), 0.02)}
KINDS = [
    ("pinned_pinned", "lumped"),
    ("pinned_pinned", "distributed"),
    ("pinned_pinned", "none"),
    ("pinned_free", "none"),
    ("loaded", "distributed"),
]


def states(machine):
    """Random states far from rest."""
    n = len(machine.patches.center)
    rng, count = np.random.default_rng(7), (N_STATES, n)
    center, size = PLACES[n]
    motion = reference.RigidState(
        pose=center + size * rng.uniform(-1, 1, size=count),
        pose_rate=rng.normal(size=count) * np.array([0.3, 0.3, 1.0])[:n],
        q=3e-3 * rng.uniform(-1, 1, size=(*count, R)) / np.arange(1, R + 1),
        q_rate=0.5 * rng.normal(size=(*count, R)),
    )
    return motion, reference.Loads(
        slider=10 * rng.normal(size=count), modal=3 * rng.normal(size=(*count, R))
    )


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_accelerations_equal_multiplier_form(name, kind, shortening):
    machine = MACHINES[name]
    basis, plant = make(kind, machine, shortening=shortening)
    chain, _ = check_multipliers(machine, basis, plant, *states(machine))
    assert np.all(kinematics.chain_status(one_lane(plant), lanes_last(chain)) == status.OK)


@pytest.mark.long  # in short: the multiplier form, of the same energy
@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_accelerations_equal_lagrangian(name, kind, shortening):
    machine = MACHINES[name]
    basis, plant = make(kind, machine, shortening=shortening)
    _, found = closed_form(one_lane(plant), *states(machine))
    check_rows((found.pose, found.modal), by_lagrangian(machine, basis, *states(machine)))


def straight(plant, poses, bend=None):
    """Chains of links at rest, lanes last."""
    poses = lanes_last(poses)
    return kinematics.close_chain(one_lane(plant), poses, 0 * poses, bend)


def test_two_links_hold_the_joint_between_them_by_the_sine_of_their_angle():
    machine = MACHINES["five-bar"]
    _, plant = make("pinned_pinned", machine)
    chain = straight(plant, states(machine)[0].pose)
    angle = np.arctan2(chain.frame.y, chain.frame.x)
    np.testing.assert_allclose(
        kinematics.hold(chain), np.abs(np.sin(angle[1] - angle[0])), rtol=1e-12
    )


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def distances_by_pose(geometry, pose, rho):
    """Between joints of a link, and their derivatives by the pose."""
    near = reference.near_joints(geometry, rho)

    def distances(pose):
        far = reference.platform_joints(geometry, pose) - near
        return jnp.sqrt(jnp.sum(far**2, axis=1))

    return distances(pose), jax.jacfwd(distances)(pose)


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("has_tip", [False, True])
def test_links_that_stretch_move_the_platform_as_far_as_it_takes(name, has_tip):
    """Distances between joints, differentiated by the pose, grow by each link's stretch."""
    machine = MACHINES[name]
    _, plant = make("pinned_free" if has_tip else "pinned_pinned", machine)
    pose = states(machine)[0].pose
    stretch = np.random.default_rng(1).normal(size=pose.shape)
    chain = straight(plant, pose, kinematics.Bend(tip=0 * pose.T) if has_tip else None)
    length, by_pose = distances_by_pose(machine.geometry, pose, np.asarray(chain.rho).T)
    moved = np.asarray(stretch_error(chain, stretch.T)).T
    np.testing.assert_allclose(length, np.broadcast_to(plant.length, length.shape), rtol=1e-12)
    np.testing.assert_allclose((by_pose @ moved[..., None])[..., 0], stretch, atol=1e-11)


# --- the sampled loop -----------------------------------------------------------------------------

#: Where loops are judged, and the first way-point.
POSES = {"rrr": (0.0, 0.0, 0.0), "rrr unequal": (0.0, 0.0, 0.0), "five-bar": (0.0, 0.24)}
#: Those that the paper's drive holds firmly there.
STIFF = ("rrr", "five-bar")
WINDOW = {"metrics__residual_delay": 0.03, "metrics__residual_length": 0.1}
KEYS = {"rrr": "rrr", "rrr unequal": "rrr", "five-bar": "five_bar"}


def case_of(name, **changes):
    """Structure and case of a mechanism with the paper's links, control, electronics and drive."""
    study = paper_study().change(
        **{"run__duration": 0.3, "link__modes": 3, "shaper__kind": "none"} | WINDOW | changes
    )
    structure, case = build_structure(study), build_case(study)
    machine, home = MACHINES[name], np.array(POSES[name])
    n = machine.n_links

    def links(x):
        return np.asarray(x)[:n] if np.shape(x)[:1] == (3,) else x

    control, drive, initial = (
        jax.tree.map(links, part) for part in (case.control, case.drive, case.initial)
    )
    square = np.array([[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]]) * 0.01
    waypoints = home + np.pad(square, ((0, 0), (0, n - 2)))
    case = case._replace(
        machine=machine,
        path=case.path._replace(waypoints=waypoints),
        control=control,
        drive=drive,
        initial=initial,
        load=case.load._replace(wrench=np.zeros(n), pulse=np.zeros(n)),
    )
    structure = structure._replace(mechanism=KEYS[name])
    return structure, jax.tree.map(np.asarray, case)  # numbers of one type share programs


@partial(jax.jit, static_argnums=0)
def linear_forms(structure, case, pose):
    loop = prepare(structure, case).loop
    return plant_response(structure, case, loop, pose), linearise(structure, loop, pose)


@pytest.mark.parametrize("name", MACHINES)
def test_closed_forms_of_the_linear_plant_are_those_of_its_matrices(name):
    """Poles of mass, damping and stiffness by formula, and of the differentiated motion."""
    structure, case = case_of(name)
    plant, linear = linear_forms(structure, case, np.array(POSES[name]))
    n, size = structure.n_pose, structure.n_links * structure.n_modes
    whole = assembled(plant)
    enter, leave = (np.swapaxes(x, 0, 1).reshape(n, size) for x in (whole.enter, whole.leave))
    mass = np.block([[plant.mass, enter], [leave.T, np.eye(size)]])
    zero = np.zeros((n, size))

    def both(pose_part, modal_part):
        return np.block([[pose_part, zero], [zero.T, np.diag(np.ravel(modal_part))]])

    stiffness, damping = (
        both(plant.stiffness, plant.square),
        both(plant.damping, plant.decay),
    )
    by_formula = np.linalg.solve(mass, -np.hstack([stiffness, damping]))
    matrix = np.vstack([np.eye(n + size, 2 * (n + size), n + size), by_formula])
    # sorted by frequency first: equal machines in different places have equal decays
    found, wanted = (np.sort_complex(1j * np.linalg.eigvals(x)) for x in (matrix, linear.state))
    np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-8 * np.abs(wanted).max())


@pytest.fixture(scope="module")
def fast_runs():
    """Fast unshaped squares: (run, uncontrolled run), by name."""
    runs = {}
    for name in MACHINES:
        structure, case = case_of(name, motion__move_time=0.03)
        structure = structure._replace(metrics=("residual_rms",), n_frequencies=1)
        runs[name] = [_simulate(structure, x, True) for x in (case, uncontrolled(case))]
    return runs


@pytest.mark.parametrize("name", STIFF)
def test_control_damps_every_mechanism(fast_runs, name):
    """The paper's gains, electronics and converters on another machine."""
    damped, free = fast_runs[name]
    assert damped.status == free.status == status.OK
    damped, free = (np.max(x.metrics.residual_rms, axis=1) for x in (damped, free))
    assert damped.shape == (MACHINES[name].n_links,)
    assert np.all(damped < free / 3) and free.max() > 1e-6


@pytest.mark.parametrize("name", MACHINES)
def test_chains_stay_closed_along_a_run(fast_runs, name):
    """C by the platform is a bent chord away from B by the crank, in every sample."""
    found = fast_runs[name][0]
    assert int(found.status) in status.FINISHED
    record, geometry = jax.tree.map(np.asarray, found.record), MACHINES[name].geometry
    distance, _ = distances_by_pose(geometry, record.pose, record.slider)
    length, mode = MACHINES[name].beam.length, np.arange(1, 4)
    shortening = ((mode * np.pi * record.modal_coordinate) ** 2).sum(axis=2) / (4 * length)
    assert np.abs(record.slider - record.slider[0]).max() > 5e-3 and shortening.max() > 1e-8
    np.testing.assert_allclose(distance, length - shortening, rtol=0, atol=2e-15)


@pytest.mark.parametrize("name", MACHINES)
def test_margins_are_finite_and_stable(name):
    structure, case = case_of(name)
    found = loop_report(structure, case, np.array(POSES[name]), 1, n_modes=3)
    assert found.is_stable and 2 < found.gain_margin < 10
    assert found.frequency_hz.shape == (1, MACHINES[name].n_links)


# --- studies --------------------------------------------------------------------------------------

CRANKED = {
    "machine": {"kind": "rrr", "joint_radius": 0.07, "kinds": {"rrr": {"crank_length": 0.15}}},
    "motion": {"waypoints": [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]], "move_time": 0.03},
    "run": {"duration": 0.3},
    "link": {"modes": 3},
    "shaper": {"kind": "none"},
    "metrics": {"residual_delay": 0.03, "residual_length": 0.1},
}


def test_a_study_of_a_3_rrr_has_its_cranks():
    machine = build_case(parse_study(CRANKED)).machine
    np.testing.assert_array_equal(machine.geometry.crank_length, 0.15)
    np.testing.assert_allclose(machine.masses.slider_mass, 4e-3 / 0.15**2)


@pytest.mark.long  # in short: a five-bar by command, in test_mechanism_studies
def test_a_study_of_a_3_rrr_runs():
    run = run_study(parse_study(CRANKED), has_record=False)
    assert run.status == status.OK and 2 < run.loop.gain_margin < 10


def test_settling_time_is_that_of_the_rigid_machine():
    """Inertia and rates without JAX equal those of the linear plant with stiff links."""
    study = parse_study(CRANKED)
    inertia, rates = rigid_machine(study)
    structure, case = case_of("rrr")
    own, machine = build_case(study).machine, case.machine
    parts = jax.tree.map(  # what a mechanism has of its own, in shapes of a program above
        lambda x, like: np.broadcast_to(x, np.shape(like)),
        (own.geometry, own.masses),
        (machine.geometry, machine.masses),
    )
    machine = machine._replace(geometry=parts[0], masses=parts[1])
    home = np.array(study.motion.waypoints[-1])
    plant, _ = linear_forms(structure, case._replace(machine=machine), home)
    np.testing.assert_allclose(rates, plant.slide, atol=1e-12)
    np.testing.assert_allclose(inertia, plant.mass, rtol=1e-9, atol=1e-15)


@pytest.mark.long  # in short: every operation is translated, in test_kernel
def test_kernel_equals_scan_on_cranks():
    axes = {"machine.kinds.rrr.crank_length": [0.14, 0.16, 0.18], "control.gain_factor": [0.5, 1.0]}
    spec = parse_sweep(CRANKED | {"sweep": {"axes": axes}})
    check_equal(*both(spec))


@pytest.mark.parametrize(
    "machine, message",
    [
        ({"kind": "rrrr"}, "machine.kind = 'rrrr'.*prrr"),
        (
            {"kind": "rrr", "slider_mass": 0.2},
            "slider_mass = 0.2: machine.kind = 'rrr' has no such",
        ),
        ({"kind": "five_bar", "platform_inertia": 1e-3}, "platform_inertia.*no such part"),
        ({"kinds": {"rrr": {"crank": 1.0}}}, "machine.kinds.rrr.crank = 1.0.*crank_length"),
        ({"kinds": {"rrr": {"crank_length": 0.0}}}, "crank_length = 0.0; allowed: 0.001 to 10"),
    ],
)
def test_bad_mechanisms_are_refused(machine, message):
    with pytest.raises(StudyError, match=message):
        parse_study({"machine": machine})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"build": 3}, "mechanism 'x': build = 3; expected a function"),
        ({"n_links": 2}, "mechanism 'x': n_links = 2, n_pose = 3; allowed: 3 and 3, or 2 and 2"),
        ({"home": (0.0, 0.0)}, "mechanism 'x': home = .*; expected 3 finite numbers"),
    ],
)
def test_descriptions_of_mechanisms_are_checked(change, message):
    check_mechanism(MECHANISMS["rrr"])
    with pytest.raises(PartError, match=message):
        check_mechanism(MECHANISMS["rrr"]._replace(name="x", **change))
