"""Sliding mode with a boundary layer, on computed torque (Slotine and Li 1991, section 7.2).

Sliding variable s = e' + lambda e; F_fb = m lambda e' + K sat(s/phi). Where the drive's model is
right, m s' = -K sat(s/phi) - d: outside of the layer |s| shrinks by (K -+ |d|)/m per second, inside
the drive is a PD with K/phi + m lambda and K lambda/phi, and a constant d < K leaves s = -phi d/K,
that is e = -phi d/(K lambda).
"""

from __future__ import annotations

from jaxmodel.case import Drive
from jaxmodel.controller import soft_limit
from jaxmodel.drives.contract import DECAY, INERTIA, DriveLaw, SliderError
from jaxmodel.parameters import Array
from jaxmodel.table import Parameter


def force(drive: Drive, memory: Array | None, error: SliderError, is_smooth: bool) -> Array:
    """m lambda e' + K sat(s/phi) [N], see `DriveLaw`."""
    own = drive.parameters
    sliding = error.rate + own["decay"] * error.position
    switched = soft_limit(own["force"] / own["layer"] * sliding, own["force"], is_smooth)
    return own["inertia"] * own["decay"] * error.rate + switched


SLIDING_MODE = DriveLaw(
    "sliding_mode",
    "computed torque with sliding mode",
    force,
    has_feedforward=True,
    is_sampled=True,
    parameters=(
        Parameter("force", 40.0, "N", "K, which must exceed the disturbances", 1e-3, 1e6),
        Parameter("layer", 0.1, "m/s", "phi, half-width of the boundary layer", 1e-6, 1e2),
        DECAY,
        INERTIA,
    ),
)
