"""Super-twisting, a second-order sliding mode, on computed torque (Levant 1993).

Sliding variable s = e' + lambda e; F_fb = m lambda e' + k_1 |s|^(1/2) sign(s) + v, v' = k_2
sign(s). Against disturbances with |d'| <= D, s and s' vanish in finite time with
k_1 = 1.5 (m D)^(1/2) and k_2 = 1.1 D (Levant 1998; Moreno and Osorio 2012 prove it). Both functions
are smoothed, s/(|s| + phi)^(1/2) and s/(|s| + phi), since a sampled drive would chatter: for small
motions it is a PID with k_1/phi^(1/2) on s and k_2/phi on its integral. v stays within the limit of
the motors.
"""

from __future__ import annotations

from jaxmodel.case import Drive
from jaxmodel.drives.contract import DECAY, INERTIA, DriveLaw, SliderError
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array
from jaxmodel.table import Parameter

#: Of k_1 and k_2 (Levant 1998).
GAINS = (1.5, 1.1)


def sliding_variable(drive: Drive, error: SliderError) -> Array:
    """s = e' + lambda e [m/s], (3,)."""
    return error.rate + drive.parameters["decay"] * error.position


def force(drive: Drive, memory: Array | None, error: SliderError, is_smooth: bool) -> Array:
    """m lambda e' + k_1 s/(|s| + phi)^(1/2) + v [N], see `DriveLaw`."""
    assert memory is not None
    own, s = drive.parameters, sliding_variable(drive, error)
    gain = GAINS[0] * jnp.sqrt(own["inertia"] * own["disturbance_rate"])
    root = s / jnp.sqrt(jnp.abs(s) + own["layer"])
    return own["inertia"] * own["decay"] * error.rate + gain * root + memory


def update(drive: Drive, memory: Array, error: SliderError, applied: Array, period: Array) -> Array:
    """v of the next sample [N], see `DriveLaw`."""
    own, s = drive.parameters, sliding_variable(drive, error)
    step = GAINS[1] * own["disturbance_rate"] * period * s / (jnp.abs(s) + own["layer"])
    return jnp.clip(memory + step, -drive.force_limit, drive.force_limit)


SUPER_TWISTING = DriveLaw(
    "super_twisting",
    "computed torque with super-twisting",
    force,
    has_feedforward=True,
    is_sampled=True,
    update=update,
    parameters=(
        Parameter(
            "disturbance_rate", 500.0, "N/s", "D, largest slope of the disturbances", 1e-3, 1e8
        ),
        Parameter("layer", 0.01, "m/s", "phi, which smooths sign and root", 1e-9, 1e2),
        DECAY,
        INERTIA,
    ),
)
