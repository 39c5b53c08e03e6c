"""Cranks: circles as the paths of the near joints, rho the arc from a zero direction."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.mechanisms.carriers import Crank, cranks
from jaxmodel.mechanisms.contract import Near, polar, safe_root
from jaxmodel.parameters import Array, Num, PerLink
from jaxmodel.table import Parameter
from jaxmodel.trigonometry import angle_of

#: Keeps a far joint from being on a pivot [m2].
TINY_AREA = 1e-20


class Cranks(NamedTuple):
    """Crank i turns about A_i.

    The direction of B is that in which rho grows, so that P is positive: against the clock for
    elbows of +1, with it for those of -1.
    """

    x: Num[Array, "links"]  # of A [m]
    y: Num[Array, "links"]
    length: Num[Array, "links"]  # a [m]
    elbow: Num[Array, "links"]  # 1: C lies to the left of the crank, -1: to its right
    zero_x: Num[Array, "links"]  # direction of the crank at rho = 0 [1]
    zero_y: Num[Array, "links"]

    def side(self, gamma: Array) -> Array:
        """A link may stand at any angle to the path but across it, in line with the crank."""
        return jnp.ones_like(gamma)

    def near(self, x: Array, y: Array, squared: Array, floor: Array, xp: Any = jnp) -> Near:
        """With D = C - A, along the crank k = (D^2 + a^2 - l2)/(2 a) and P = sqrt(D^2 - k^2)."""
        far_x, far_y = x - self.x, y - self.y
        far = far_x * far_x + far_y * far_y
        k = (far + self.length * self.length - squared) / (2 * self.length)
        root_squared = far - k * k
        root = safe_root(root_squared, floor, xp)
        left = self.elbow * root  # of D from the crank
        scale = 1 / xp.maximum(far, TINY_AREA)
        crank_x = scale * (k * far_x + left * far_y)
        crank_y = scale * (k * far_y - left * far_x)
        turned_x = self.zero_x * crank_x + self.zero_y * crank_y
        turned_y = self.zero_x * crank_y - self.zero_y * crank_x
        arc = self.elbow * self.length
        return Near(
            x=-self.elbow * crank_y,
            y=self.elbow * crank_x,
            root=root,
            root_squared=root_squared,
            across=self.elbow * (self.length - k),
            position=arc * angle_of(turned_x, turned_y, xp),
            curvature=1 / arc,
        )

    def misplaced(self, x: np.ndarray, y: np.ndarray, length: np.ndarray) -> list[str]:
        """Joints too far from their pivot, or too near to it."""
        away = np.hypot(x - self.x, y - self.y)
        reach = zip(away, np.abs(length - self.length), length + self.length, strict=True)
        return [
            f"the joint of link {i + 1} is {far:.4g} m from its crank's pivot, of a reach from "
            f"{least:.4g} to {most:.4g} m"
            for i, (far, least, most) in enumerate(reach)
            if not least < far < most
        ]


def crank_legs(x: Array, y: Array, length: Array, elbow: Array, zero: Array, xp: Any) -> Cranks:
    """Cranks of one length and elbow, or each of its own.

    Args:
        x, y: of the pivots [m], (n,).
        length: a [m], () or (n,).
        elbow: see `Cranks`, () or (n,).
        zero: direction of a crank at rho = 0 [rad], (n,).
        xp: NumPy or `jax.numpy`.
    """
    zero = xp.asarray(zero)

    def link(x: Array) -> Array:
        return xp.broadcast_to(xp.asarray(x), zero.shape)

    return Cranks(
        x=x, y=y, length=link(length), elbow=link(elbow), zero_x=xp.cos(zero), zero_y=xp.sin(zero)
    )


class CrankGeometry(NamedTuple):
    """Cranks about pivots on a circle around O, and platform joints."""

    pivot_radius: PerLink  # distance O - A_i [m]
    pivot_angle: Num[Array, "links"]  # direction of A_i from O [rad]
    crank_length: PerLink  # a [m]
    elbow: PerLink  # 1 or -1, see `Cranks`
    zero_angle: Num[Array, "links"]  # direction of a crank at rho = 0 [rad]
    joint_radius: PerLink  # distance platform centre - C_i [m]
    joint_angle: Num[Array, "links"]  # body angle of C_i [rad]

    def arms(self, xp: Any = jnp) -> tuple[Array, Array]:
        """Joints C_i in the platform's axes."""
        return polar(self.joint_radius, self.joint_angle, xp)

    def size(self) -> float:
        """Distance of opposite pivots."""
        return 2 * float(np.max(self.pivot_radius))

    def carriers(self, near_mass: Array, xp: Any = np) -> tuple[Crank, ...]:
        """The cranks."""
        pivots = xp.stack(polar(self.pivot_radius, self.pivot_angle, xp), axis=1)
        return cranks(pivots, self.crank_length, self.zero_angle, self.elbow, near_mass, xp)

    def legs(self, xp: Any = jnp) -> Cranks:
        """A_i = r_i (cos, sin) of the pivot's direction."""
        x, y = polar(self.pivot_radius, self.pivot_angle, xp)
        return crank_legs(x, y, self.crank_length, self.elbow, self.zero_angle, xp)


#: Directions of the pivots from O that `pivot_turn` counts from [deg].
DIRECTIONS = (90.0, 210.0, 330.0)
#: Of every crank.
CRANK_PARAMETERS = (
    Parameter("crank_length", 0.16, "m", "of the crank", 1e-3, 10.0),
    Parameter("crank_inertia", 4e-3, "kg m2", "of crank and motor about the pivot", 1e-8, 1e3),
)
PARAMETERS = (
    Parameter("pivot_radius", 0.3, "m", "distance of the pivot from the origin", 0.01, 10.0),
    Parameter("pivot_turn", 0.0, "deg", "pivot's direction from 90, 210, 330 deg", -180.0, 180.0),
    *CRANK_PARAMETERS,
    Parameter("elbow", 1.0, "1", "1: the link lies to the left of the crank, -1: right", -1.0, 1.0),
)


def build(own: dict[str, Array], machine: dict[str, Array], xp: Any) -> tuple[CrankGeometry, Array]:
    """rho = 0 where a crank points to the origin; inertia over a^2 is a mass at B."""
    pivot = xp.radians(xp.asarray(DIRECTIONS) + own["pivot_turn"])
    length = own["crank_length"]
    return CrankGeometry(
        pivot_radius=own["pivot_radius"],
        pivot_angle=pivot,
        crank_length=length,
        elbow=xp.where(own["elbow"] < 0, -1.0, 1.0),
        zero_angle=pivot + xp.pi,
        joint_radius=machine["joint_radius"],
        joint_angle=machine["joint_angle"],
    ), own["crank_inertia"] / length**2
