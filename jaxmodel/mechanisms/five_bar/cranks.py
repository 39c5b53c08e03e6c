"""Two cranks whose links meet in the point X = (x, y)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.mechanisms.carriers import Crank, cranks
from jaxmodel.mechanisms.rrr.cranks import CRANK_PARAMETERS, Cranks, crank_legs
from jaxmodel.parameters import Array, Num, PerLink
from jaxmodel.table import Parameter


class FiveBarGeometry(NamedTuple):
    """Cranks about pivots on the x axis, on either side of O."""

    pivot_distance: PerLink  # of each pivot from O [m]
    crank_length: PerLink  # a [m]
    elbow: Num[Array, "links"]  # 1 or -1, see `Cranks`
    zero_angle: Num[Array, "links"]  # direction of a crank at rho = 0 [rad]

    def arms(self, xp: Any = jnp) -> None:
        """The links meet in a point."""

    def size(self) -> float:
        """From one crank's far side to the other's."""
        return 2 * float(np.max(self.pivot_distance) + np.max(self.crank_length))

    def carriers(self, near_mass: Array, xp: Any = np) -> tuple[Crank, ...]:
        """The crank on the left, and that on the right."""
        pivots = xp.stack(self._pivots(xp), axis=1)
        return cranks(pivots, self.crank_length, self.zero_angle, self.elbow, near_mass, xp)

    def legs(self, xp: Any = jnp) -> Cranks:
        """A_1 on the left, A_2 on the right."""
        x, y = self._pivots(xp)
        return crank_legs(x, y, self.crank_length, self.elbow, self.zero_angle, xp)

    def _pivots(self, xp: Any) -> tuple[Array, Array]:
        return xp.asarray([-1.0, 1.0]) * xp.asarray(self.pivot_distance), xp.zeros(2)


PARAMETERS = (
    Parameter("pivot_distance", 0.1, "m", "distance of the pivot from the origin", 0.005, 5.0),
    *CRANK_PARAMETERS,
)


def build(
    own: dict[str, Array], machine: dict[str, Array], xp: Any
) -> tuple[FiveBarGeometry, Array]:
    """Elbows point outwards; rho = 0 where a crank points up."""
    length = own["crank_length"]
    each = xp.ones_like(length)
    return FiveBarGeometry(
        pivot_distance=own["pivot_distance"],
        crank_length=length,
        elbow=each * xp.asarray([-1.0, 1.0]),
        zero_angle=each * np.pi / 2,
    ), own["crank_inertia"] / length**2
