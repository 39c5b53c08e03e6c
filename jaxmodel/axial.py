"""Axial forces in the links: how they change bending, and how much they stretch the links.

A tension N stiffens bending, f_j = f_j0 sqrt(1 + N/(j^2 N_cr)) for a uniform link, and at N = -N_cr
the link buckles; N_cr = pi^2 EI/L^2. The dynamics has this through the shortening of the chord. The
links do not stretch there; `stretch_error` gives how far stretching would move the platform.
"""

from __future__ import annotations

from jaxmodel.beam import ModalBasis
from jaxmodel.dynamics import accelerations, inverse_dynamics, straight_motion
from jaxmodel.kinematics import Chain, close_chain
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Machine
from jaxmodel.piezo import bare_stiffness
from jaxmodel.plant import Plant, shortening_matrix, unlumped

#: Squarings of `critical_force`: eigenvalues that differ by 1 % are resolved.
SQUARINGS = 12


def critical_force(plant: Plant) -> Array:
    """N_cr, the smallest compression at which K - N S is singular [N], (3,).

    Infinite where the chord keeps its length.
    """
    if plant.shortening is None:
        return jnp.full(plant.length.shape, jnp.inf)
    stiffness = plant.stiffness[:, : plant.shortening.shape[1]]
    if plant.mixed_shortening is None:
        return jnp.min(stiffness / plant.shortening, axis=1)
    scale = 1 / jnp.sqrt(stiffness)
    softness = scale[:, :, None] * chord_slopes(plant) * scale[:, None, :]

    def square(power: Array, _: None) -> tuple[Array, None]:
        power = power @ power
        return power / jnp.trace(power, axis1=1, axis2=2)[:, None, None], None

    # its largest eigenvalue by repeated squaring: batched on every executor
    power, _ = jax.lax.scan(square, softness, None, length=SQUARINGS)
    return 1 / jnp.trace(power @ softness, axis1=1, axis2=2)


def euler_force(machine: Machine) -> Array:
    """N_cr of the bare links, pi^2 E I/L^2 [N], (n,): a bound if the model has no buckling."""
    beam = machine.beam
    force = jnp.pi**2 * bare_stiffness(beam) * beam.stiffness_factor / beam.length**2
    return jnp.broadcast_to(jnp.asarray(force), (machine.n_links,))


def chord_slopes(plant: Plant) -> Array:
    """S as a matrix [1/m], (3, R, R): what an axial force of 1 N adds to the stiffness.

    Zero where the chord keeps its length; -tau tau^t/L where modes move their ends by tau along the
    normal of their frame, which makes the chord longer.
    """
    if plant.tip is not None:
        return -plant.tip[:, :, None] * plant.tip[:, None] / plant.length[:, None, None]
    if plant.shortening is None:
        return jnp.zeros((*plant.stiffness.shape, plant.stiffness.shape[1]))
    return shortening_matrix(plant.shortening, plant.mixed_shortening)


def axial_force(
    plant: Plant, pose: Array, pose_rate: Array, pose_acc: Array, wrench: Array | None = None
) -> Array:
    """Tension at mid-span of straight links in a prescribed motion [N], (3,).

    Args:
        plant: the machine.
        pose: (3,) [m, m, rad].
        pose_rate: (3,).
        pose_acc: (3,).
        wrench: force and moment on the platform [N, N, N m], (3,), or None.
    """
    still = jnp.zeros_like(plant.b)
    force = inverse_dynamics(plant, pose, pose_rate, pose_acc, wrench)
    chain = close_chain(plant, pose, pose_rate)
    bent = still, still, force, still
    return accelerations(plant, chain, pose_rate, *bent, wrench, is_coupled=False).axial


def held_coordinates(plant: Plant, force: Array) -> Array:
    """Coordinates of straight links that lengthen under tensions [m], (3, R + 1).

    Args:
        plant: whose links lengthen.
        force: N [N], (3,).
    """
    assert plant.stretch is not None
    still = jnp.zeros_like(plant.stiffness)
    return still.at[:, -1].set(plant.stretch * force / plant.stiffness[:, -1])


def lumping_error(
    plant: Plant, basis: ModalBasis, pose: Array, pose_rate: Array, pose_acc: Array
) -> Array:
    """Share of a deflection in mode 1 that lumping the axial inertia costs [1], (3,).

    A link bent by q_1 answers to the forces ((P - mu S) rho'' cos gamma - Q gamma'^2) q_1 that the
    lumped model leaves out by their share of the modal stiffnesses; the largest one.

    Args:
        plant: the machine, with lumped inertia.
        basis: its modal basis.
        pose: (3,) [m, m, rad].
        pose_rate: (3,).
        pose_acc: (3,).
    """
    left_out = None if plant.shortening is None else unlumped(basis, plant.length)
    if left_out is None or basis.centrifugal is None:
        return jnp.zeros_like(plant.length)
    chain = close_chain(plant, pose, pose_rate)
    slide = chain.cosine * straight_motion(chain, pose_rate, pose_acc)[0]
    if chain.turning is not None:
        slide = slide + chain.sine * chain.turning
    force = (
        left_out[:, :, 0] * slide[:, None]
        - basis.centrifugal[:, :, 0] * chain.beta_rate[:, None] ** 2
    )
    return jnp.max(jnp.abs(force) / basis.stiffness, axis=1)


def axial_compliance(machine: Machine) -> Array:
    """L/(E A) of the bare links [m/N], (n,)."""
    beam = machine.beam
    section = jnp.asarray(beam.youngs_modulus) * beam.width * beam.thickness
    return jnp.broadcast_to(beam.length / section, (machine.n_links,))


def stretch_error(chain: Chain, stretch: Array) -> Array:
    """Platform displacement by stretching links while the near joints stay put, (n,).

    Each joint C moves by the stretch along its link: t.J X = stretch, as many equations for X.

    Args:
        chain: at this pose.
        stretch: N L/(E A) of each link [m], (3,).
    """
    frame = chain.frame
    is_turned = chain.bend.tip is not None  # f = -n_t, g = t
    x, y = (-frame.y, frame.x) if is_turned else (frame.x, frame.y)
    if frame.c_f is None or frame.c_g is None:
        over = 1 / (x[0] * y[1] - x[1] * y[0])
        return over * jnp.stack(
            [y[1] * stretch[0] - y[0] * stretch[1], x[0] * stretch[1] - x[1] * stretch[0]]
        )
    turn = frame.c_f if is_turned else -frame.c_g
    cross = (
        y[1] * turn[2] - y[2] * turn[1],
        y[2] * turn[0] - y[0] * turn[2],
        y[0] * turn[1] - y[1] * turn[0],
    )
    over = 1 / (x[0] * cross[0] + x[1] * cross[1] + x[2] * cross[2])
    return over * jnp.stack(
        [
            stretch[0] * cross[0] + stretch[1] * cross[1] + stretch[2] * cross[2],
            stretch[0] * (turn[1] * x[2] - turn[2] * x[1])
            + stretch[1] * (turn[2] * x[0] - turn[0] * x[2])
            + stretch[2] * (turn[0] * x[1] - turn[1] * x[0]),
            stretch[0] * (x[1] * y[2] - x[2] * y[1])
            + stretch[1] * (x[2] * y[0] - x[0] * y[2])
            + stretch[2] * (x[0] * y[1] - x[1] * y[0]),
        ]
    )
