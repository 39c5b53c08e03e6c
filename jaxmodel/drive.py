"""Forces on the actuated joints: motors with their limit, smooth friction, disturbances."""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import MOTOR_ORDER, Drive, Structure
from jaxmodel.controller import soft_limit
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveState, SliderError, drive_force
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num


class Reference(NamedTuple):
    """Desired motion of the actuated joints at one instant."""

    rho: Num[Array, "links"]  # [m]
    rho_rate: Num[Array, "links"]  # [m/s]
    feedforward: Num[Array, "links"] | None  # computed torque, or what holds a steady load [N]
    disturbance: Num[Array, "links"]  # external force, held over the sample [N]
    wrench: Num[Array, "pose"] | None = None  # on the platform, held over the sample [N, N, N m]
    # what a sampled drive feeds back, held over the sample [N]; None: the drive, or a sampled one
    # to first order, acts in continuous time
    held: Num[Array, "links"] | None = None


def motor_force(
    structure: Structure, drive: Drive, reference: Reference, rho: Array, rho_rate: Array
) -> Array:
    """Force of the motors, feedback of the drive and feed-forward within their limit [N], (3,).

    Args:
        structure: static choices.
        drive: numbers and limit, fields (3,) or ().
        reference: desired motion.
        rho: actuated coordinates [m], (3,).
        rho_rate: [m/s], (3,).
    """
    force = reference.held
    if force is None:
        law, error = DRIVES[structure.drive], _error(reference, rho, rho_rate)
        memory = None if law.update is None else jnp.zeros_like(rho)
        force = drive_force(law, drive, memory, error, structure.is_smooth)
    if reference.feedforward is not None:
        force = force + reference.feedforward
    return soft_limit(force, drive.force_limit, structure.is_smooth)


def _error(reference: Reference, rho: Array, rho_rate: Array) -> SliderError:
    return SliderError(reference.rho - rho, reference.rho_rate - rho_rate)


#: Dead time tau by the Pade approximant (2, 3) of exp(-s tau), 2e-4 up to omega tau = 1: force F
#: and two more states x' = LAG (x, u)/tau, which a held command u brings to u.
LAG = ((-9.0, 6.0, 0.0, 3.0), (-6.0, 0.0, 10.0, -4.0), (-1.0, 0.0, 0.0, 1.0))
#: Fastest pole of the states, times tau [1].
LAG_POLE = 4.1
#: Of the idle states of motors without lag in a batch with others [s].
_IDLE = 0.01


def settled_motors(structure: Structure, force: Array) -> Array | None:
    """States of motors that have followed their commands to a force [N], (3, n), as `late_force`.

    Args:
        structure: static choices.
        force: [N], (n,).
    """
    return jnp.stack([force] * MOTOR_ORDER) if structure.has_drive_lag else None


def late_force(drive: Drive, command: Array, motor: Array | None) -> tuple[Array, Array | None]:
    """Force of motors that follow their commands late [N], (n,), and rate of their states [N/s].

    Args:
        drive: its numbers.
        command: from `motor_force` [N], (n,).
        motor: states of the motors [N], (3, n); None: they follow at once.
    """
    if motor is None:
        return command, None
    is_late = drive.lag > 0
    rates = jnp.stack(
        [sum(c * x for c, x in zip(row, (*motor, command), strict=True)) for row in LAG]
    )
    return jnp.where(is_late, motor[0], command), rates / jnp.where(is_late, drive.lag, _IDLE)


def late_response(s: Array, lag: Array) -> Array:
    """Force over command at s [1/s], the same approximant [1], complex."""
    x = s * lag
    return (60 - 24 * x + 3 * x * x) / (60 + x * (36 + x * (9 + x)))


def slider_force(
    structure: Structure, drive: Drive, reference: Reference, motors: Array, rho_rate: Array
) -> Array:
    """Force on the joints [N], (n,): motors, friction F_c tanh(rho'/v) + c rho', disturbance.

    Args:
        structure, drive, reference, rho_rate: as in `motor_force`; tanh is costly, so Coulomb
            friction is left out where the structure has none.
        motors: from `late_force` [N], (n,).
    """
    force = motors + reference.disturbance
    force = force - drive.viscous_friction * rho_rate
    if structure.has_friction:
        force = force - drive.coulomb_friction * jnp.tanh(rho_rate / drive.friction_speed)
    return force


def drive_step(
    structure: Structure,
    drive: Drive,
    period: Array,
    state: DriveState,
    reference: Reference,
    rho: Array,
    rho_rate: Array,
    applied: Array,
) -> DriveState:
    """One sample of a sampled drive: what it feeds back during the next one, and its memory.

    Args:
        structure: static choices; in linear mechanics the law is taken to first order.
        drive: its numbers.
        period: of a sample [s], ().
        state: force held over this sample, memory.
        reference: desired motion at the sampling instant.
        rho: actuated coordinates there [m], (3,).
        rho_rate: [m/s], (3,).
        applied: feedback that acts during this sample, after the limit of the motors [N], (3,).
    """
    law = DRIVES[structure.drive]

    def sample(memory: Array | None, error: SliderError, applied: Array) -> DriveState:
        force = drive_force(law, drive, memory, error, structure.is_smooth)
        if law.update is None or memory is None:
            return DriveState(force, memory)
        return DriveState(force, law.update(drive, memory, error, applied, period))

    inputs = (state.memory, _error(reference, rho, rho_rate), applied)
    if not structure.is_linear:
        return sample(*inputs)
    rest = jax.tree.map(jnp.zeros_like, inputs)
    change: DriveState = jax.jvp(sample, rest, inputs)[1]
    return change
