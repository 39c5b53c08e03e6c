"""ETDRK4: its coefficients, its order and its accuracy against classical Runge-Kutta."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxmodel.defaults import HOME
from jaxmodel.drive import Reference
from jaxmodel.dynamics import kinetic_energy, modal_chain, potential_energy
from jaxmodel.integrator import exponential_step
from jaxmodel.kinematics import inverse_kinematics
from jaxmodel.loop import PlantState, plant_rates, plant_step
from jaxmodel.prepare import prepare
from studies.engine.programs import kept_jit
from studies.reference import lagrangian as reference
from studies.study.cases import as_arrays, build_case, build_structure
from tests.bare import paper_study

SAMPLE = 1e-4  # [s]
MOVE_TIME, MOVE = 0.05, 0.01  # [s], [m]
CORNER = 2 * np.pi * 2000  # of the anti-alias filter [rad/s]
STUDY = paper_study().change(control__feedback="none")


# --- coefficients ---------------------------------------------------------------------------------

OMEGA_H = [1e-4, 1e-2, 0.3, 1.0, 4.6, 12.0]


def oscillator(omega, zeta, drain):
    """A and force direction of (q, q'/omega, z, z'/omega_f, s): states of one size."""
    a = np.array(
        [
            [0, omega, 0, 0, 0],
            [-omega, -2 * zeta * omega, 0, 0, 0],
            [0, 0, 0, CORNER, 0],
            [CORNER, 0, -CORNER, -np.sqrt(2) * CORNER, -CORNER],
            [drain, 0, 0, 0, -drain],
        ]
    )
    return a, np.array([0, 1 / omega, 0, 0, 0]), np.array([1, omega, 1, CORNER, 1])


def phi_functions(a, force):
    """exp(A) and phi_1..phi_3(A) force, from one exponential of an augmented matrix."""
    n = len(force)
    wide = np.zeros((n + 3, n + 3))
    wide[:n, :n], wide[:n, n] = a, force
    wide[n, n + 1] = wide[n + 1, n + 2] = 1
    full = scipy.linalg.expm(wide)
    return full[:n, :n], *full[:n, n:].T


def coefficients(omega, zeta, drain):
    shaped = np.full((3, 1), omega), np.full((3, 1), zeta)
    return jax.tree.map(np.asarray, jitted_step(*shaped, SAMPLE, CORNER, drain))


jitted_step = jax.jit(exponential_step)


@pytest.mark.parametrize("drain", [None, 150.0])
@pytest.mark.parametrize("omega_h", OMEGA_H)
def test_coefficients_equal_augmented_exponentials(omega_h, drain):
    omega, zeta = omega_h / SAMPLE, 0.01
    found = coefficients(omega, zeta, drain)
    n = found.full.shape[0]
    assert n == (4 if drain is None else 5)
    a, force, scale = (x[:n] for x in oscillator(omega, zeta, drain or 0.0))
    a = a[:, :n]
    e, p1, p2, p3 = phi_functions(a * SAMPLE, force)
    e_half, p1_half, _, _ = phi_functions(a * SAMPLE / 2, force)
    weights = SAMPLE * np.array([p1 - 3 * p2 + 4 * p3, 2 * p2 - 4 * p3, 4 * p3 - p2])
    ratio = scale[:, None] / scale  # from states of one size back to (q, q', z, z')
    pairs = (
        (found.full[..., 0, 0] / ratio, e),
        (found.half[..., 0, 0] / ratio[:2, :2], e_half[:2, :2]),
        (found.full_force[..., 0, 0] / scale, weights),
        (found.half_force[..., 0, 0] / scale[:2], SAMPLE / 2 * p1_half[:2]),
    )
    for mine, wanted in pairs:
        np.testing.assert_allclose(mine, wanted, atol=2e-13 * np.abs(wanted).max())


@pytest.mark.parametrize("omega_h", OMEGA_H)
def test_constant_force_is_exact_in_one_step(omega_h):
    omega, zeta = omega_h / SAMPLE, 0.05
    found = coefficients(omega, zeta, None)
    static, q, q_rate = 1e-4, 3e-4, -2e-4 * omega  # static deflection N/omega^2
    start = np.array([q, q_rate, 0, 0])
    push = found.full_force[0] + 2 * found.full_force[1] + found.full_force[2]
    after = (found.full[..., 0, 0] @ start + push[:, 0, 0] * static * omega**2)[:2]
    damped = omega * np.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * omega_h)
    c, s = np.cos(damped * SAMPLE), np.sin(damped * SAMPLE)
    swing = (q_rate + zeta * omega * (q - static)) / damped
    wanted = static + decay * ((q - static) * c + swing * s)
    pull = (omega**2 * (q - static) + zeta * omega * q_rate) / damped
    wanted_rate = decay * (q_rate * c - pull * s)
    np.testing.assert_allclose(after[0], wanted, atol=1e-16)
    np.testing.assert_allclose(after[1] / omega, wanted_rate / omega, atol=1e-16)


# --- the whole plant ------------------------------------------------------------------------------


def wanted_motion(loop, home, time):
    """Drive reference of one cycloid move (25) along y, from a pose on."""
    tau = jnp.clip(time / MOVE_TIME, 0, 1)
    y = MOVE * (tau - jnp.sin(2 * np.pi * tau) / (2 * np.pi))
    y_rate = MOVE / MOVE_TIME * (1 - jnp.cos(2 * np.pi * tau))
    along = np.eye(len(home))[1]
    rho, rho_rate = inverse_kinematics(loop.plant, home + y * along, y_rate * along)
    return Reference(rho, rho_rate, None, jnp.zeros_like(rho))


def derivative(structure, loop, voltage, state, wanted):
    """Time derivative of the plant with its filter, for classical Runge-Kutta."""
    rates = plant_rates(structure, loop, state, wanted, voltage).acceleration
    z_acc = CORNER**2 * (state.q - state.z) - np.sqrt(2) * CORNER * state.z_rate
    return PlantState(state.pose_rate, rates.pose, state.q_rate, rates.modal, state.z_rate, z_acc)


@partial(jax.jit, static_argnums=(0, 1))
def run(method, structure, loop, sample, substeps, voltages, start):
    """States after each sample; the number of steps in a sample is traced."""
    step = sample / substeps
    zeta = loop.plant.damping / (2 * loop.plant.modal_mass[:, None] * loop.omega)
    exponential = exponential_step(loop.omega, zeta, step, CORNER)
    loop = loop._replace(plant_step=step, exponential=exponential)

    def one_sample(state, inputs):
        index, voltage = inputs

        def one_step(k, state):
            time = index * sample + k * step
            wanted = tuple(wanted_motion(loop, start.pose, time + x * step) for x in (0, 0.5, 1))
            if method == "etdrk4":
                return plant_step(structure, loop, state, wanted, voltage)[0]
            slope = partial(derivative, structure, loop, voltage)
            return reference.rk4_step(slope, state, step, wanted)

        state = jax.lax.fori_loop(0, substeps, one_step, state)
        return state, state

    return jax.lax.scan(one_sample, start, (jnp.arange(len(voltages)), voltages))[1]


_prepare = kept_jit(static_argnums=0)(prepare)


def make(**changes):
    study = STUDY.change(**changes)
    structure = build_structure(study)._replace(n_steps=1)
    loop = _prepare(structure, as_arrays(build_case(study))).loop
    zero, still = np.zeros((3, structure.n_modes)), np.zeros(3)
    return structure, loop, PlantState(np.array(HOME), still, zero, zero, zero, zero)


@pytest.fixture(scope="module")
def eight_modes():
    return make(link__modes=8)


def random_voltages(n_samples):
    return np.random.default_rng(11).uniform(-50, 50, (n_samples, 3, 3))


@pytest.mark.parametrize(
    ("has_shortening", "volts", "substeps"),
    [pytest.param(False, 50, 1, marks=pytest.mark.long), (True, 3, 1), (True, 50, 4)],
)
def test_few_steps_per_sample_are_as_good_as_forty_of_runge_kutta(
    eight_modes, has_shortening, volts, substeps
):
    """White noise on the actuators, which rings the highest modes, the worst that can happen."""
    structure, loop, start = eight_modes
    assert float(loop.omega.max()) * SAMPLE > 4.5  # far beyond what Runge-Kutta bears
    if not has_shortening:
        structure = structure._replace(has_shortening=False)
        loop = loop._replace(plant=loop.plant._replace(shortening=None))
    voltages = volts / 50 * random_voltages(100)
    fine = run("rk4", structure, loop, SAMPLE, 40, voltages, start)
    coarse = run("etdrk4", structure, loop, SAMPLE, substeps, voltages, start)
    for part in ("q", "z"):
        deflection = [
            np.einsum("ir,tir->ti", loop.deflection_at[:, 1], getattr(states, part))
            for states in (fine, coarse)
        ]
        error = np.abs(deflection[1] - deflection[0]).max() / np.abs(deflection[0]).max()
        assert error < 1e-4
    pose_error = np.abs(coarse.pose - fine.pose)[:, :2].max()
    assert pose_error < 1e-5 * MOVE


def test_order_is_four(eight_modes):
    structure, loop, start = eight_modes
    voltages, ends = random_voltages(100), []
    for substeps in (8, 16, 32):
        states = run("etdrk4", structure, loop, SAMPLE, substeps, voltages, start)
        ends.append(np.concatenate([states.pose, states.q[:, :, 0], states.z[:, :, 0]], axis=1))
    change = [np.abs(b - a).max(axis=0) for a, b in itertools.pairwise(ends)]
    np.testing.assert_allclose(np.log2(change[0] / change[1]), 4, atol=0.15)


# --- energy ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def free_machine():
    """One mode, no damping, no drive; the links bent alike, which excites one natural mode."""
    structure, loop, start = make(
        link__modes=1, link__damping_ratio=0.0, drive__kp=0.0, drive__kd=0.0
    )
    return structure, loop, start._replace(q=np.full((3, 1), 1e-4))


def bent_machine(modes, is_released):
    """No damping, no drive; links bent by 0.1 mm in the first mode, or all modes of equal energy.

    Then it is 0.2 mm in the first.
    """
    changes = {"link__damping_ratio": 0.0, "drive__kp": 0.0, "drive__kd": 0.0}
    structure, loop, start = make(link__modes=modes, **changes)
    shape = np.random.default_rng(2).choice([-1.0, 1.0], (3, modes)) / np.arange(1, modes + 1) ** 2
    shape = 0.5 * np.abs(shape) * (np.arange(modes) == 0) if is_released else shape
    return structure, loop, start._replace(q=2e-4 * shape)


@jax.jit
def energies(plant, states):
    def energy(s):
        chain = modal_chain(plant, s.pose, s.pose_rate, s.q, s.q_rate)
        kinetic = kinetic_energy(plant, chain, s.pose_rate, s.q, s.q_rate)
        return kinetic + potential_energy(plant, s.q)

    return jax.vmap(energy)(states)


def energy_history(free_machine, method, sample, substeps, n_samples):
    structure, loop, start = free_machine
    states = run(method, structure, loop, sample, substeps, np.zeros((n_samples, 3, 3)), start)
    return np.asarray(energies(loop.plant, states))


@pytest.mark.long  # in short: steps as good as those of Runge-Kutta, above
@pytest.mark.parametrize("step", [3e-4, 6e-4])
def test_runge_kutta_loses_the_energy_it_must(free_machine, step):
    history = energy_history(free_machine, "rk4", 10 * step, 10, 100)
    omega = 2 * np.pi * 114.652  # the mode in which the platform turns
    loss = -np.log(history[-1] / history[0]) / (10 * 99)
    np.testing.assert_allclose(loss, (omega * step) ** 6 / 72, rtol=0.05)


@pytest.mark.long  # in short: that of many modes
@pytest.mark.parametrize("method", ["rk4", "etdrk4"])
def test_energy_is_kept_for_a_second(free_machine, method):
    history = energy_history(free_machine, method, 1e-2, 500, 100)
    assert np.abs(history / history[0] - 1).max() < 1e-8


@pytest.mark.parametrize(
    ("modes", "is_released", "step"),
    [
        (3, False, 2e-5),
        pytest.param(3, True, 5e-5, marks=pytest.mark.long),
        pytest.param(8, True, 1e-5, marks=pytest.mark.long),
        pytest.param(8, False, 2.5e-6, marks=pytest.mark.long),
    ],
)
def test_energy_of_many_modes_is_kept_once_the_step_is_small(modes, is_released, step):
    """Nothing is lost but by time stepping; the links shorten their chords all the while."""
    machine = bent_machine(modes, is_released)
    history = energy_history(machine, "etdrk4", 1e-2, round(1e-2 / step), 100)
    assert np.abs(history / history[0] - 1).max() < 1e-8


#: docs/theory.md, section 4: modes, whether only the first one is bent, drift in 1 s.
DRIFT = [(3, True, 2.2e-8), (8, True, 1.4e-5), (3, False, 7.6e-6), (8, False, 2.2e-2)]


@pytest.mark.parametrize(("modes", "is_released", "drift"), DRIFT)
def test_energy_drift_at_the_working_step_is_as_documented(modes, is_released, drift):
    history = energy_history(bent_machine(modes, is_released), "etdrk4", 1e-2, 100, 100)
    assert 0.8 * drift < np.abs(history / history[0] - 1).max() < 1.05 * drift
