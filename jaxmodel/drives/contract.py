"""What a drive is: its parameters, and the force that it feeds back from the error of a joint.

The motor force is F = limit(F_ff + F_fb), where F_ff is the feed-forward (computed torque, or what
holds a steady load) and F_fb what a `DriveLaw` feeds back. A law that is not sampled acts in
continuous time, as an analogue servo would. A sampled one runs in the controller of the links: it
reads position and speed of its joint at a sampling instant, and its F_fb goes out one sample later
and is held, like the voltages; it can remember one number a joint. All functions are elementwise
over the joints, arrays (3,), and become part of the compiled step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel.case import Drive
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.table import Parameter, PartError, check_parameters, is_real


class SliderError(NamedTuple):
    """Reference less measured motion of the actuated joints."""

    position: Num[Array, "links"]  # e = rho_d - rho [m]
    rate: Num[Array, "links"]  # e' [m/s]


class DriveLaw(NamedTuple):
    """A drives.

    `force(drive, memory, error, is_smooth)` returns F_fb [N]: `memory` is what the law remembers,
    None for one without `update`; `is_smooth` asks for limits with round corners (`soft_limit`). It
    is 0 without memory and error. `update(drive, memory, error, applied, period)` returns the
    memory of the next sample, `applied` being the F_fb that acts during this one, after the limit
    of the motors [N], and `period` the sample [s].
    """

    name: str  # in study files
    text: str  # in reports
    force: Callable[[Drive, Array | None, SliderError, bool], Array]
    has_feedforward: bool = False  # computed torque: F_ff is the inverse dynamics of the reference
    is_sampled: bool = False
    update: Callable[[Drive, Array, SliderError, Array, Array], Array] | None = None
    parameters: tuple[Parameter, ...] = ()


class DriveState(NamedTuple):
    """What a sampled drive carries from sample to sample."""

    force: Num[Array, "links"]  # F_fb held over this sample [N]
    memory: Num[Array, "links"] | None  # None: the law has no `update`


class DriveGains(NamedTuple):
    """First derivatives of F_fb at rest."""

    position: Num[Array, "links"]  # by e [N/m]
    rate: Num[Array, "links"]  # by e' [N s/m]


def check_drive(law: DriveLaw) -> None:
    """Raise PartError if the description of a drive is invalid."""
    place = f"drive {law.name!r}"
    if not callable(law.force):
        raise PartError(f"{place}: force = {law.force!r}; expected a function")
    if law.update is not None and not callable(law.update):
        raise PartError(f"{place}: update = {law.update!r}; expected a function or None")
    if law.update is not None and not law.is_sampled:
        raise PartError(f"{place}: update without is_sampled; only sampled drives have a memory")
    check_parameters(place, law.parameters)


def drive_force(
    law: DriveLaw, drive: Drive, memory: Array | None, error: SliderError, is_smooth: bool
) -> Array:
    """Force of a drive [N], arguments as its own.

    Raises:
        PartError: it is none.
    """
    force = law.force(drive, memory, error, is_smooth)
    wanted = np.shape(error.position)
    if not is_real(force) or np.shape(force) not in ((), wanted):
        raise PartError(
            f"drive {law.name!r}: force returns {force!r}; expected real numbers of shape {wanted}"
        )
    return force


def resting_drive(law: DriveLaw, like: Array) -> DriveState | None:
    """State of a drive at rest; None if it is not sampled.

    Args:
        law: of the drive.
        like: any array of the actuated joints, (3,).
    """
    if not law.is_sampled:
        return None
    return DriveState(jnp.zeros_like(like), None if law.update is None else jnp.zeros_like(like))


def drive_gains(law: DriveLaw, drive: Drive) -> DriveGains:
    """Proportional and derivative gain of small motions, without what the law remembers.

    Exact for laws without memory. Sampled laws have them one sample late, which `sampled_loop`
    includes and models in continuous time do not.

    Args:
        law: of the drive.
        drive: its numbers, fields (3,) or ().
    """
    zero = jnp.zeros(jnp.shape(drive.pulse_force), jnp.result_type(float))
    memory = None if law.update is None else zero

    def slope(position: Array, rate: Array) -> Array:
        def force(e: Array, e_rate: Array) -> Array:
            return drive_force(law, drive, memory, SliderError(e, e_rate), True)

        change: Array = jax.jvp(force, (zero, zero), (position, rate))[1]
        return change

    one = jnp.ones_like(zero)
    return DriveGains(slope(one, zero), slope(zero, one))


#: Of drives that know the inertia that an actuated joint moves.
INERTIA = Parameter(
    "inertia", 0.185, "kg", "mass that an actuated joint moves, in the drive's model", 1e-3, 1e3
)
#: Of drives that make the error slide down e' = -decay e.
DECAY = Parameter("decay", 150.0, "1/s", "lambda of the sliding variable e' + lambda e", 0.1, 1e5)
