"""What a mechanism is: how the near joints of its links move.

All mechanisms here are closed chains in the plane whose flexible links end at joints C of a
platform, a rigid body or a point. The near joint B of a link is driven along a path: a straight
guide, or the circle of a crank. That path, and where on it B must be for a given C, is all that
distinguishes one mechanism from another in the equations of motion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.mechanisms.carriers import Carrier
from jaxmodel.parameters import Array, Num
from jaxmodel.table import Parameter


class Mechanism(NamedTuple):
    """A mechanism.

    `build(own, machine, xp)` returns its `Geometry` and the mass that moves with B on each leg
    [kg]: `own` are its parameters, `machine` the numbers of `[machine]` (angles in radians as
    `guide_angle` and `joint_angle`), `xp` NumPy or `jax.numpy`. All may have leading axes of cases,
    and so has every array of the geometry.
    """

    name: str  # in study files
    text: str  # in reports
    n_links: int  # flexible links, each with an actuated joint
    n_pose: int  # coordinates of the platform: 3 of a rigid body, 2 of a point
    home: tuple[float, ...]  # a pose in the middle of the workspace [m, m, rad], (n_pose,)
    build: Callable[[dict[str, Array], dict[str, Array], Any], tuple[Geometry, Array]]
    parameters: tuple[Parameter, ...] = ()
    allowed: str = "a pose within reach"  # of the poses, for messages
    reads: tuple[str, ...] = ()  # fields of `[machine]`, beside those of the platform's inertia


class Near(NamedTuple):
    """The near joints B of the links for given far joints C.

    u is the direction in which B moves, n that direction turned by +90 deg.
    """

    x: Num[Array, "links"]  # of u [1]
    y: Num[Array, "links"]
    root: Num[Array, "links"]  # P = u.(C - B), made safe where there is none [m]
    # its square as it is: not positive where C is out of reach [m2]
    root_squared: Num[Array, "links"]
    across: Num[Array, "links"]  # h = n.(C - B) [m]
    position: Num[Array, "links"]  # rho, of B along its path [m]
    # of the path, towards n [1/m]; None: it is straight
    curvature: Num[Array, "links"] | None = None

    def to_far(self) -> tuple[Array, Array]:
        """C - B in the plane [m]."""
        return (
            self.root * self.x - self.across * self.y,
            self.root * self.y + self.across * self.x,
        )


class Legs(Protocol):
    """Constants of the paths: a NamedTuple of arrays, (n,) each, whose type is the mechanism."""

    def side(self, gamma: Array) -> Array:
        """Of a link's angle or its sine: positive on the right side of the path."""

    def near(self, x: Array, y: Array, squared: Array, floor: Array, xp: Any = jnp) -> Near:
        """Where the near joints are.

        Args:
            x, y: of the far joints C [m], (n,) each.
            squared: distance of C from B [m2].
            floor: `root_squared` is no less in `root` [m2].
            xp: NumPy or `jax.numpy`.
        """

    def misplaced(self, x: np.ndarray, y: np.ndarray, length: np.ndarray) -> list[str]:
        """What is wrong with far joints that no link reaches, in words; NumPy numbers.

        Args:
            x, y: of the far joints C [m], (n,) each.
            length: of the links [m], (n,).
        """


class Geometry(Protocol):
    """Numbers that describe a mechanism: a NamedTuple of arrays."""

    def legs(self, xp: Any = jnp) -> Legs:
        """Paths of the near joints."""

    def arms(self, xp: Any = jnp) -> tuple[Array, Array] | None:
        """Far joints in the platform's axes [m], (n,) each; None: the platform is a point."""

    def size(self) -> float:
        """How large it is [m]; NumPy numbers."""

    def carriers(self, near_mass: Array, xp: Any = np) -> tuple[Carrier, ...]:
        """What a workshop builds to carry the near joints, leg by leg.

        Args:
            near_mass: what moves with B, as from `Mechanism.build` [kg], () or (n,).
            xp: NumPy or `jax.numpy`.
        """


#: Sine and cosine of a link's angle to its path must exceed this: it is singular otherwise [1].
SINGULAR_MARGIN = 1e-3


def polar(radius: Array, angle: Array, xp: Any) -> tuple[Array, Array]:
    """Points by their distance [m], () or (n,), and direction [rad], (n,)."""
    angle = xp.asarray(angle)
    radius = xp.broadcast_to(xp.asarray(radius), angle.shape)
    return radius * xp.cos(angle), radius * xp.sin(angle)


def safe_root(squared: Array, floor: Array, xp: Any) -> Array:
    """Root of a number that may be negative where nothing depends on it."""
    return xp.sqrt(xp.maximum(squared, floor))
