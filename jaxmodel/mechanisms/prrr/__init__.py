"""3-PRR: sliders on straight guides carry the links, which hold a rigid platform."""

from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.prrr.guides import build

PRRR = Mechanism(
    name="prrr",
    text="3-PRR",
    n_links=3,
    n_pose=3,
    build=build,
)
