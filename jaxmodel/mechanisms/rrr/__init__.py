"""3-RRR: motors turn rigid cranks that carry the links, which hold a rigid platform."""

from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.rrr.cranks import PARAMETERS, build

RRR = Mechanism(
    name="rrr",
    text="3-RRR",
    n_links=3,
    n_pose=3,
    build=build,
    parameters=PARAMETERS,
)
