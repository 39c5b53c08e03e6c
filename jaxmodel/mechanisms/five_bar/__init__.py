"""Five-bar: two motors turn rigid cranks that carry the links, which meet in a point."""

from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.five_bar.cranks import PARAMETERS, build

FIVE_BAR = Mechanism(
    name="five_bar",
    text="five-bar",
    n_links=2,
    n_pose=2,
    home=(0.0, 0.25),
    build=build,
    allowed="a pose where crank and link reach each joint without being in line",
    parameters=PARAMETERS,
)
