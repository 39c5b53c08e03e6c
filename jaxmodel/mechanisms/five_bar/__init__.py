"""Five-bar: two motors turn rigid cranks that carry the links, which meet in a point."""

from jaxmodel.mechanisms.contract import Mechanism

FIVE_BAR = Mechanism(name="five_bar", title="five-bar", n_links=2, n_pose=2)
