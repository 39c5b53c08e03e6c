"""Five-bar: two motors turn rigid cranks that carry the links, which meet in a point."""

from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.five_bar.cranks import PARAMETERS, build

FIVE_BAR = Mechanism(
    name="five_bar",
    text="five-bar",
    n_links=2,
    n_pose=2,
    build=build,
    parameters=PARAMETERS,
)
