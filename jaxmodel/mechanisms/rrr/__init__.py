"""3-RRR: motors turn rigid cranks that carry the links, which hold a rigid platform."""

from jaxmodel.mechanisms.contract import Mechanism

RRR = Mechanism(name="rrr", title="3-RRR", n_links=3, n_pose=3)
