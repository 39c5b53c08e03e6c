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


def joint_forces(
    plant: Plant, chain: Chain, pose_rate: Array, q_rate: Array
) -> tuple[Array, Array, Array, Array]:
    """Generalised forces of the joints' friction; arguments as for `joint_rates`.

    Returns:
        on the actuated joints [N], on the links' angles [N m], (3,) each; on the modes over the
        modal mass [m/s2], (3, R); and on the platform [N, N, N m], (3,).
    """
    assert plant.joint_friction is not None
    torque, speed, at_near, at_far = plant.joint_friction
    near, far = (
        -torque * jnp.tanh(rate / speed) for rate in joint_rates(plant, chain, pose_rate, q_rate)
    )
    curvature, still = chain.near.curvature, jnp.zeros_like(pose_rate)
    return (
        jnp.zeros_like(near) if curvature is None else -curvature * near,
        near + far,
        (near[:, None] * at_near + far[:, None] * at_far) / plant.modal_mass[:, None],
        still if chain.turn is None else jnp.stack([*still[:2], -jnp.sum(far, axis=0)]),
    )


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
