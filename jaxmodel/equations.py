"""Equations of motion as in the paper: M, C, K of (7), and the lumped forces of (8)-(9)."""

from __future__ import annotations

import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.checks import check_shape
from jaxmodel.dynamics import accelerations, inverse_dynamics, modal_chain
from jaxmodel.kinematics import inverse_kinematics
from jaxmodel.lazy import compiled, jax, jnp
from jaxmodel.linear import known_pose, linearise, mass_and_stiffness, places_and_rates
from jaxmodel.parameters import Array
from jaxmodel.plant import Plant
from jaxmodel.prepare import prepare


@compiled("structure", "has_drive")
def equations_of_motion(
    structure: Structure, case: Case, pose: Array, has_drive: bool = False
) -> tuple[Array, Array, Array, Array, Array]:
    """M, C, K, F, V of (7): M x'' + C x' + K x = F f + V v, small motions about rest at a pose.

    x = (X, q), the coordinates of all links one after the other; f on the actuated joints [N], v on
    the actuators [V].

    Args:
        structure: static choices; its feedback is left out.
        case: the numbers.
        pose: (x, y, phi) [m, m, rad], (3,).
        has_drive: with stiffness and damping of the drives' own loops (static).

    Returns:
        M [kg and mixed], C [N s/m and mixed], K [N/m and mixed], (n, n) each, F [1 and m], (n, l),
        V [N/V and N m/V], (n, l K). All NaN where the pose is out of reach or singular, or patches
        overlap or leave their link.

    Example:
        >>> M, C, K, F, V = equations_of_motion(*paper_case({"link.modes": 2}), HOME)
        >>> M.shape, V.shape
        ((12, 12), (12, 9))
    """
    check_shape("pose", pose, (structure.n_pose,))
    free = structure._replace(feedback="none")
    loop = prepare(free, case).loop
    pose = known_pose(loop.plant, case, pose)
    plant = linearise(free, loop, pose, is_held=not has_drive)
    mass, stiffness = mass_and_stiffness(loop, pose, plant)
    _, rates = places_and_rates(plant)
    damping = -mass @ plant.state[np.ix_(rates, rates)]
    return mass, damping, stiffness, mass @ plant.force[rates], mass @ plant.voltage[rates]


@compiled()
def lumped_forces(
    plant: Plant,
    pose: Array,
    pose_rate: Array,
    q: Array,
    q_rate: Array,
    slider_force: Array,
    modal_force: Array,
) -> tuple[Array, Array]:
    """T_d and t_d, the lumped disturbances of (8) and (9), at a state of the nonlinear machine.

    t_d = M_ff q'' + K_f q - F_PZT, and T_d = J_p^T (F_0 - F_a), where F_0 would give the machine
    with straight links the same motion of its platform.

    Args:
        plant: the machine, from `build_plant` or `prepare(structure, case).loop.plant`.
        pose, pose_rate: X [m, m, rad] and X' (3,).
        q, q_rate: modal coordinates [m] and their rates, (3, R).
        slider_force: F_a [N], (3,).
        modal_force: F_PZT [N], (3, R).

    Returns:
        T_d on the rigid motion [N, N, N m], (3,); t_d on the modes [N], (3, R).

    Example:
        >>> plant = prepare(*paper_case({"link.modes": 2})).loop.plant
        >>> still = jnp.zeros(3), jnp.zeros((3, 3))
        >>> bent = 1e-5 * jnp.ones((3, 3))
        >>> lumped_forces(plant, jnp.array(HOME), still[0], bent, still[1], *still)[1].shape
        (3, 3)
    """
    chain = modal_chain(plant, pose, pose_rate, q, q_rate)
    mass = plant.modal_mass[:, None]
    found = accelerations(plant, chain, pose_rate, q, q_rate, slider_force, modal_force / mass)
    straight = inverse_dynamics(plant, pose, pose_rate, found.pose)
    jacobian = jax.jacfwd(lambda x: inverse_kinematics(plant, x, jnp.zeros_like(x))[0])(pose)
    modes = mass * found.modal + plant.stiffness * q - modal_force
    return jacobian.T @ (straight - slider_force), modes
