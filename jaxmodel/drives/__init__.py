"""Drives of the actuated joints, one file each; `contract` defines what a drive is.

A drive in `DRIVES` can be selected by `drive.kind` in a study file, swept, tuned and judged. To add
one, write a file like `sliding_mode` and add its `DriveLaw` to the list below; from outside the
package, use `DRIVES.add`.
"""

from __future__ import annotations

from jaxmodel.drives.computed_torque import COMPUTED_TORQUE
from jaxmodel.drives.contract import DriveLaw, check_drive
from jaxmodel.drives.disturbance_observer import DISTURBANCE_OBSERVER
from jaxmodel.drives.pd import PD
from jaxmodel.drives.sliding_mode import SLIDING_MODE
from jaxmodel.drives.super_twisting import SUPER_TWISTING
from jaxmodel.table import Table

DRIVES: Table[DriveLaw] = Table(
    "drive", [PD, COMPUTED_TORQUE, DISTURBANCE_OBSERVER, SLIDING_MODE, SUPER_TWISTING], check_drive
)
