"""Computed torque with a disturbance observer (Ohnishi, Shibata and Murakami 1996).

With F_ff the deviation from the reference obeys m e'' = -F_fb - d, d all that F_ff does not know:
friction, ripple, loads, flexible links. The observer is d_hat' = g (d - d_hat) without
differentiating e': with w = d_hat + g m e', w' = -g (F_fb + d_hat), where F_fb is the force after
the limit of the motors, so that nothing winds up. F_fb = Kp e + Kd e' - d_hat. A constant d leaves
no error; d = r t leaves e = -r (1/g + T)/Kp, T the sample of computing delay.
"""

from __future__ import annotations

from jaxmodel.case import Drive
from jaxmodel.drives.contract import INERTIA, DriveLaw, SliderError
from jaxmodel.drives.pd import proportional_derivative
from jaxmodel.parameters import Array
from jaxmodel.table import Parameter


def estimate(drive: Drive, memory: Array | None, error: SliderError) -> Array:
    """d_hat = w - g m e' [N], (3,)."""
    assert memory is not None
    own = drive.parameters
    return memory - own["bandwidth"] * own["inertia"] * error.rate


def force(drive: Drive, memory: Array | None, error: SliderError, is_smooth: bool) -> Array:
    """Kp e + Kd e' - d_hat [N], see `DriveLaw`."""
    pd = proportional_derivative(drive, None, error, is_smooth)
    return pd - estimate(drive, memory, error)


def update(drive: Drive, memory: Array, error: SliderError, applied: Array, period: Array) -> Array:
    """w of the next sample [N], see `DriveLaw`."""
    seen = applied + estimate(drive, memory, error)
    return memory - drive.parameters["bandwidth"] * period * seen


DISTURBANCE_OBSERVER = DriveLaw(
    "disturbance_observer",
    "computed torque with disturbance observer",
    force,
    has_feedforward=True,
    is_sampled=True,
    update=update,
    parameters=(
        Parameter("bandwidth", 300.0, "rad/s", "g of the disturbance observer", 0.0, 1e5),
        INERTIA,
    ),
)
