"""Dynamics against the Lagrangian, the multiplier form and the paper's geometry."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import dynamics, kinematics, status
from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from jaxmodel.mechanisms.prrr.paper import HOME
from studies.reference import lagrangian as reference
from tests.forms import MACHINE, R, all_forms, check_forms, make

HOME_POSE = np.array(HOME)
N_STATES = 100


#: Bases, and how a bent link's mass moves inwards.
KINDS = [
    ("pinned_pinned", "lumped"),
    ("pinned_pinned", "distributed"),
    ("pinned_pinned", "none"),
    ("pinned_free", "none"),
    ("loaded", "lumped"),
    ("loaded", "distributed"),
    ("loaded", "none"),
]


@pytest.fixture(scope="module")
def states():
    """Random states far from rest: bending up to 3 mm, speeds of the fast moves."""
    rng = np.random.default_rng(7)
    scale = np.array([0.012, 0.012, 0.06])
    motion = reference.RigidState(
        pose=HOME_POSE + scale * rng.uniform(-1, 1, size=(N_STATES, 3)),
        pose_rate=rng.normal(size=(N_STATES, 3)) * [0.3, 0.3, 1.0],
        q=3e-3 * rng.uniform(-1, 1, size=(N_STATES, 3, R)) / np.arange(1, R + 1),
        q_rate=0.5 * rng.normal(size=(N_STATES, 3, R)),
    )
    shape = (N_STATES, 3)
    loads = reference.Loads(10 * rng.normal(size=shape), 3 * rng.normal(size=(*shape, R)))
    return motion, loads


def closed_form(plant, motion, loads):
    return reference.closed_form(plant, motion, loads)[1]


@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_accelerations_equal_lagrangian_and_multiplier_form(kind, shortening, states):
    basis, plant = make(kind, shortening=shortening)

    (_, found), lagrangian, multipliers = all_forms(MACHINE, basis, plant, *states)
    check_forms(found, lagrangian, multipliers)
    oscillator = plant.stiffness * states[0].q + plant.damping * states[0].q_rate
    oscillator = oscillator / plant.modal_mass[:, None]
    np.testing.assert_allclose(
        found.coupling, found.modal + oscillator, atol=1e-12 * np.abs(oscillator).max()
    )
    if basis.tip is not None:  # the states do bend the chord away from the tangent
        assert np.abs(np.sum(basis.tip * states[0].q, axis=2)).max(axis=1).min() > 1e-4


@pytest.mark.parametrize("kind", ["pinned_pinned", "pinned_free"])
def test_kinetic_energy_equals_quadrature_over_the_link(kind, states):
    """Of links whose chord keeps its length: the share of the shortening is approximate."""
    node, weight = np.polynomial.legendre.leggauss(24)
    length = MACHINE.beam.length
    x, share = length * (node + 1) / 2, weight / 2
    basis, plant = make(kind, stations=x, shortening="none")
    tip = 0.0 if basis.tip is None else basis.tip[0]
    shape = basis.deflection_at[0] + (x / length)[:, None] * tip
    motion, _ = states

    def points(pose, q):
        """Points of the links in the plane, their sliders, (3, points, 2) and (3, 2)."""
        rho, beta = reference.close(MACHINE, basis, pose, q)
        along = jnp.stack([jnp.cos(beta), jnp.sin(beta)], axis=1)[:, None]
        across = jnp.stack([-jnp.sin(beta), jnp.cos(beta)], axis=1)[:, None]
        slider = reference.near_joints(MACHINE.geometry, rho)
        return slider[:, None] + x[:, None] * along + (q @ shape.T)[:, :, None] * across, slider

    @jax.jit
    @jax.vmap
    def energies(m):
        velocity, slider = jax.jvp(points, (m.pose, m.q), (m.pose_rate, m.q_rate))[1]
        links = 0.011 * jnp.sum(share * jnp.sum(velocity**2, axis=2))
        rigid = 0.15 * jnp.sum(slider**2) + 0.25 * jnp.sum(m.pose_rate[:2] ** 2)
        chain = dynamics.modal_chain(plant, m.pose, m.pose_rate, m.q, m.q_rate)
        mine = dynamics.kinetic_energy(plant, chain, m.pose_rate, m.q, m.q_rate)
        return mine, (links + rigid + 3e-4 * m.pose_rate[2] ** 2) / 2

    mine, wanted = energies(motion)
    np.testing.assert_allclose(mine, wanted, rtol=1e-12)


@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_kinetic_energy_is_that_of_the_lagrangian(kind, shortening, states):
    """With the chord's shortening, too."""
    basis, plant = make(kind, shortening=shortening)

    @jax.jit
    @jax.vmap
    def energies(m):
        joints, rates = jax.jvp(
            partial(reference.close, MACHINE, basis), (m.pose, m.q), (m.pose_rate, m.q_rate)
        )
        chain = dynamics.modal_chain(plant, m.pose, m.pose_rate, m.q, m.q_rate)
        mine = dynamics.kinetic_energy(plant, chain, m.pose_rate, m.q, m.q_rate)
        return mine, reference.kinetic_energy(
            MACHINE, basis, joints, m.pose, m.q, rates, m.pose_rate, m.q_rate
        )

    mine, wanted = energies(states[0])
    np.testing.assert_allclose(mine, wanted, rtol=1e-11)


@pytest.mark.parametrize("kind", ["pinned_pinned", "pinned_free"])
def test_closure_holds_to_rounding_along_a_random_motion(kind):
    basis, plant = make(kind)
    rng = np.random.default_rng(3)
    frequency, phase = rng.uniform(5, 200, 12), rng.uniform(0, 2 * np.pi, 12)
    amplitude = np.r_[0.012, 0.012, 0.06, np.full(9, 1e-3)]

    def path(t):
        z = jnp.concatenate([HOME_POSE, jnp.zeros(9)]) + amplitude * jnp.sin(frequency * t + phase)
        return z[:3], z[3:].reshape(3, R)

    @jax.jit
    @jax.vmap
    def along(t):
        (pose, q), (pose_rate, q_rate) = jax.jvp(path, (t,), (1.0,))
        chain = dynamics.modal_chain(plant, pose, pose_rate, q, q_rate)
        gamma = kinematics.link_angle(chain)
        beta = kinematics.link_direction(chain)
        tips = reference.link_tips(MACHINE, basis, chain.rho, beta, q)
        rates = jax.jvp(lambda t: reference.close(MACHINE, basis, *path(t)), (t,), (1.0,))[1]
        return (
            tips - reference.platform_joints(MACHINE.geometry, pose),
            kinematics.closure_residual(chain, gamma),
            (chain.rho_rate - rates[0], chain.beta_rate - rates[1]),
        )

    outside, own, rate_errors = along(np.linspace(0, 1, 500))
    assert np.abs(outside).max() < 5e-16  # [m]: a few roundings of 0.3 m
    assert np.abs(own).max() < 5e-16
    assert np.abs(rate_errors[0]).max() < 1e-13 and np.abs(rate_errors[1]).max() < 1e-12


def test_a_dropped_term_of_the_shortening_would_be_noticed(states):
    """The comparison with the Lagrangian must fail for a model without the mass that moves in."""
    basis, plant = make("pinned_pinned")
    still = plant._replace(tip_mass=plant.tip_mass * (1 - 1e-6))
    (_, found), (pose, _), _ = all_forms(MACHINE, basis, still, *states)
    assert np.abs(found.pose - pose).max() > 1e-9 * np.abs(pose).max()


def test_axial_force_is_the_one_that_bending_feels(states):
    """N from the equation of a mode equals N from the equilibrium of joint and slider."""
    _basis, plant = make("pinned_pinned")
    motion, loads = states

    @jax.jit
    @jax.vmap
    def forces(m, load):
        found, chain = closed_form(plant, m, load), dynamics.modal_chain(plant, *m)
        inertia = plant.modal_mass[:, None] * (found.modal - m.q * chain.beta_rate[:, None] ** 2)
        drag = plant.c * found.beta[:, None] - plant.b * (chain.sine * found.rho)[:, None]
        elastic = plant.stiffness * m.q + plant.damping * m.q_rate - load.modal
        return found.axial, -(inertia + drag + elastic) / (plant.shortening * m.q)

    axial, felt = forces(motion, loads)
    is_bent = np.abs(motion.q) > 1e-4
    wanted = np.broadcast_to(axial[..., None], felt.shape)
    np.testing.assert_allclose(felt[is_bent], wanted[is_bent], atol=1e-9 * np.abs(axial).max())


@pytest.mark.parametrize(("assembly", "rho_home_mm"), [("inward", 269.28), ("outward", 130.72)])
def test_both_assemblies_start_where_the_paper_says(assembly, rho_home_mm):
    machine = MACHINE._replace(
        geometry=MACHINE.geometry._replace(joint_angle=np.array(ASSEMBLIES[assembly]))
    )
    _, plant = make("pinned_pinned", machine)
    chain = kinematics.close_chain(plant, HOME_POSE, np.zeros(3))
    np.testing.assert_allclose(chain.rho * 1e3, rho_home_mm, atol=5e-3)
    np.testing.assert_allclose(np.degrees(kinematics.link_angle(chain)), 60, atol=1e-9)
    assert kinematics.chain_status(plant, chain) == status.OK


def test_link_angles_on_the_square():
    _, plant = make("pinned_pinned")
    corners = 0.01 * np.array([[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]])
    part = np.linspace(0, 1, 101)[:, None]
    xy = np.concatenate([a + part * (b - a) for a, b in pairwise(corners)])
    poses = np.column_stack([xy, np.full(len(xy), HOME[2])])

    def beta(pose):
        chain = kinematics.close_chain(plant, pose, jnp.zeros(3))
        return kinematics.link_angle(chain) + MACHINE.geometry.guide_angle

    angle = np.asarray(jax.jit(jax.vmap(beta))(poses)) / np.pi
    np.testing.assert_allclose(angle.min(axis=0), [0.961, 1.651, 1 / 3], atol=5e-4)
    np.testing.assert_allclose(angle.max(axis=0), [1.0, 1.697, 0.3686], atol=5e-4)
    assert kinematics.path_status(plant, poses)[0] == status.OK


# Guide 3 lies along x, so h_3 = 0.1732 m + y + 0.0693 m sin(phi - 30 deg).
LINK_ANGLE_CASES = {  # y [m], phi [deg]
    "home": (0.0, 30.0, status.OK),
    "out of reach": (0.04, 30.0, status.OUT_OF_REACH),
    "perpendicular": (0.2 - 0.3 / 3**0.5 - 1e-9, 30.0, status.SINGULAR),
    "parallel": (-0.18 / 3**0.5, -60.0, status.SINGULAR),
}


@pytest.mark.parametrize("kind", ["pinned_pinned", "pinned_free"])
def test_singular_poses_are_reported_and_keep_gradients_finite(kind):
    _, plant = make(kind)
    poses = np.array([[0, y, np.radians(phi)] for y, phi, _ in LINK_ANGLE_CASES.values()])
    rate, q = np.array([0.1, -0.2, 0.3]), np.full((3, R), 1e-5)
    loads = reference.Loads(np.ones(3), np.ones((3, R)))

    def total(pose):
        motion = reference.RigidState(pose, rate, q, 10 * q)
        found = closed_form(plant, motion, loads)
        return sum(jnp.sum(part) for part in found)

    @jax.jit
    @jax.vmap
    def judge(pose):
        chain = dynamics.modal_chain(plant, pose, rate, 0 * q, q)
        return kinematics.chain_status(plant, chain), *jax.value_and_grad(total)(pose)

    codes, value, gradient = judge(poses)
    np.testing.assert_array_equal(codes, [case[-1] for case in LINK_ANGLE_CASES.values()])
    assert np.isfinite(value).all() and np.isfinite(gradient).all()


def test_path_status_names_the_first_bad_pose():
    _, plant = make("pinned_pinned")
    poses = HOME_POSE + np.linspace(0, 0.04, 41)[:, None] * np.array([0, 1, 0])
    judge = jax.jit(kinematics.path_status)
    code, index = judge(plant, poses)
    # h_3 = 0.1732 m + y reaches sin(gamma) L with cos(gamma) = 0.001 just before 0.2 m
    assert (code, index) == (status.OUT_OF_REACH, 27)
    sound = judge(plant, np.minimum(poses, poses[20]))
    assert (sound[0], sound[1]) == (status.OK, 0)


def test_inverse_kinematics_on_a_time_axis_equals_single_poses():
    _, plant = make("pinned_pinned")
    rng = np.random.default_rng(0)
    pose, rate = HOME_POSE + 0.01 * rng.normal(size=(5, 2, 3)), rng.normal(size=(5, 2, 3))
    rho, rho_rate = kinematics.inverse_kinematics(plant, pose, rate)
    for k in np.ndindex(5, 2):
        chain = kinematics.close_chain(plant, pose[k], rate[k])
        np.testing.assert_allclose(rho[k], chain.rho, rtol=1e-14)
        np.testing.assert_allclose(rho_rate[k], chain.rho_rate, rtol=1e-12)


def test_modal_mass_matrix_of_pinned_free_links_at_rest():
    _basis, plant = make("pinned_free")
    zero, still = jnp.zeros((3, R)), jnp.zeros(3)

    def energy(q_rate):
        q_rate = q_rate.reshape(3, R)
        chain = dynamics.modal_chain(plant, HOME_POSE, still, zero, q_rate)
        return dynamics.kinetic_energy(plant, chain, still, zero, q_rate)

    block = 0.011 * (np.eye(R) / 4 + np.ones((R, R)) / 3)
    mass = jax.jit(jax.hessian(energy))(jnp.zeros(3 * R))
    np.testing.assert_allclose(mass, np.kron(np.eye(3), block), atol=1e-16)


def test_inverse_dynamics_is_the_inverse_of_accelerations_for_rigid_links(states):
    # modes that couple to nothing leave the rigid machine
    _, plant = make("pinned_pinned", mask=0.0)
    motion, _ = states
    wanted = np.random.default_rng(5).normal(size=(N_STATES, 3)) * [5, 5, 30]

    @jax.jit
    @jax.vmap
    def round_trip(pose, rate, acceleration):
        force = dynamics.inverse_dynamics(plant, pose, rate, acceleration)
        still = reference.RigidState(pose, rate, jnp.zeros((3, R)), jnp.zeros((3, R)))
        return closed_form(plant, still, reference.Loads(force, jnp.zeros((3, R)))).pose

    found = round_trip(motion.pose, motion.pose_rate, wanted)
    np.testing.assert_allclose(found, wanted, atol=1e-11 * np.abs(wanted).max())
