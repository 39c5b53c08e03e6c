"""Equations of motion (1)-(9), reduced to pose and modes by Kane's method, O(R) per link.

The mass matrix is a block arrow: links couple only through the three pose accelerations. Per link
the modal accelerations are eliminated through a few sums, then one symmetric 3x3 system gives the
pose and back-substitution the rest. docs/theory.md derives each line. Elementwise arithmetic only.
Shapes as in `jaxmodel.plant`: structure first, lanes last.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from jaxmodel.kinematics import Chain, close_chain
from jaxmodel.parameters import Array
from jaxmodel.plant import Plant


class Accelerations(NamedTuple):
    """Result of one evaluation of the dynamics."""

    pose: Array  # X'' [m/s2, m/s2, rad/s2], (3,)
    modal: Array  # q'' [m/s2], (3, R)
    coupling: Array  # q'' + (k q + d q')/m: all but the oscillator itself [m/s2], (3, R)
    rho: Array  # rho'' [m/s2], (3,)
    gamma: Array  # gamma'' [rad/s2], (3,)


def modal_chain(plant: Plant, pose: Array, pose_rate: Array, q: Array, q_rate: Array) -> Chain:
    """`close_chain` of the bent machine: w = sum_j Y_j(L) q_j (4), (6).

    Args:
        plant: the machine.
        pose: (3,) [m, m, rad].
        pose_rate: (3,).
        q: modal coordinates [m], (3, R).
        q_rate: [m/s], (3, R).
    """
    if plant.tip is None:
        return close_chain(plant, pose, pose_rate)
    tip, tip_rate = jnp.sum(plant.tip * q, axis=1), jnp.sum(plant.tip * q_rate, axis=1)
    return close_chain(plant, pose, pose_rate, tip, tip_rate)


class _Link(NamedTuple):
    """Reduced 2x2 system of a link in (rho, gamma): K (rho0'', gamma0'') + load."""

    k_rr: Array
    k_rg: Array
    k_gg: Array
    load_r: Array
    load_g: Array


def accelerations(
    plant: Plant,
    chain: Chain,
    pose_rate: Array,
    q: Array,
    q_rate: Array,
    slider_force: Array,
    piezo: Array,
) -> Accelerations:
    """Accelerations of pose and modes, (7) solved.

    Args:
        plant: the machine.
        chain: closure at this state, from `modal_chain`.
        pose_rate: (3,).
        q: modal coordinates [m], (3, R).
        q_rate: [m/s], (3, R).
        slider_force: along the guides [N], (3,).
        piezo: generalised piezo forces (14) over the modal masses, Q_j/m_j [m/s2], (3, R).

    Returns:
        Accelerations.
    """
    sine, cosine, rate, inverse = chain.sine, chain.cosine, chain.gamma_rate, 1 / chain.root
    phi2, rate2 = pose_rate[2] * pose_rate[2], rate * rate
    lever = chain.h * inverse
    # velocity terms of gamma'' and rho'' at X'' = 0, w'' = 0
    gamma_0 = lever * rate2 - inverse * (chain.cn * phi2)
    rho_0 = chain.h_rate * rate - chain.cu * phi2
    if plant.tip is not None:
        slip = chain.tip_rate * inverse
        gamma_0 = gamma_0 + slip * (sine * rate + rate * (lever * cosine - chain.tip * inverse))
        rho_0 = rho_0 + cosine * rate * chain.tip_rate
    rho_0 = rho_0 + chain.h * gamma_0
    # modal accelerations without inertia: of piezos and rotation, and of the oscillator itself
    push = piezo + q * rate2[:, None]
    own = (plant.stiffness / plant.mass) * q + (plant.damping / plant.mass) * q_rate
    pull = own - push

    b_m, c_m, mq = plant.b / plant.mass, plant.c / plant.mass, plant.mass * q
    bq, bq_rate = jnp.sum(plant.b * q, axis=1), jnp.sum(plant.b * q_rate, axis=1)
    moment = plant.first_moment
    link = _Link(
        k_rr=plant.slider_link_mass - sine * sine * jnp.sum(b_m * plant.b, axis=1),
        k_rg=sine * (jnp.sum(b_m * plant.c, axis=1) - moment) - cosine * bq,
        k_gg=plant.inertia - jnp.sum(c_m * plant.c, axis=1) + jnp.sum(mq * q, axis=1),
        load_r=sine * (jnp.sum(plant.b * pull, axis=1) + bq * rate2)
        - cosine * (moment * rate2 + 2 * rate * bq_rate)
        - slider_force,
        load_g=2 * rate * jnp.sum(mq * q_rate, axis=1) - jnp.sum(plant.c * pull, axis=1),
    )
    if plant.tip is None:
        tip_system, reduced = None, link
    else:
        tip_system, reduced = _eliminate_tip(plant, chain, link, pull)
    force_r = reduced.k_rr * rho_0 + reduced.k_rg * gamma_0 + reduced.load_r
    force_g = reduced.k_rg * rho_0 + reduced.k_gg * gamma_0 + reduced.load_g
    pose_acc = _pose_acceleration(plant, chain, reduced, force_r, force_g, lever, inverse)
    pose_acc = plant.free * pose_acc

    along = plant.ux * pose_acc[0] + plant.uy * pose_acc[1] - chain.cn * pose_acc[2]
    across = plant.ux * pose_acc[1] - plant.uy * pose_acc[0] + chain.cu * pose_acc[2]
    gamma_acc = across * inverse + gamma_0
    rho_acc = along + lever * across + rho_0
    if tip_system is not None:
        tip_acc, multiplier = tip_system(rho_acc, gamma_acc)
        rho_acc = rho_acc - chain.tip * inverse * tip_acc
        gamma_acc = gamma_acc - cosine * inverse * tip_acc
    coupling = b_m * (sine * rho_acc)[:, None] - c_m * gamma_acc[:, None] + push
    if tip_system is not None:
        coupling = coupling + plant.tip / plant.mass * multiplier[:, None]
    return Accelerations(pose_acc, coupling - own, coupling, rho_acc, gamma_acc)


def _eliminate_tip(plant: Plant, chain: Chain, link: _Link, pull: Array):
    """Take the link's tip acceleration w'' and its reaction out of the 2x2 system.

    The tip moves with rho'' = rho0'' - alpha w'', gamma'' = gamma0'' - kappa w'' (alpha = w/P,
    kappa = cos gamma/P), which gives two linear equations in w'' and the reaction Lambda:
    D w'' = y.x0 - f_y + Y_y Lambda, D Lambda = beta.(M x0 + load) - (beta.M beta) w''.
    """
    tip_m = plant.tip / plant.mass
    alpha, kappa = chain.tip / chain.root, chain.cosine / chain.root
    y_r = chain.sine * jnp.sum(tip_m * plant.b, axis=1)
    y_g = -jnp.sum(tip_m * plant.c, axis=1)
    tip_force = jnp.sum(plant.tip * pull, axis=1)
    compliance = jnp.sum(tip_m * plant.tip, axis=1)
    m_r = alpha * link.k_rr + kappa * link.k_rg
    m_g = alpha * link.k_rg + kappa * link.k_gg
    beta_m_beta = alpha * m_r + kappa * m_g
    beta_load = alpha * link.load_r + kappa * link.load_g
    lead = 1 + y_r * alpha + y_g * kappa
    determinant = lead * lead + compliance * beta_m_beta

    def tip_system(rho_0: Array, gamma_0: Array) -> tuple[Array, Array]:
        push = y_r * rho_0 + y_g * gamma_0 - tip_force
        pull = m_r * rho_0 + m_g * gamma_0 + beta_load
        return (
            (lead * push + compliance * pull) / determinant,
            (lead * pull - beta_m_beta * push) / determinant,
        )

    tip_0 = (compliance * beta_load - lead * tip_force) / determinant
    multiplier_0 = (lead * beta_load + beta_m_beta * tip_force) / determinant

    def reduced_term(m_a: Array, y_a: Array, m_b: Array, y_b: Array) -> Array:
        mixed = lead * (m_a * y_b + y_a * m_b)
        return (mixed + compliance * m_a * m_b - beta_m_beta * y_a * y_b) / determinant

    return tip_system, _Link(
        k_rr=link.k_rr - reduced_term(m_r, y_r, m_r, y_r),
        k_rg=link.k_rg - reduced_term(m_r, y_r, m_g, y_g),
        k_gg=link.k_gg - reduced_term(m_g, y_g, m_g, y_g),
        load_r=link.load_r - m_r * tip_0 - y_r * multiplier_0,
        load_g=link.load_g - m_g * tip_0 - y_g * multiplier_0,
    )


def _pose_acceleration(
    plant: Plant,
    chain: Chain,
    link: _Link,
    force_r: Array,
    force_g: Array,
    lever: Array,
    inverse: Array,
) -> Array:
    """Assemble sum_i T_i^t K_i T_i X'' = -sum_i T_i^t (force_r, force_g) and solve it.

    T = rows (a + (h/P) d, d/P); s'' = a.X'' and h'' = d.X'' at rest, a = (ux, uy, -cn) and
    d = (-uy, ux, cu). Per link the sum is k a a^t + v (a d^t + d a^t) + z d d^t.
    """
    ux, uy, cn, cu = plant.ux, plant.uy, chain.cn, chain.cu
    xx, xy, yy = ux * ux, ux * uy, uy * uy
    k, w = link.k_rr, link.k_rg * inverse
    v = k * lever + w
    z = lever * (v + w) + link.k_gg * (inverse * inverse)
    a_phi, d_phi = v * cu - k * cn, z * cu - v * cn  # how X'' along a and d meets phi''
    matrix = (
        plant.platform_mass + jnp.sum(xx * k + yy * z - (2 * xy) * v, axis=0),
        jnp.sum(xy * (k - z) + (xx - yy) * v, axis=0),
        jnp.sum(ux * a_phi - uy * d_phi, axis=0),
        plant.platform_mass + jnp.sum(yy * k + xx * z + (2 * xy) * v, axis=0),
        jnp.sum(uy * a_phi + ux * d_phi, axis=0),
        plant.platform_inertia + jnp.sum(cu * d_phi - cn * a_phi, axis=0),
    )
    force_d = lever * force_r + inverse * force_g
    load = (
        jnp.sum(uy * force_d - ux * force_r, axis=0),
        jnp.sum(-uy * force_r - ux * force_d, axis=0),
        jnp.sum(cn * force_r - cu * force_d, axis=0),
    )
    return solve_symmetric_3(matrix, load)


def solve_symmetric_3(matrix: tuple[Array, ...], right: tuple[Array, ...]) -> Array:
    """Solve a symmetric positive definite 3x3 system by L D L^t, elementwise.

    Args:
        matrix: (m00, m01, m02, m11, m12, m22).
        right: three right-hand sides.

    Returns:
        (3,) stacked on a new first axis.
    """
    m00, m01, m02, m11, m12, m22 = matrix
    l10, l20 = m01 / m00, m02 / m00
    d1 = m11 - l10 * m01
    e12 = m12 - l20 * m01
    l21 = e12 / d1
    d2 = m22 - l20 * m02 - l21 * e12
    y1 = right[1] - l10 * right[0]
    y2 = right[2] - l20 * right[0] - l21 * y1
    x2 = y2 / d2
    x1 = y1 / d1 - l21 * x2
    return jnp.stack([right[0] / m00 - l10 * x1 - l20 * x2, x1, x2])


def inverse_dynamics(plant: Plant, pose: Array, pose_rate: Array, pose_acc: Array) -> Array:
    """Slider forces [N] that give the unbent machine a wanted pose acceleration (computed torque).

    sum_i T_i^t (K_i x_i'' + load_i) + M_p X'' = J^t F with J rows a + (h/P) d.

    Args:
        plant: the machine.
        pose: (3,) [m, m, rad].
        pose_rate: (3,).
        pose_acc: (3,).

    Returns:
        (3,).
    """
    chain = close_chain(plant, pose, pose_rate)
    rate, lever = chain.gamma_rate, chain.h / chain.root
    phi2 = pose_rate[2] * pose_rate[2]
    a = jnp.stack([plant.ux, plant.uy, -chain.cn])
    d = jnp.stack([-plant.uy, plant.ux, chain.cu])
    along = jnp.sum(a * pose_acc[:, None], axis=0) - chain.cu * phi2
    across = jnp.sum(d * pose_acc[:, None], axis=0) - chain.cn * phi2
    gamma_acc = (across + rate * rate * chain.h) / chain.root
    rho_acc = along + chain.h_rate * rate + chain.h * gamma_acc
    swing = plant.first_moment * chain.sine
    force_r = (
        plant.slider_link_mass * rho_acc
        - swing * gamma_acc
        - plant.first_moment * chain.cosine * rate * rate
    )
    force_g = plant.inertia * gamma_acc - swing * rho_acc
    jacobian = a + lever * d
    platform = jnp.stack([plant.platform_mass, plant.platform_mass, plant.platform_inertia])
    load = platform * pose_acc + jnp.sum(jacobian * force_r + d * force_g / chain.root, axis=1)
    return jnp.linalg.solve(jacobian, load)


def kinetic_energy(plant: Plant, chain: Chain, pose_rate: Array, q: Array, q_rate: Array) -> Array:
    """Kinetic energy (1) [J] in closed form, docs/theory.md.

    Args:
        plant: the machine.
        chain: closure at this state.
        pose_rate: (3,).
        q: [m], (3, R).
        q_rate: [m/s], (3, R).
    """
    bq, bq_rate = jnp.sum(plant.b * q, axis=1), jnp.sum(plant.b * q_rate, axis=1)
    swing = plant.first_moment * chain.sine + chain.cosine * bq
    rotary = plant.inertia + jnp.sum(plant.mass * q * q, axis=1)
    links = (
        plant.slider_link_mass * chain.rho_rate**2 / 2
        + rotary * chain.gamma_rate**2 / 2
        + jnp.sum(plant.mass * q_rate**2, axis=1) / 2
        + chain.gamma_rate * jnp.sum(plant.c * q_rate, axis=1)
        - chain.rho_rate * chain.gamma_rate * swing
        - chain.rho_rate * chain.sine * bq_rate
    )
    platform = (
        plant.platform_mass * (pose_rate[0] ** 2 + pose_rate[1] ** 2)
        + plant.platform_inertia * pose_rate[2] ** 2
    ) / 2
    return jnp.sum(links, axis=0) + platform


def potential_energy(plant: Plant, q: Array) -> Array:
    """Bending energy (2) [J]: sum k_j q_j^2/2."""
    return jnp.sum(plant.stiffness * q * q) / 2
