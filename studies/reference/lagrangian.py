"""Slow, plain forms of the model, written independently of `jaxmodel` to test it.

Geometry in the plane's own coordinates, kinetic energy from the velocity field of a link,
accelerations from the Lagrangian by automatic differentiation and from the index-3 equations (5)
with multipliers, and the classical Runge-Kutta step. Everything dense, nothing eliminated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxmodel.beam import ModalBasis
from jaxmodel.dynamics import Accelerations, accelerations, modal_chain
from jaxmodel.joints import rub
from jaxmodel.kinematics import Chain
from jaxmodel.mechanisms.carriers import Carrier, Rail
from jaxmodel.parameters import Machine
from jaxmodel.plant import Plant


class RigidState(NamedTuple):
    """State of the reduced machine: free coordinates after the closure (6)."""

    pose: Any  # (3,)
    pose_rate: Any  # (3,)
    q: Any  # (3, R)
    q_rate: Any  # (3, R)


class Loads(NamedTuple):
    """External forces."""

    slider: Any  # on the actuated joints [N], (3,)
    modal: Any  # on the modal coordinates [N], (3, R)


def near_joints(geometry: Any, rho: Any) -> Any:
    """Joints B_i [m] by the actuated coordinates, (n, 2): along rails, or turned by cranks."""

    def joint(carrier: Carrier, rho: Any) -> Any:
        if isinstance(carrier, Rail):
            return carrier.start + rho * carrier.direction
        theta = carrier.zero_angle + carrier.elbow * rho / carrier.length
        return carrier.pivot + carrier.length * jnp.stack([jnp.cos(theta), jnp.sin(theta)])

    carriers = geometry.carriers(0.0, jnp)
    return jnp.stack([joint(carrier, x) for carrier, x in zip(carriers, rho, strict=True)])


def reach(geometry: Any, joints: Any, distance: Any) -> Any:
    """Actuated coordinates that put B_i at a distance from C_i [m], (n,)."""

    def coordinate(carrier: Carrier, joint: Any, distance: Any) -> Any:
        if isinstance(carrier, Rail):
            (x, y), far = carrier.direction, joint - carrier.start
            slant = jnp.arcsin((x * far[1] - y * far[0]) / distance)
            return x * far[0] + y * far[1] - distance * jnp.cos(slant)
        far, a = joint - carrier.pivot, carrier.length
        square = jnp.sum(far**2)
        between = jnp.arccos((square + a**2 - distance**2) / (2 * a * jnp.sqrt(square)))
        turn = jnp.arctan2(far[1], far[0]) - carrier.elbow * between - carrier.zero_angle
        return carrier.elbow * a * jnp.arctan2(jnp.sin(turn), jnp.cos(turn))

    legs = zip(geometry.carriers(0.0, jnp), joints, distance, strict=True)
    return jnp.stack([coordinate(*leg) for leg in legs])


def platform_joints(geometry: Any, pose: jax.Array) -> jax.Array:
    """Joints C_i [m] of the platform, (n, 2)."""
    arms = geometry.arms()
    if arms is None:
        return jnp.stack([pose] * len(pose))  # as many links meet in it
    arm = jnp.stack(arms, axis=1)
    turned = jnp.stack([-arm[:, 1], arm[:, 0]], axis=1)
    return pose[:2] + jnp.cos(pose[2]) * arm + jnp.sin(pose[2]) * turned


def payload_energy(masses: Any, pose: jax.Array, pose_rate: jax.Array) -> Any:
    """T [J] of the payload from the velocity of its centre of mass."""
    offset = jnp.zeros(2) if masses.payload_offset is None else jnp.asarray(masses.payload_offset)

    def center(pose: jax.Array) -> Any:
        cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
        return pose[:2] + jnp.array([[cosine, -sine], [sine, cosine]]) @ offset

    velocity = jax.jvp(center, (pose,), (pose_rate,))[1]
    turning = masses.payload_inertia * pose_rate[2] ** 2
    return (masses.payload_mass * jnp.sum(velocity**2) + turning) / 2


def tip_deflection(basis: ModalBasis, q: jax.Array) -> Any:
    """w = sum Y_j(L) q_j [m], (3,)."""
    return jnp.zeros(len(q)) if basis.tip is None else jnp.sum(basis.tip * q, axis=1)


def chord_length(machine: Machine, basis: ModalBasis, q: jax.Array) -> Any:
    """c = L - 1/2 q^t S q + e [m], (3,): a bent link's ends are closer."""
    length = jnp.broadcast_to(machine.beam.length, (len(q),))
    if basis.stretch is not None:
        length = length + basis.stretch * q[:, -1]
    if basis.shortening is None:
        return length
    slopes = jax.vmap(jnp.diag)(jnp.asarray(basis.shortening))
    if basis.mixed_shortening is not None:
        slopes = slopes + basis.mixed_shortening
    return length - jnp.einsum("ij,ijk,ik->i", q, slopes, q) / 2


def first_moment(machine: Machine, basis: ModalBasis, q: jax.Array) -> Any:
    """int rhoA (x - s) dx [kg m], (3,), s(x) the inward motion; lumped, C's share of it alone."""
    if basis.inward is None:
        length = jnp.broadcast_to(machine.beam.length, (len(q),))
        return basis.first_moment / length * chord_length(machine, basis, q)
    moment = basis.first_moment - jnp.einsum("ij,ijk,ik->i", q, basis.inward, q) / 2
    if basis.stretch is None:
        return moment
    return moment + basis.first_moment / machine.beam.length * basis.stretch * q[:, -1]


def moment_of_inertia(basis: ModalBasis, q: jax.Array) -> Any:
    """int rhoA (x^2 - 2 x s) dx [kg m2], (3,); lumped, that of the straight link."""
    if basis.centrifugal is None:
        return basis.inertia
    return basis.inertia - jnp.einsum("ij,ijk,ik->i", q, basis.centrifugal, q)


def link_tips(machine: Machine, basis: ModalBasis, rho: jax.Array, beta: Any, q: jax.Array) -> Any:
    """Joints C_i [m] from near joint and bent link, (n, 2)."""
    along = jnp.stack([jnp.cos(beta), jnp.sin(beta)], axis=1)
    across = jnp.stack([-jnp.sin(beta), jnp.cos(beta)], axis=1)
    tip, chord = tip_deflection(basis, q), chord_length(machine, basis, q)
    near = near_joints(machine.geometry, rho)
    return near + chord[:, None] * along + tip[:, None] * across


def close(machine: Machine, basis: ModalBasis, pose: jax.Array, q: jax.Array) -> Any:
    """(rho [m], beta [rad]), (n,) each, from the triangle of near joint, far joint and path."""
    joints = platform_joints(machine.geometry, pose)
    tip, length = tip_deflection(basis, q), chord_length(machine, basis, q)
    rho = reach(machine.geometry, joints, jnp.sqrt(length**2 + tip**2))
    link = joints - near_joints(machine.geometry, rho)
    return rho, jnp.arctan2(link[:, 1], link[:, 0]) - jnp.arctan2(tip, length)


def joint_angles(machine: Machine, basis: ModalBasis, pose: Any, q: Any) -> Any:
    """Angles of the links' ends from what they are pinned to [rad], near and far, (2, n)."""
    rho, beta = close(machine, basis, pose, q)
    near, far = (beta + jnp.sum(slope * q, axis=1) for slope in jnp.moveaxis(basis.end_slope, 2, 0))
    carriers = machine.geometry.carriers(0.0, jnp)
    cranks = [0.0 if isinstance(x, Rail) else x.elbow / x.length for x in carriers]
    return jnp.stack(
        [
            near - jnp.asarray(cranks) * rho,
            far - (jnp.mean(far) if len(pose) == 2 else pose[2]),
        ]
    )


def kinetic_energy(
    machine: Machine,
    basis: ModalBasis,
    joints: tuple[Any, Any],
    pose: jax.Array,
    q: jax.Array,
    joint_rates: tuple[Any, Any],
    pose_rate: jax.Array,
    q_rate: jax.Array,
) -> Any:
    """T [J] from the velocity a + x b + sum_j Y_j(x) c_j of the points of a link.

    Bending moves a point inwards along the chord; squares of that motion's speed are neglected.
    `joints` are (rho, beta).
    """
    (rho, beta), (rho_rate, beta_rate) = joints, joint_rates
    along = jnp.stack([jnp.cos(beta), jnp.sin(beta)], axis=1)
    across = jnp.stack([-jnp.sin(beta), jnp.cos(beta)], axis=1)
    a = jax.jvp(lambda rho: near_joints(machine.geometry, rho), (rho,), (rho_rate,))[1]
    b = beta_rate[:, None] * across
    turning = beta_rate[:, None] * q
    c = q_rate[:, :, None] * across[:, None] - turning[:, :, None] * along[:, None]
    a_dot_c = jnp.einsum("id,ijd->ij", a, c)
    b_dot_c = jnp.einsum("id,ijd->ij", b, c)
    moment, moving = jax.jvp(lambda q: first_moment(machine, basis, q), (q,), (q_rate,))
    links = (
        (basis.link_mass + machine.masses.slider_mass) * jnp.sum(a * a, axis=1)
        + moment_of_inertia(basis, q) * jnp.sum(b * b, axis=1)
        + 2 * jnp.sum(a * (moment[:, None] * b + moving[:, None] * along), axis=1)
        + jnp.sum(basis.mass * jnp.sum(c * c, axis=2), axis=1)
        + 2 * jnp.sum(basis.b * a_dot_c + basis.c * b_dot_c, axis=1)
    )
    masses = machine.masses
    platform = masses.platform_mass * jnp.sum(pose_rate[:2] ** 2)
    if len(pose) == 2:  # a point
        return (jnp.sum(links) + platform) / 2
    platform = platform + masses.platform_inertia * pose_rate[2] ** 2
    return (jnp.sum(links) + platform) / 2 + payload_energy(masses, pose, pose_rate)


def modal_load(
    machine: Machine, basis: ModalBasis, q: jax.Array, q_rate: jax.Array, force: Any
) -> Any:
    """Generalised forces of the modes: actuators, structural damping and stiffness, (3, R)."""
    damping = 2 * machine.damping.ratio * jnp.sqrt(basis.stiffness * basis.mass)
    return force - damping * q_rate - basis.stiffness * q


def inertia(energy: Any, z: Any, z_rate: Any) -> Any:
    """Mass matrix and velocity terms of d/dt dT/dz' - dT/dz."""
    mass = jax.hessian(energy, 1)(z, z_rate)
    change = jax.jvp(lambda at: jax.grad(energy, 1)(at, z_rate), (z,), (z_rate,))[1]
    return mass, change - jax.grad(energy)(z, z_rate)


def closed_form(plant: Plant, motion: RigidState, loads: Loads) -> tuple[Chain, Accelerations]:
    """What the forms below are compared with: `jaxmodel.dynamics` at the same state."""
    chain = modal_chain(plant, *motion)
    force, modal = loads.slider, loads.modal / plant.modal_mass[:, None]
    wrench = torque = None
    if plant.joint_friction is not None:
        rates = motion.pose_rate, motion.q_rate
        force, modal, wrench, torque = rub(plant, chain, rates, force, modal, None)
    found = accelerations(plant, chain, *motion[1:], force, modal, wrench, torque=torque)
    return chain, found


def by_lagrangian(machine: Machine, basis: ModalBasis, motion: RigidState, loads: Loads) -> Any:
    """Accelerations (X'' (3,), q'' (3, R)) from the Lagrangian in (X, q)."""
    shape, n = motion.q.shape, len(motion.pose)

    def split(z: Any) -> Any:
        return z[:n], z[n:].reshape(shape)

    def joint_coordinates(z: Any) -> Any:
        return close(machine, basis, *split(z))

    def energy(z: Any, z_rate: Any) -> Any:
        (pose, q), (pose_rate, q_rate) = split(z), split(z_rate)
        joints, rates = jax.jvp(joint_coordinates, (z,), (z_rate,))
        return kinetic_energy(machine, basis, joints, pose, q, rates, pose_rate, q_rate)

    z = jnp.concatenate([motion.pose, motion.q.ravel()])
    z_rate = jnp.concatenate([motion.pose_rate, motion.q_rate.ravel()])
    mass, inertial = inertia(energy, z, z_rate)
    on_modes = modal_load(machine, basis, motion.q, motion.q_rate, loads.modal)
    load = jnp.concatenate([jnp.zeros(n), on_modes.ravel()])
    load = load + jax.jacfwd(lambda z: joint_coordinates(z)[0])(z).T @ loads.slider
    turns = jax.jacfwd(lambda z: joint_angles(machine, basis, *split(z)))(z)
    rubbing = jnp.tanh(turns @ z_rate / machine.joint_friction_speed)
    load = load - machine.joint_friction * jnp.einsum("eiz,ei->z", turns, rubbing)
    return split(jnp.linalg.solve(mass, load - inertial))


def rk4_step(derivative: Any, state: Any, step: Any, inputs: Any) -> Any:
    """One classical Runge-Kutta step; `inputs` at start, middle and end."""

    def along(slope: Any, length: Any) -> Any:
        return jax.tree.map(lambda x, dx: x + length * dx, state, slope)

    start, middle, end = inputs
    k1 = derivative(state, start)
    k2 = derivative(along(k1, step / 2), middle)
    k3 = derivative(along(k2, step / 2), middle)
    k4 = derivative(along(k3, step), end)
    return jax.tree.map(
        lambda x, a, b, c, d: x + step / 6 * (a + 2 * b + 2 * c + d), state, k1, k2, k3, k4
    )
