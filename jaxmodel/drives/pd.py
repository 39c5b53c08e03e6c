"""PD, the paper's: F_fb = Kp e + Kd e', in continuous time."""

from __future__ import annotations

from jaxmodel.case import Drive
from jaxmodel.drives.contract import DriveLaw, SliderError
from jaxmodel.parameters import Array


def proportional_derivative(
    drive: Drive, memory: Array | None, error: SliderError, is_smooth: bool
) -> Array:
    """Kp e + Kd e' [N], see `DriveLaw`."""
    return drive.kp * error.position + drive.kd * error.rate


PD = DriveLaw("pd", "PD", proportional_derivative)
