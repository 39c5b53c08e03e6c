"""Pin joints that rub: Coulomb torques at both ends of every link.

A joint resists with T tanh(omega/v), omega the rate at which the link's end, its chord's rate and
its slope's, turns against the body that it is pinned to. Their power, -T omega tanh(omega/v), gives
the generalised forces.
"""

from __future__ import annotations

from jaxmodel.kinematics import Chain
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array
from jaxmodel.plant import Plant


def joint_rates(plant: Plant, chain: Chain, pose_rate: Array, q_rate: Array) -> tuple[Array, Array]:
    """Rates at which the near and the far end of each link turn in its joints [rad/s], (3,) each.

    Args:
        plant: the machine, with `joint_friction`.
        chain: closure at this state.
        pose_rate: (3,).
        q_rate: [m/s], (3, R).
    """
    assert plant.joint_friction is not None
    near, far = (
        chain.beta_rate + jnp.sum(slope * q_rate, axis=1) for slope in plant.joint_friction[2:]
    )
    if chain.near.curvature is not None:  # a crank turns as its end moves
        near = near - chain.near.curvature * chain.rho_rate
    # the two links of a point share one pin, which turns half as much as they do
    far = far - (jnp.mean(far, axis=0) if chain.turn is None else pose_rate[2])
    return near, far


def rub(
    plant: Plant,
    chain: Chain,
    rates: tuple[Array, Array],
    force: Array,
    piezo: Array,
    wrench: Array | None,
) -> tuple[Array, Array, Array | None, Array]:
    """Forces as `accelerations` takes them, with those of the joints' friction.

    Args:
        plant: the machine, with `joint_friction`.
        chain: closure at this state.
        rates: of pose and modal coordinates, (3,) and (3, R).
        force: on the actuated joints [N], (3,).
        piezo: on the modes over the modal mass [m/s2], (3, R).
        wrench: on the platform [N, N, N m], (3,), or None.

    Returns:
        force, piezo and wrench, and the torques on the links [N m], (3,).
    """
    assert plant.joint_friction is not None
    torque, speed, at_near, at_far = plant.joint_friction
    near, far = (-torque * jnp.tanh(rate / speed) for rate in joint_rates(plant, chain, *rates))
    if chain.near.curvature is not None:
        force = force - chain.near.curvature * near
    on_modes = near[:, None] * at_near + far[:, None] * at_far
    if chain.turn is not None:
        still = jnp.zeros_like(force) if wrench is None else wrench
        wrench = jnp.stack([still[0], still[1], still[2] - jnp.sum(far, axis=0)])
    return force, piezo + on_modes / plant.modal_mass[:, None], wrench, near + far


def joint_decay(plant: Plant) -> Array:
    """Fastest decay of a link between held ends by friction at rest, its steepest [1/s], ()."""
    if plant.joint_friction is None:
        return jnp.zeros(())
    torque, speed, *slopes = plant.joint_friction
    near, both, far = (
        jnp.sum(x * y, axis=1) / plant.modal_mass
        for x, y in ((slopes[0], slopes[0]), (slopes[0], slopes[1]), (slopes[1], slopes[1]))
    )
    largest = (near + far) / 2 + jnp.hypot((near - far) / 2, both)
    return jnp.max(torque / speed * largest)
