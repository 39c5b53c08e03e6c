"""Dynamics against the multiplier form, its energies and the paper's geometry."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import dynamics, kinematics, status
from jaxmodel.defaults import HOME
from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from studies.reference import lagrangian as reference
from tests.forms import (
    MACHINE,
    R,
    by_lagrangian,
    check_multipliers,
    check_rows,
    closed_form,
    general,
    lanes_last,
    make,
    one_lane,
)

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


@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_accelerations_equal_multiplier_form(kind, shortening, states):
    basis, plant = make(kind, shortening=shortening)
    _, found = check_multipliers(MACHINE, basis, plant, *states)
    oscillator = plant.stiffness * states[0].q + plant.damping * states[0].q_rate
    oscillator = oscillator / plant.modal_mass[:, None]
    np.testing.assert_allclose(
        found.coupling, found.modal + oscillator, atol=1e-12 * np.abs(oscillator).max()
    )
    if basis.tip is not None:  # the states do bend the chord away from the tangent
        assert np.abs(np.sum(basis.tip * states[0].q, axis=2)).max(axis=1).min() > 1e-4


@pytest.mark.long  # in short: of ten other machines, in test_machines
@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_accelerations_equal_lagrangian(kind, shortening, states):
    basis, plant = make(kind, shortening=shortening)
    _, found = closed_form(one_lane(plant), *states)
    check_rows((found.pose, found.modal), by_lagrangian(MACHINE, basis, *states))


@pytest.mark.parametrize("kind", ["pinned_pinned", "pinned_free"])
def test_kinetic_energy_equals_quadrature_over_the_link(kind, states):
    """Of links whose chord keeps its length: the share of the shortening is approximate."""
    node, weight = np.polynomial.legendre.leggauss(24)
    length = MACHINE.beam.length
    x, share = length * (node + 1) / 2, weight / 2
    basis, plant = make(kind, stations=x, shortening="none")
    tip = 0.0 if basis.tip is None else basis.tip[0]
    shape = basis.deflection_at[0] + (x / length)[:, None] * tip
    wanted = energy_of_points(general(MACHINE, basis), x, shape, share, states[0])
    np.testing.assert_allclose(kinetic_energy(plant, states[0]), wanted, rtol=1e-12)


@jax.jit
@partial(jax.vmap, in_axes=(None, None, None, None, 0))
def energy_of_points(basis, x, shape, share, m):
    """By quadrature of the velocities of points, of shapes (points, R)."""

    def points(pose, q):
        """Points of the links in the plane, their sliders, (3, points, 2) and (3, 2)."""
        rho, beta = reference.close(MACHINE, basis, pose, q)
        along = jnp.stack([jnp.cos(beta), jnp.sin(beta)], axis=1)[:, None]
        across = jnp.stack([-jnp.sin(beta), jnp.cos(beta)], axis=1)[:, None]
        slider = reference.near_joints(MACHINE.geometry, rho)
        return slider[:, None] + x[:, None] * along + (q @ shape.T)[:, :, None] * across, slider

    velocity, slider = jax.jvp(points, (m.pose, m.q), (m.pose_rate, m.q_rate))[1]
    links = 0.011 * jnp.sum(share * jnp.sum(velocity**2, axis=2))
    rigid = 0.15 * jnp.sum(slider**2) + 0.25 * jnp.sum(m.pose_rate[:2] ** 2)
    return (links + rigid + 3e-4 * m.pose_rate[2] ** 2) / 2


def kinetic_energy(plant, motion):
    """In closed form, of every state."""
    plant, m = one_lane(plant), lanes_last(motion)
    chain = dynamics.modal_chain(plant, *m)
    return dynamics.kinetic_energy(plant, chain, m.pose_rate, m.q, m.q_rate)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def energy_of_velocities(basis, m):
    joints, rates = jax.jvp(
        partial(reference.close, MACHINE, basis), (m.pose, m.q), (m.pose_rate, m.q_rate)
    )
    return reference.kinetic_energy(
        MACHINE, basis, joints, m.pose, m.q, rates, m.pose_rate, m.q_rate
    )


@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_kinetic_energy_is_that_of_the_lagrangian(kind, shortening, states):
    """With the chord's shortening, too."""
    basis, plant = make(kind, shortening=shortening)
    wanted = energy_of_velocities(general(MACHINE, basis), states[0])
    np.testing.assert_allclose(kinetic_energy(plant, states[0]), wanted, rtol=1e-11)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0, 0))
def both_ways(basis, m, rho, beta):
    """Rates of near joints and links, and gaps between both ways to the far joints."""
    close = partial(reference.close, MACHINE, basis)
    rates = jax.jvp(close, (m.pose, m.q), (m.pose_rate, m.q_rate))[1]
    tips = reference.link_tips(MACHINE, basis, rho, beta, m.q)
    return rates, tips - reference.platform_joints(MACHINE.geometry, m.pose)


def closure_residual(chain, gamma):
    """Of (6) [m], (2, 3): C from the platform less C from the slider and the bent link."""
    tip = 0.0 if chain.bend.tip is None else chain.bend.tip
    along = chain.chord * jnp.cos(gamma) - tip * jnp.sin(gamma)
    across = chain.chord * jnp.sin(gamma) + tip * jnp.cos(gamma)
    return jnp.stack([chain.near.root - along, chain.near.across - across])


@pytest.mark.parametrize("kind", ["pinned_pinned", "pinned_free"])
def test_closure_holds_to_rounding_along_a_random_motion(kind):
    basis, plant = make(kind)
    rng = np.random.default_rng(3)
    frequency, phase = rng.uniform(5, 200, 12), rng.uniform(0, 2 * np.pi, 12)
    amplitude = np.r_[0.012, 0.012, 0.06, np.full(9, 1e-3)]
    angle = frequency * np.linspace(0, 1, N_STATES)[:, None] + phase
    z, z_rate = amplitude * np.sin(angle), amplitude * frequency * np.cos(angle)
    pose, q = HOME_POSE + z[:, :3], z[:, 3:].reshape(-1, 3, R)
    m = reference.RigidState(pose, z_rate[:, :3], q, z_rate[:, 3:].reshape(-1, 3, R))
    chain = dynamics.modal_chain(one_lane(plant), *lanes_last(m))
    rho, beta = np.asarray(chain.rho).T, np.asarray(kinematics.link_direction(chain)).T
    (rho_rate, beta_rate), outside = both_ways(general(MACHINE, basis), m, rho, beta)
    own = closure_residual(chain, kinematics.link_angle(chain))
    assert np.abs(outside).max() < 5e-16  # [m]: a few roundings of 0.3 m
    assert np.abs(own).max() < 5e-16
    assert np.abs(chain.rho_rate.T - rho_rate).max() < 1e-13
    assert np.abs(chain.beta_rate.T - beta_rate).max() < 1e-12


def test_a_dropped_term_of_the_shortening_would_be_noticed(states):
    """The comparison must fail for a model without the mass that moves in."""
    basis, plant = make("pinned_pinned")
    still = plant._replace(tip_mass=plant.tip_mass * (1 - 1e-6))
    with pytest.raises(AssertionError):
        check_multipliers(MACHINE, basis, still, *states)


def test_axial_force_is_the_one_that_bending_feels(states):
    """N from the equation of a mode equals N from the equilibrium of joint and slider."""
    _, plant = make("pinned_pinned")
    motion, load = states
    chain, found = closed_form(one_lane(plant), motion, load)
    rate2, mass = chain.beta_rate[..., None] ** 2, plant.modal_mass[:, None]
    drag = plant.c * found.beta[..., None] - plant.b * (chain.sine * found.rho)[..., None]
    elastic = plant.stiffness * motion.q + plant.damping * motion.q_rate - load.modal
    inertia = mass * (found.modal - motion.q * rate2)
    felt = -(inertia + drag + elastic) / (plant.shortening * motion.q)
    is_bent = np.abs(motion.q) > 1e-4
    wanted = np.broadcast_to(found.axial[..., None], felt.shape)
    np.testing.assert_allclose(felt[is_bent], wanted[is_bent], atol=1e-9 * np.abs(wanted).max())


def test_ked_bends_links_by_the_rigid_motion_alone(states):
    """Links of a machine too heavy to feel them bend alike in both models."""

    def both(plant, motion, force):
        """Accelerations of both models."""
        lanes, m = one_lane(plant), lanes_last(motion)
        straight = kinematics.close_chain(lanes, m.pose, m.pose_rate)
        loads = m.pose_rate, m.q, m.q_rate, force, lanes_last(states[1].modal)
        coupled = dynamics.accelerations(lanes, dynamics.modal_chain(lanes, *m), *loads)
        return dynamics.accelerations(lanes, straight, *loads, is_coupled=False), coupled

    _, plant = make("pinned_pinned", shortening="none")
    motion, force = states[0], lanes_last(states[1].slider)
    ked, coupled = both(plant, motion, force)
    assert np.abs(ked.pose - coupled.pose).max() > 0.01 * np.abs(coupled.pose).max()
    heavy = plant._replace(
        slider_link_mass=plant.slider_link_mass + 1e5, platform_mass=1e5, platform_inertia=1e2
    )
    ked, coupled = both(heavy, motion, 1e5 * force)
    for name in ("pose", "modal", "axial"):
        mine, wanted = (np.asarray(getattr(x, name)) for x in (ked, coupled))
        np.testing.assert_allclose(mine, wanted, atol=1e-4 * np.abs(wanted).max(), err_msg=name)
    # chords that shorten are bent by the axial force of that motion, too
    _, plant = make("pinned_pinned")
    shorter, _ = both(plant, motion, force)
    ked, _ = both(plant._replace(shortening=None), motion, force)
    np.testing.assert_allclose(shorter.axial, ked.axial, rtol=1e-12)
    pull = one_lane(plant.shortening) * lanes_last(motion.q) * np.asarray(ked.axial)[:, None]
    wanted = ked.modal - pull / plant.modal_mass[:, None, None]
    np.testing.assert_allclose(shorter.modal, wanted, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(("assembly", "rho_home_mm"), [("inward", 269.28), ("outward", 130.72)])
def test_both_assemblies_start_where_the_paper_says(assembly, rho_home_mm):
    machine = MACHINE._replace(
        geometry=MACHINE.geometry._replace(joint_angle=np.array(ASSEMBLIES[assembly]))
    )
    _, plant = make("pinned_pinned", machine)
    poses = np.tile(HOME_POSE[:, None], N_STATES)
    plant = one_lane(plant)
    chain = kinematics.close_chain(plant, poses, 0 * poses)
    np.testing.assert_allclose(chain.rho * 1e3, rho_home_mm, atol=5e-3)
    np.testing.assert_allclose(np.degrees(kinematics.link_angle(chain)), 60, atol=1e-9)
    assert np.all(kinematics.chain_status(plant, chain) == status.OK)


def test_link_angles_on_the_square():
    _, plant = make("pinned_pinned")
    corners = 0.01 * np.array([[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]])
    part = np.linspace(0, 1, N_STATES // 4)[:, None]
    xy = np.concatenate([a + part * (b - a) for a, b in pairwise(corners)])
    poses = np.column_stack([xy, np.full(len(xy), HOME[2])])
    chain = kinematics.close_chain(one_lane(plant), poses.T, np.zeros_like(poses.T))
    beta = np.asarray(kinematics.link_angle(chain)) + MACHINE.geometry.guide_angle[:, None]
    angle = beta / np.pi
    np.testing.assert_allclose(angle.min(axis=1), [0.961, 1.651, 1 / 3], atol=5e-4)
    np.testing.assert_allclose(angle.max(axis=1), [1.0, 1.697, 0.3686], atol=5e-4)
    assert path_status(plant, poses)[0] == status.OK


path_status = jax.jit(kinematics.path_status)


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
        found = reference.closed_form(plant, motion, loads)[1]
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
    poses = HOME_POSE + np.linspace(0, 0.04, N_STATES)[:, None] * np.array([0, 1, 0])
    code, index = path_status(plant, poses)
    # h_3 = 0.1732 m + y reaches sin(gamma) L with cos(gamma) = 0.001 just before 0.2 m
    assert (code, index) == (status.OUT_OF_REACH, 67)
    sound = path_status(plant, np.minimum(poses, poses[50]))
    assert (sound[0], sound[1]) == (status.OK, 0)


def test_inverse_kinematics_on_a_time_axis_equals_single_poses():
    _, plant = make("pinned_pinned")
    rng = np.random.default_rng(0)
    pose, rate = HOME_POSE + 0.01 * rng.normal(size=(50, 2, 3)), rng.normal(size=(50, 2, 3))
    rho, rho_rate = jax.jit(kinematics.inverse_kinematics)(plant, pose, rate)
    lanes = (np.moveaxis(x.reshape(N_STATES, 3), 0, -1) for x in (pose, rate))
    chain = kinematics.close_chain(one_lane(plant), *lanes)
    np.testing.assert_allclose(rho.reshape(N_STATES, 3), chain.rho.T, rtol=1e-14)
    np.testing.assert_allclose(rho_rate.reshape(N_STATES, 3), chain.rho_rate.T, rtol=1e-12)


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

    force = jax.jit(jax.vmap(partial(dynamics.inverse_dynamics, plant)))
    loads = reference.Loads(force(motion.pose, motion.pose_rate, wanted), np.zeros_like(motion.q))
    still = motion._replace(q=0 * motion.q, q_rate=0 * motion.q)
    found = closed_form(one_lane(plant), still, loads)[1].pose
    np.testing.assert_allclose(found, wanted, atol=1e-11 * np.abs(wanted).max())
