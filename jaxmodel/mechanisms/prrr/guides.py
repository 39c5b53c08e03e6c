"""Guides: straight paths of the near joints, rho along them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.mechanisms.carriers import Rail
from jaxmodel.mechanisms.contract import SINGULAR_MARGIN, Near, polar, safe_root
from jaxmodel.parameters import Array, Num, PerLink

#: Home pose (x [m], y [m], phi [rad]) of the paper.
HOME = (0.0, 0.0, np.pi / 6)
#: Body angles psi [rad] of the platform joints for the two assemblies that fit the paper's text.
ASSEMBLIES = {
    "inward": (np.pi / 2, 7 * np.pi / 6, 11 * np.pi / 6),
    "outward": (3 * np.pi / 2, np.pi / 6, 5 * np.pi / 6),
}


class Guides(NamedTuple):
    """Guide i starts at A_i and runs along u_i; s = u.C + s0, h = n.C + h0."""

    ux: Num[Array, "links"]  # direction [1]
    uy: Num[Array, "links"]
    s0: Num[Array, "links"]  # -u.A [m]
    h0: Num[Array, "links"]  # -n.A [m]

    def side(self, gamma: Array) -> Array:
        """A link along its guide is about to change to the other side of it."""
        return gamma

    def near(self, x: Array, y: Array, squared: Array, floor: Array, xp: Any = jnp) -> Near:
        """P = sqrt(l2 - h^2), rho = s - P."""
        s = self.ux * x + self.uy * y + self.s0
        h = self.ux * y - self.uy * x + self.h0
        root_squared = squared - h * h
        root = safe_root(root_squared, floor, xp)
        return Near(
            x=self.ux, y=self.uy, root=root, root_squared=root_squared, across=h, position=s - root
        )

    def misplaced(self, x: np.ndarray, y: np.ndarray, length: np.ndarray) -> list[str]:
        """Joints outside their guide, or beyond the link's length inside it."""
        inside = self.near(x, y, length**2, 0.0, np).across
        return [
            f"link {i + 1} is {own:.4g} m long, its joint lies {h:.4g} m inside its guide"
            for i, (h, own) in enumerate(zip(inside, length, strict=True))
            if not SINGULAR_MARGIN <= h / own < np.sqrt(1 - SINGULAR_MARGIN**2)
        ]


class GuideGeometry(NamedTuple):
    """Guides and platform joints. The paper's guides are the sides of a triangle around O."""

    guide_side: Num[Array, ""]  # a [m]
    guide_angle: Num[Array, "links"]  # alpha [rad]
    joint_radius: PerLink  # distance platform centre - C_i [m]
    joint_angle: Num[Array, "links"]  # psi, body angle of C_i [rad]
    guide_offset: PerLink = 0.0  # how much further from O than the side a guide lies [m]

    def arms(self, xp: Any = jnp) -> tuple[Array, Array]:
        """Joints C_i in the platform's axes."""
        return polar(self.joint_radius, self.joint_angle, xp)

    def size(self) -> float:
        """Side of the triangle."""
        return float(self.guide_side)

    def carriers(self, near_mass: Array, xp: Any = np) -> tuple[Rail, ...]:
        """The guides, from corner to corner of the triangle."""
        angle, side = xp.asarray(self.guide_angle), xp.asarray(self.guide_side)
        offset, mass = (
            xp.broadcast_to(xp.asarray(x, float), angle.shape)
            for x in (self.guide_offset, near_mass)
        )
        along = xp.stack([xp.cos(angle), xp.sin(angle)], axis=1)
        inward = xp.stack([-along[:, 1], along[:, 0]], axis=1)
        return tuple(
            Rail(
                start=-(side / np.sqrt(12.0) + offset[i]) * inward[i] - side / 2 * along[i],
                direction=along[i],
                length=side,
                mass=mass[i],
            )
            for i in range(len(angle))
        )

    def legs(self, xp: Any = jnp) -> Guides:
        """A_i = -r_i n_i - (a/2) u_i, r_i = a/(2 sqrt 3) + the guide's offset."""
        angle = xp.asarray(self.guide_angle)

        def link(x: Array) -> Array:
            return xp.broadcast_to(xp.asarray(x), angle.shape)

        return Guides(
            ux=xp.cos(angle),
            uy=xp.sin(angle),
            s0=link(self.guide_side / 2),
            h0=link(self.guide_side / xp.sqrt(12.0) + self.guide_offset),
        )


def build(own: dict[str, Array], machine: dict[str, Array], xp: Any) -> tuple[GuideGeometry, Array]:
    """All of its numbers are those of `[machine]`."""
    names = GuideGeometry._fields
    return GuideGeometry(**{name: machine[name] for name in names}), machine["slider_mass"]
