"""Two cranks whose links meet in the point X = (x, y)."""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.lazy import jnp
from jaxmodel.mechanisms.rrr.cranks import Cranks
from jaxmodel.parameters import Array


class FiveBarGeometry(NamedTuple):
    """Cranks about pivots on the x axis, which are as far from O on either side."""

    pivot_distance: Array  # from one pivot to the other [m], ()
    crank_length: Array  # a [m], () or (2,)
    elbow: Array  # 1 or -1, see `Cranks`, (2,)
    zero_angle: Array  # direction of a crank at rho = 0 [rad], (2,)

    def arms(self) -> None:
        """The links meet in a point."""

    def legs(self) -> Cranks:
        """A_1 on the left, A_2 on the right."""
        zero = jnp.asarray(self.zero_angle)
        half = jnp.asarray(self.pivot_distance) / 2
        return Cranks(
            x=jnp.stack([-half, half]),
            y=jnp.zeros(2),
            length=jnp.broadcast_to(jnp.asarray(self.crank_length), zero.shape),
            elbow=jnp.asarray(self.elbow),
            zero_x=jnp.cos(zero),
            zero_y=jnp.sin(zero),
        )
