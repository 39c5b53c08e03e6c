"""Computed torque: PD, and the inverse dynamics of the reference with rigid links as F_ff."""

from __future__ import annotations

from jaxmodel.drives.contract import DriveLaw
from jaxmodel.drives.pd import proportional_derivative

COMPUTED_TORQUE = DriveLaw(
    "computed_torque", "PD with computed torque", proportional_derivative, has_feedforward=True
)
