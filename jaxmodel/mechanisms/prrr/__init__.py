"""3-PRR: sliders on straight guides carry the links, which hold a rigid platform."""

from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.prrr.guides import HOME, build

PRRR = Mechanism(
    name="prrr",
    text="3-PRR",
    n_links=3,
    n_pose=3,
    home=HOME,
    build=build,
    allowed="a pose where the joint of each link lies inside its guide by more than 0 and less "
    "than link.length, so that gamma is inside (0, 90) deg (machine.guide_offsets moves it)",
    reads=(
        "guide_side",
        "guide_angles_deg",
        "guide_offsets",
        "assembly",
        "joint_angles_deg",
        "joint_radius",
        "slider_mass",
    ),
)
