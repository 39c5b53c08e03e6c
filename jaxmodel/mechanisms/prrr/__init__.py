"""3-PRR: sliders on straight guides carry the links, which hold a rigid platform."""

from jaxmodel.mechanisms.contract import Mechanism

PRRR = Mechanism(name="prrr", title="3-PRR", n_links=3, n_pose=3)
