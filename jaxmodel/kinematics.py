"""The closed chain (6) in closed form: slider positions and link angles from pose and bending.

With s = u.(C - A), h = n.(C - A), w = sum_j Y_j(L) q_j, l2 = L^2 + w^2 and P = sqrt(l2 - h^2):
rho = s - P, sin gamma = (h L - w P)/l2, cos gamma = (L P + w h)/l2, gamma = beta - alpha.
Shapes as in `jaxmodel.plant`: structure first, lanes last.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from jaxmodel import status
from jaxmodel.parameters import Array
from jaxmodel.plant import Plant
from jaxmodel.trigonometry import sine_cosine

#: sin and cos of gamma must exceed this: parallel or perpendicular to the guide is singular [1].
SINGULAR_MARGIN = 1e-3


class Chain(NamedTuple):
    """Positions and rates of the chain at one instant, per link, (3,) each."""

    cu: Array  # u.(C - X) [m]
    cn: Array  # n.(C - X) [m]
    h: Array  # n.(C - A) [m]
    root: Array  # P, safe: never below SINGULAR_MARGIN L [m]
    root_squared: Array  # l2 - h^2, as it is [m2]
    sine: Array  # sin gamma [1]
    cosine: Array  # cos gamma [1]
    tip: Array  # w, deflection of C from the link's tangent frame [m]
    tip_rate: Array  # [m/s]
    rho: Array  # slider position [m]
    rho_rate: Array  # [m/s]
    gamma_rate: Array  # [rad/s]
    h_rate: Array  # [m/s]


def close_chain(
    plant: Plant, pose: Array, pose_rate: Array, tip: Array = 0.0, tip_rate: Array = 0.0
) -> Chain:
    """Solve the closure (6) and its rate.

    gamma' = (h' - cos(gamma) w')/P, rho' = s' + h gamma' + sin(gamma) w'.

    Args:
        plant: the machine.
        pose: (x, y, phi) [m, m, rad], (3,).
        pose_rate: its rate, (3,).
        tip: w = sum_j Y_j(L) q_j [m], (3,) or 0.
        tip_rate: w' [m/s], (3,) or 0.

    Returns:
        Chain. Out of reach or at a singular pose P is replaced by a safe value, so the numbers are
        finite there but meaningless: `chain_status` tells.
    """
    sine, cosine = sine_cosine(pose[2])
    cu = plant.joint_cos * cosine - plant.joint_sin * sine
    cn = plant.joint_sin * cosine + plant.joint_cos * sine
    ux, uy, length = plant.ux, plant.uy, plant.length
    s = ux * pose[0] + uy * pose[1] + cu + plant.s0
    h = ux * pose[1] - uy * pose[0] + cn + plant.h0
    s_rate = ux * pose_rate[0] + uy * pose_rate[1] - cn * pose_rate[2]
    h_rate = ux * pose_rate[1] - uy * pose_rate[0] + cu * pose_rate[2]
    squared = length * length + tip * tip
    root_squared = squared - h * h
    floor = (SINGULAR_MARGIN * length) ** 2
    root = jnp.sqrt(jnp.maximum(root_squared, floor))
    sin_gamma = (h * length - tip * root) / squared
    cos_gamma = (length * root + tip * h) / squared
    gamma_rate = (h_rate - cos_gamma * tip_rate) / root
    rho_rate = s_rate + h * gamma_rate + sin_gamma * tip_rate
    return Chain(
        cu, cn, h, root, root_squared, sin_gamma, cos_gamma,
        jnp.zeros_like(h) + tip, jnp.zeros_like(h) + tip_rate,
        s - root, rho_rate, gamma_rate, h_rate,
    )  # fmt: skip


def chain_status(plant: Plant, chain: Chain) -> Array:
    """Status of the pose: OK, OUT_OF_REACH (h^2 > l2) or SINGULAR (gamma at 0 or 90 deg).

    Returns:
        () code of `jaxmodel.status`, as a floating-point number.
    """
    margin = SINGULAR_MARGIN
    is_out = jnp.any(chain.root_squared <= 0, axis=0)
    near = (chain.sine < margin) | (chain.root_squared < (margin * plant.length) ** 2)
    code = jnp.where(jnp.any(near, axis=0), status.SINGULAR, status.OK)
    return jnp.where(is_out, status.OUT_OF_REACH, code).astype(chain.h.dtype)


def link_angle(chain: Chain) -> Array:
    """gamma = beta - alpha [rad], (3,)."""
    return jnp.arctan2(chain.sine, chain.cosine)


def singularity_distance(plant: Plant, pose: Array) -> Array:
    """Smallest distance of any link angle gamma from 0 and 90 deg [rad], ().

    Args:
        plant: the machine.
        pose: of the undeformed machine, (N, 3) [m, m, rad].
    """
    lanes = plant._replace(**{name: getattr(plant, name)[:, None] for name in _LINK_FIELDS})
    gamma = link_angle(close_chain(lanes, pose.T, jnp.zeros_like(pose.T)))
    return jnp.min(jnp.minimum(gamma, jnp.pi / 2 - gamma))


def inverse_kinematics(plant: Plant, pose: Array, pose_rate: Array) -> tuple[Array, Array]:
    """Slider positions [m] and rates [m/s] of the undeformed machine for poses on any time axis.

    Args:
        plant: the machine.
        pose: (..., 3) [m, m, rad].
        pose_rate: (..., 3).

    Returns:
        (rho, rho_rate), (..., 3) each.
    """
    lead = pose.shape[:-1]
    lanes = plant._replace(
        **{
            name: jnp.reshape(getattr(plant, name), (3,) + (1,) * len(lead))
            for name in _LINK_FIELDS
        }
    )
    chain = close_chain(lanes, jnp.moveaxis(pose, -1, 0), jnp.moveaxis(pose_rate, -1, 0))
    return jnp.moveaxis(chain.rho, 0, -1), jnp.moveaxis(chain.rho_rate, 0, -1)


_LINK_FIELDS = ("ux", "uy", "joint_cos", "joint_sin", "s0", "h0", "length")


def path_status(plant: Plant, pose: Array) -> Array:
    """First bad status along poses of the undeformed machine, with its index.

    Args:
        plant: the machine.
        pose: (N, 3) [m, m, rad].

    Returns:
        (code (), index ()): code OK and index 0 where the whole path is sound.
    """
    lanes = plant._replace(**{name: getattr(plant, name)[:, None] for name in _LINK_FIELDS})
    codes = chain_status(lanes, close_chain(lanes, pose.T, jnp.zeros_like(pose.T)))
    index = jnp.argmax(codes != status.OK)
    return codes[index], index


def closure_residual(plant: Plant, pose: Array, chain: Chain, gamma: Array) -> Array:
    """Residual of (6) [m], (2, 3): C from the platform minus C from slider and bent link.

    Args:
        plant: the machine.
        pose: (3,).
        chain: supplies rho and w.
        gamma: link angles [rad], (3,).

    Returns:
        components along u and n.
    """
    along = chain.rho + plant.length * jnp.cos(gamma) - chain.tip * jnp.sin(gamma)
    across = plant.length * jnp.sin(gamma) + chain.tip * jnp.cos(gamma)
    s = plant.ux * pose[0] + plant.uy * pose[1] + chain.cu + plant.s0
    return jnp.stack([s - along, chain.h - across])
