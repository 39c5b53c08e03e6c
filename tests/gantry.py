"""A mechanism of one's own: two carriages on one rail, whose links meet in a point above it."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxmodel.mechanisms.carriers import Rail
from jaxmodel.mechanisms.contract import Mechanism, Near, safe_root
from jaxmodel.table import Parameter


class Carriages(NamedTuple):
    """The left one is driven to the right, the right one to the left, each towards the point."""

    sign: Any  # direction of x in which rho grows, (2,)
    height: Any  # of the rail [m], (2,)

    def side(self, gamma):
        return jnp.ones_like(gamma)

    def near(self, x, y, squared, floor, xp=jnp):
        above = self.sign * (y - self.height)
        root_squared = squared - above * above
        root = safe_root(root_squared, floor, xp)
        return Near(
            x=self.sign,
            y=xp.zeros_like(self.sign),
            root=root,
            root_squared=root_squared,
            across=above,
            position=self.sign * x - root,
        )

    def misplaced(self, x, y, length):
        return [
            f"the point is {up:.4g} m above the rail"
            for up, own in zip(np.broadcast_to(y - self.height, 2), length, strict=True)
            if abs(up) >= own
        ]


class Gantry(NamedTuple):
    """A rail along x."""

    sign: Any
    height: Any

    def arms(self, xp=jnp):
        """The links meet in a point."""

    def size(self):
        return 1.0

    def legs(self, xp=jnp):
        return Carriages(xp.asarray(self.sign), xp.asarray(self.height))

    def carriers(self, near_mass, xp=np):
        start = xp.stack([0 * self.height, self.height], axis=1)
        along = xp.stack([self.sign, 0 * self.sign], axis=1)
        mass = xp.broadcast_to(xp.asarray(near_mass, float), self.sign.shape)
        return tuple(Rail(start[i], along[i], 0.5, mass[i]) for i in range(len(self.sign)))


def build(own, machine, xp):
    sign = xp.ones_like(own["rail_height"]) * xp.asarray([1.0, -1.0])
    return Gantry(sign, own["rail_height"]), own["carriage_mass"]


mechanisms = [
    Mechanism(
        name="gantry",
        text="gantry",
        n_links=2,
        n_pose=2,
        home=(0.0, 0.14),
        build=build,
        parameters=(
            Parameter("rail_height", 0.0, "m", "of the rail", -1.0, 1.0),
            Parameter("carriage_mass", 0.15, "kg", "of a carriage", 1e-3, 1e3),
        ),
    )
]
