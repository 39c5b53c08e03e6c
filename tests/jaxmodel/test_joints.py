"""Pin joints that rub: forces, energy, runs, steps, derivatives, and what judges leave out."""

import itertools
from functools import partial
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import cumulative_simpson

from jaxmodel.defaults import HOME
from jaxmodel.joints import joint_decay, rub
from jaxmodel.kinematics import link_direction
from jaxmodel.loop import PlantState
from jaxmodel.plant import build_plant
from jaxmodel.prepare import STIFFNESS_LIMIT
from jaxmodel.simulate import simulate
from studies.engine.preflight import check_run
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.reference import lagrangian
from studies.verify import machine as verified
from tests import forms
from tests.bare import parse_study
from tests.jaxmodel.kept import arrays, loop_at, prepared
from tests.jaxmodel.test_integrator import SAMPLE, energies, run
from tests.jaxmodel.test_mechanisms import MACHINES, states

#: Strong and slow enough that friction changes every acceleration [N m], [rad/s].
STRONG = {"joint_friction": 5.0, "joint_friction_speed": 2.0}
#: So that steps of it are of fourth order.
SMOOTH = {"machine__joint_friction": 2e-3, "machine__joint_friction_speed": 0.5}


_built = jax.jit(partial(build_plant, has_joint_friction=True))
_chain = jax.jit(lagrangian.modal_chain)


def accelerations(name):
    """By the reduced equations and by the Lagrangian, of joints that rub."""
    machine = (MACHINES | {"prrr": forms.MACHINE})[name]._replace(**STRONG)
    basis, _ = forms.make("pinned_pinned", machine)
    plant = jax.tree.map(np.asarray, _built(machine, basis))
    motion = states(machine)
    found = forms.closed_form(forms.one_lane(plant), *motion)[1]
    return (found.pose, found.modal), forms.by_lagrangian(machine, basis, *motion)


@pytest.mark.parametrize("name", ["prrr", "rrr unequal", "five-bar"])
def test_accelerations_equal_lagrangian(name):
    forms.check_rows(*accelerations(name))


def left_on_the_links(*arguments):
    """Nothing on the platform."""
    force, piezo, _, torque = rub(*arguments)
    return force, piezo, arguments[-1], torque


def test_a_fault_fails_its_row_of_verify():
    study = parse_study({"link": {"modes": 1}, "machine": {"joint_friction": 1e-4}})
    assert all(row.is_passed for row in verified.check_machine(study))
    anew = partial(verified._both.__wrapped__)  # a program of its own
    with (
        mock.patch.object(lagrangian, "rub", left_on_the_links),
        mock.patch.object(verified, "_both", jax.jit(anew)),
    ):
        failed = [row.assumption for row in verified.check_machine(study) if not row.is_passed]
    assert len(failed) == 2 and all("accelerations" in name for name in failed)


def end_angles(loop, state):
    """Of the links' ends from slider and platform [rad], (2, 3), by closed forms of the sines."""
    chain = lagrangian.modal_chain(loop.plant, *state[:4])
    wave = np.arange(1, state.q.shape[1] + 1) * np.pi / np.asarray(loop.plant.length)[:, None]
    sign = np.where(np.arange(state.q.shape[1]) % 2 == 0, -1.0, 1.0)
    near, far = (
        link_direction(chain) + jnp.sum(slope * state.q, 1) for slope in (wave, sign * wave)
    )
    return jnp.stack([near, far - state.pose[2]])


def test_energy_lost_is_the_work_of_the_joints_and_steps_are_of_fourth_order():
    changes = SMOOTH | {"drive__kp": 0.0, "drive__kd": 0.0, "link__damping_ratio": 0.0}
    study = parse_study({"link": {"modes": 2}, "control": {"feedback": "none"}}).change(**changes)
    structure, case = arrays(study)
    structure = structure._replace(n_steps=1)
    loop = prepared(structure, case).loop
    q = np.array([[1e-4, 1e-5], [5e-5, 0.0], [-1e-4, 2e-5]])
    home = np.array(HOME)
    start = PlantState(home, 0 * home, q, 0 * q, 0 * q, 0 * q)
    step = 1e-5
    voltages = np.zeros((3000, structure.n_links, structure.n_patches))
    after = run("etdrk4", structure, loop, step, 1, voltages, start)
    course = jax.tree.map(lambda x, y: np.concatenate([x[None], y]), start, after)

    @jax.jit
    @jax.vmap
    def power(state):
        moving = state._replace(pose=state.pose_rate, q=state.q_rate)
        rate = jax.jvp(
            lambda pose, q: end_angles(loop, state._replace(pose=pose, q=q)),
            (state.pose, state.q),
            (moving.pose, moving.q),
        )[1]
        torque, speed = loop.plant.joint_friction[:2]
        return -jnp.sum(torque * jnp.tanh(rate / speed) * rate)

    energy = np.asarray(energies(loop.plant, course))
    work = cumulative_simpson(power(course), dx=step, initial=0)
    assert energy[-1] < 0.5 * energy[0]
    np.testing.assert_allclose(energy - energy[0], work, rtol=0, atol=1e-7 * energy[0])
    ends = [
        run("etdrk4", structure, loop, SAMPLE, n, voltages[:100], start).q[:, :, 0]
        for n in (4, 8, 16)
    ]
    change = [np.abs(b - a).max() for a, b in itertools.pairwise(ends)]
    assert np.log2(change[0] / change[1]) == pytest.approx(4, abs=0.3)


FAST = {
    "run": {"duration": 0.12},
    "link": {"modes": 8},
    "control": {"feedback": "none"},
    "motion": {"waypoints": [HOME, (HOME[0], HOME[1] + 0.01, HOME[2])], "move_time": 0.03},
    "shaper": {"kind": "none"},
    "metrics": {"residual_delay": 0.026, "residual_length": 0.05},
}


def rung(torque):
    """Mode 1 from 26 to 76 ms after a fast move [um], rms and about its mean, (3,) each."""
    study = FAST | {"run": FAST["run"] | {"substeps": 32 if torque else 1}}
    study = parse_study(study | {"machine": {"joint_friction": torque}})
    record = run_study(study, has_loop=False).result.record
    seen = 1e6 * np.asarray(record.modal_coordinate)[(record.time > 0.0559) & (record.time < 0.106)]
    return np.sqrt((seen[:, :, 0] ** 2).mean(axis=0)), seen[:, :, 0].std(axis=0)


@pytest.mark.parametrize(
    ("torque", "wanted", "within"),
    [
        (0.0, [11.6, 18.9, 14.2], 0.01),
        (5e-5, [6.4, 13.0, 9.3], 0.02),
        (2e-4, [0.75, 3.4, 2.9], 0.07),
    ],
)
def test_ringing_after_a_fast_move(torque, wanted, within):
    np.testing.assert_allclose(rung(torque)[0], wanted, rtol=within)


def test_joints_that_stick_hold_the_rest():
    """Below 1 um nothing but the order of size is known: it follows the law near standstill."""
    assert np.all(rung(1e-3)[1] < 1.0)


def test_derivatives_by_friction_and_by_lag_equal_differences():
    data = FAST | {"machine": {"joint_friction": 1e-4, "joint_friction_speed": 0.1}}
    data |= {"link": {"modes": 2}, "drive": {"lag": 1e-3}, "run": {"substeps": 2}}
    structure, case = arrays(parse_study(data))
    structure = structure._replace(is_smooth=True, metrics=("residual_rms",))

    def residual(numbers):
        machine = case.machine._replace(joint_friction=numbers[0])
        drive = case.drive._replace(lag=numbers[1])
        found = simulate(structure, case._replace(machine=machine, drive=drive))
        return (found.metrics.residual_rms[:, 0],) * 2

    program, at = jax.jit(jax.jacfwd(residual, has_aux=True)), np.array([1e-4, 1e-3])
    slope = program(at)[0]
    for k, step in enumerate((1e-8, 1e-7)):
        (_, up), (_, down) = (program(at + sign * step * np.eye(2)[k]) for sign in (1, -1))
        assert np.all(slope[:, k] != 0)
        np.testing.assert_allclose(slope[:, k], (up - down) / (2 * step), rtol=1e-4)


def test_friction_counts_as_nothing_where_loops_are_judged():
    loops = [
        loop_at(
            *arrays(parse_study({"machine": {"joint_friction": x}, "link": {"modes": 2}})), HOME
        )
        for x in (0.0, 1e-3)
    ]
    for a, b in zip(*map(jax.tree.leaves, loops), strict=True):
        np.testing.assert_array_equal(a, b)


def test_steps_are_short_enough_for_the_steepest_friction():
    structure, case = arrays(parse_study({"machine": {"joint_friction": 1e-3}}))
    loop = prepared(structure, case).loop
    still = lagrangian.RigidState(np.array(HOME), np.zeros(3), *np.zeros((2, 3, 8)))
    chain = _chain(loop.plant, *still)

    def on_modes(q_rate):
        rates = still.pose_rate, q_rate.reshape(3, 8)
        return rub(loop.plant, chain, rates, np.zeros(3), np.zeros((3, 8)), None)[1].ravel()

    slopes = jax.jit(jax.jacfwd(on_modes))(np.zeros(24))
    fastest = -np.linalg.eigvals(np.asarray(slopes)).real.min()
    assert joint_decay(loop.plant) == pytest.approx(fastest, rel=1e-9)
    steps = check_run(parse_study(FAST | {"machine": {"joint_friction": 1e-3}}))[0].substeps
    assert 1 <= STIFFNESS_LIMIT * steps / (fastest * SAMPLE) < 2
    for most, changes in ((200, {}), (3, {"run__substeps": 3})):
        rough = parse_study(FAST).change(machine__joint_friction=0.5, **changes)
        said = f"machine.joint_friction = 0.5; allowed: small enough for {most} plant steps"
        with pytest.raises(StudyError, match=said):
            check_run(rough)
