"""3-RRR: motors turn rigid cranks that carry the links, which hold a rigid platform."""

import numpy as np

from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.rrr.cranks import PARAMETERS, build

RRR = Mechanism(
    name="rrr",
    text="3-RRR",
    n_links=3,
    n_pose=3,
    home=(0.0, 0.0, -np.pi / 6),
    build=build,
    allowed="a pose where crank and link reach each joint without being in line",
    parameters=PARAMETERS,
    reads=("assembly", "joint_angles_deg", "joint_radius"),
)
