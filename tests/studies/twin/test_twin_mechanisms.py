"""Mechanisms of rails and cranks in the twin: their joints, frequencies, motion and loop."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import kinematics
from jaxmodel.case import uncontrolled
from jaxmodel.linear import linearise, natural_modes
from jaxmodel.mechanisms.carriers import Rail
from jaxmodel.prepare import prepare
from jaxmodel.simulate import simulate
from studies.twin import compare
from studies.twin.chain import close_chain, lever
from studies.twin.loop import run_twin
from studies.twin.machine import describe_machine
from studies.twin.multibody import Settings, build_model
from studies.twin.plan import plan_run
from studies.twin.plots import side_by_side
from studies.twin.verb import twin
from tests.bare import parse_study
from tests.jaxmodel.test_mechanisms import MACHINES, POSES, case_of
from tests.studies.twin.test_twin import EVERYTHING, SHORT, STIFF, differences, needs_exudyn

#: Of links that have little in common, and of what moves with their joints B.
LENGTH, THICKNESS = np.array([0.2, 0.21, 0.19]), np.array([2.0e-3, 2.2e-3, 1.8e-3])
NEAR_MASS = np.array([0.15, 0.12, 0.2])

_prepare = jax.jit(prepare, static_argnums=0)


@partial(jax.jit, static_argnums=0)
def _joints(structure, case, poses):
    """Of the model: positions along the carriers' paths, near and far ends of the links."""
    plant = prepare(structure, case).loop.plant

    def one(pose):
        chain = kinematics.close_chain(plant, pose, 0 * pose)
        away = jnp.stack(chain.near.to_far(), axis=1)
        far = jnp.broadcast_to(jnp.stack(chain.far).T, away.shape)
        return chain.rho, jnp.stack([far - away, far], axis=1)

    return jax.vmap(one)(poses)


_linearise = jax.jit(linearise, static_argnums=0)


def with_unequal_links(name, **changes):
    """Structure and case of a mechanism."""
    structure, case = case_of(name, **changes)
    machine, n = case.machine, structure.n_links
    beam = machine.beam._replace(length=LENGTH[:n], thickness=THICKNESS[:n])
    masses = machine.masses._replace(slider_mass=NEAR_MASS[:n])
    return structure, case._replace(machine=machine._replace(beam=beam, masses=masses))


def off_home(name, seed):
    """A pose near home."""
    home = np.array(POSES[name])
    away = np.random.default_rng(seed).uniform(-1, 1, 3) * [0.02, 0.02, 0.1]
    return home + away[: len(home)]


@pytest.mark.parametrize("name", MACHINES)
def test_joints_are_those_of_the_model(name):
    """By other trigonometry."""
    structure, case = with_unequal_links(name, link__modes=1)
    machine = describe_machine(structure, case)
    poses = np.array([off_home(name, seed) for seed in range(20)])
    each = map(np.asarray, _joints(structure._replace(n_steps=1), case, poses))
    for pose, rho, ends in zip(poses, *each, strict=True):
        found = close_chain(machine, pose)
        np.testing.assert_allclose(found[0], rho, rtol=0, atol=1e-14)
        np.testing.assert_allclose(found[1], ends, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", MACHINES)
def test_a_lever_is_the_way_of_a_joint_over_the_turn_of_its_crank(name):
    machine = describe_machine(*with_unequal_links(name))
    pose = off_home(name, 0)
    (rho, ends), (moved, moved_ends) = (close_chain(machine, x) for x in (pose, pose + 1e-7))
    for i, crank in enumerate(machine.carriers):
        one, two = (x[i, 0] - crank.pivot for x in (ends, moved_ends))
        turn = (one[0] * two[1] - one[1] * two[0]) / crank.length**2
        assert moved[i] - rho[i] == pytest.approx(lever(crank) * turn, rel=1e-5)
        assert abs(turn) > 1e-8


# --- natural frequencies --------------------------------------------------------------------------

#: What holds the carriers: whether they are locked, stiffness along their paths [N/m], and a factor
#: on E A in the finite elements. Links of the model do not stretch; where stretch alone lets the
#: platform move, it takes more stiffness to see that, which costs digits of slow modes.
HOLDS = {
    "locked": (True, 0.0, 1000.0),
    "free": (False, 0.0, 100.0),
    "on springs": (False, 2e4, 100.0),
}


def frequencies_of_elements(machine, pose, kp, axial_factor):
    """Of a machine at rest on springs [Hz], ascending."""
    rest, _ = close_chain(machine, pose)
    model = build_model(
        machine,
        pose,
        lambda i, t, rho, rate: kp * (rest[i] - rho),
        Settings(n_elements=40, axial_factor=axial_factor),
    )
    square, _ = model.system.ComputeODE2Eigenvalues(computeComplexEigenvalues=False)
    return np.sqrt(np.sort(np.abs(square))) / (2 * np.pi)


def both_frequencies(name, hold, pose, stiffer=1.0, inertia=1.0):
    """Of the model and of finite elements [Hz]: three modes a link and, on springs, the drives'.

    stiffer: further factor on E A. inertia: factor on that of the finite elements' cranks.
    """
    is_locked, kp, factor = HOLDS[hold]
    structure, case = with_unequal_links(name, drive__kp=kp, drive__kd=0.0, link__modes=12)
    machine = case.machine
    damping = machine.damping._replace(ratio=0 * machine.damping.ratio)
    case = case._replace(
        machine=machine._replace(damping=damping),
        drive=case.drive._replace(is_locked=float(is_locked)),
    )
    loop = _prepare(structure._replace(n_steps=1), case).loop
    ours = natural_modes(_linearise(structure, loop, pose)).frequency
    described = describe_machine(structure, case)
    carriers = (x._replace(inertia=inertia * x.inertia) for x in described.carriers)
    built = described._replace(carriers=tuple(carriers))
    theirs = frequencies_of_elements(built, pose, kp, stiffer * factor)
    n = structure.n_links
    # left out: what moves as a rigid machine, and the masses that lock carriers of our model
    first, count = {
        "locked": ((n, 0), 3 * n),
        "free": ((n, n), 3 * n),
        "on springs": ((0, 0), 4 * n),
    }[hold]
    return tuple(x[k : k + count] for x, k in zip((ours, theirs), first, strict=True))


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("name", MACHINES)
def test_frequencies_are_those_of_finite_elements(name, hold):
    needs_exudyn()
    for pose in (np.array(POSES[name]), off_home(name, 1)):
        np.testing.assert_allclose(*both_frequencies(name, hold, pose), rtol=2e-4)


def test_what_is_left_where_links_hardly_hold_the_platform_is_stretch():
    """Their lines nearly meet in a point, about which it turns as far as E A lets it."""
    needs_exudyn()
    ours, real = both_frequencies("rrr unequal", "locked", np.zeros(3), stiffer=1e-3)
    assert (ours[0], real[0]) == (pytest.approx(114.1, abs=0.1), pytest.approx(91.0, abs=0.1))
    apart = []
    for stiffer in (0.1, 0.4):  # beyond it rounding shows
        ours, theirs = both_frequencies("rrr unequal", "locked", np.zeros(3), stiffer)
        apart.append((ours / theirs - 1)[1:3])
    assert np.all(apart[0] > 1e-4)
    np.testing.assert_allclose(apart[0] / apart[1], 4, rtol=0.1)


@pytest.mark.parametrize("name", MACHINES)
def test_wrong_cranks_are_noticed(name):
    needs_exudyn()
    ours, theirs = both_frequencies(name, "on springs", np.array(POSES[name]), inertia=1.01)
    assert np.abs(ours / theirs - 1).max() > 1e-3


@pytest.mark.parametrize("name", MACHINES)
def test_a_rail_may_stand_for_a_crank(name):
    """Along the tangent of its circle: at rest it makes no difference that the path is straight."""
    needs_exudyn()
    pose = np.array(POSES[name])
    machine = describe_machine(*with_unequal_links(name))
    rho, ends = close_chain(machine, pose)
    (crank, *others), near = machine.carriers, ends[0, 0]
    arm = near - crank.pivot
    along = crank.elbow * np.array([-arm[1], arm[0]]) / crank.length
    rail = Rail(
        start=near - rho[0] * along,
        direction=along,
        length=1.0,
        mass=crank.inertia / crank.length**2,
    )
    mixed = machine._replace(carriers=(rail, *others))
    for found, wanted in zip(close_chain(mixed, pose), (rho, ends), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-14)
    one, two = (frequencies_of_elements(x, pose, 2e4, 1.0)[:12] for x in (machine, mixed))
    np.testing.assert_allclose(one, two, rtol=1e-5)


# --- motion ---------------------------------------------------------------------------------------

MOVE = {"motion__waypoints": ((0.0, 0.0, 0.0), (0.0, 0.01, 0.0))}


def three_legs(elbow, **changes):
    """A study of a 3-RRR with unequal legs."""
    own = {
        "pivot_radius": (0.30, 0.31, 0.29),
        "pivot_turn": (0.0, 5.0, -4.0),
        "crank_length": (0.16, 0.15, 0.17),
        "crank_inertia": (4e-3, 3e-3, 5e-3),
        "elbow": elbow,
    }
    machine = {"kind": "rrr", "joint_radius": (0.07, 0.06, 0.08), "kinds": {"rrr": own}}
    return parse_study({"machine": machine}).change(**SHORT | changes | MOVE)


def test_a_controlled_move_of_a_3_rrr_is_the_same_in_both_models():
    """With the exported controller."""
    needs_exudyn()
    study = three_legs((1.0, -1.0, 1.0))
    found = differences(study, STIFF)
    assert np.all(found < [1e-3, 1e-3, 4e-3]), found
    machine = compare.TwinBench(study, STIFF).machine
    heavier = tuple(x._replace(inertia=1.02 * x.inertia) for x in machine.carriers)
    wrong = differences(study, STIFF, machine._replace(carriers=heavier))
    assert np.all(wrong > 1.5 * found), (found, wrong)


def test_everything_a_study_of_a_3_rrr_can_have_is_in_the_twin():
    needs_exudyn()
    found = differences(three_legs(-1.0, **EVERYTHING), STIFF)
    assert np.all(found < 1e-2), found


@pytest.fixture(scope="module")
def five_bar():
    """A move under load, with friction: plan and signals by both models."""
    needs_exudyn()
    changes = {
        "motion__move_time": 0.03,
        "shaper__kind": "none",
        "drive__viscous_friction": 3.0,
        "load__mass": 0.1,
        "load__wrench": (2.0, -1.0, 0.0),
    }
    structure, case = case_of("five-bar", **changes)
    case = uncontrolled(case._replace(load=case.load._replace(wrench=np.array([2.0, -1.0]))))
    record = jax.jit(simulate, static_argnums=(0, 2))(structure, case, True).record
    plan = plan_run(structure, case, STIFF, 0.05)
    run = run_twin(describe_machine(structure, case), plan, None, STIFF)
    record = jax.tree.map(lambda x: np.asarray(x)[: len(run.time)], record)
    ours = compare.RunSignals(
        deflection=record.chord_deflection_stations[:, :, 1],  # at mid-span
        pose_error=record.pose_error,
        voltage=record.actuator_voltage,
    )
    error = run.pose - (record.pose - record.pose_error)
    theirs = compare.RunSignals(run.deflection, error, run.voltage)
    return plan, compare.BothModels(ours, theirs)


def test_a_move_of_a_five_bar_is_the_same_in_both_models(five_bar):
    _, (ours, theirs) = five_bar
    largest = np.abs(ours.deflection).max()
    assert largest > 1e-4
    np.testing.assert_allclose(theirs.deflection, ours.deflection, rtol=0, atol=5e-4 * largest)
    np.testing.assert_allclose(theirs.pose_error, ours.pose_error, rtol=0, atol=5e-8)


def test_the_figure_has_a_row_for_each_link(five_bar):
    plan, both = five_bar
    assert len(side_by_side(plan, compare.BothRuns(both, both)).axes) == 2 * (2 + 2)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_square_of_a_3_rrr_is_the_same_in_both_models(tmp_path):
    needs_exudyn()
    square = [[0.0, 0.0], [0.0, 0.01], [0.01, 0.01], [0.01, 0.0], [0.0, 0.0]]
    study = parse_study(
        {
            "machine": {"kind": "rrr", "joint_radius": 0.07},
            "motion": {"waypoints": [[*at, 0.0] for at in square], "move_time": 0.03},
            "run": {"duration": 0.5},
            "metrics": {"residual_length": 0.1},
        }
    )
    result = twin(study, tmp_path, progress=False)
    changes = {one.text: one for one in result.causes}
    found = changes["as they are"]
    assert found.controlled < 3.5e-3 and found.voltage < 6e-3
    # most of it is that links of our model do not stretch, or the ADC's rounding
    assert changes["twin: links 1000 times stiffer in tension"].controlled < 1e-3
    assert changes["both: an ADC that hardly rounds"].voltage < 4e-3
    assert result.growth.is_confirmed
    assert result.growth.margin == pytest.approx(float(result.loop.gain_margin), rel=5e-3)
    assert "platform, error of angle" in (tmp_path / "report.html").read_text()
