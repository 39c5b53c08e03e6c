"""Slider drive: PD on rho, optional computed torque, force limit, smooth friction, disturbances."""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Drive
from jaxmodel.controller import soft_limit
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array


class Reference(NamedTuple):
    """Desired motion of the sliders at one instant, (3,) each."""

    rho: Array  # [m]
    rho_rate: Array  # [m/s]
    feedforward: Array | None  # force added to PD: computed torque, or what holds a steady load [N]
    disturbance: Array  # external force, held over the sample [N]
    wrench: Array | None = None  # on the platform, held over the sample [N, N, N m]


def motor_force(
    drive: Drive, reference: Reference, rho: Array, rho_rate: Array, is_smooth: bool
) -> Array:
    """Force of the motors F = Kp (rho_d - rho) + Kd (rho_d' - rho') (+ feed-forward) [N], (3,).

    Args:
        drive: gains and limit, fields (3,) or ().
        reference: desired motion.
        rho: slider positions [m], (3,).
        rho_rate: [m/s], (3,).
        is_smooth: limit with round corners, see `soft_limit`.
    """
    force = drive.kp * (reference.rho - rho) + drive.kd * (reference.rho_rate - rho_rate)
    if reference.feedforward is not None:
        force = force + reference.feedforward
    return soft_limit(force, drive.force_limit, is_smooth)


def slider_force(
    drive: Drive,
    reference: Reference,
    rho: Array,
    rho_rate: Array,
    has_friction: bool,
    is_smooth: bool,
) -> Array:
    """Force on the sliders [N], (3,): motors, friction F_c tanh(rho'/v) + c rho', disturbance.

    Args:
        drive, reference, rho, rho_rate, is_smooth: as in `motor_force`.
        has_friction: whether there is any Coulomb friction (tanh is costly).
    """
    force = motor_force(drive, reference, rho, rho_rate, is_smooth) + reference.disturbance
    force = force - drive.viscous_friction * rho_rate
    if has_friction:
        force = force - drive.coulomb_friction * jnp.tanh(rho_rate / drive.friction_speed)
    return force
