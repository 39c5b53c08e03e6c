"""Hysteresis of the actuators: play operators between the voltage on a patch and its force.

A patch pushes as if v + w sum_n P_n[v] were on it (Prandtl-Ishlinskii, without saturation):
P_n moves with v once v has used up the play of r_n to either side, so that small signals see the
nominal d31 and cycles near the voltage limit open loops. Four equally spaced plays r_n with equal
weights approximate the Rayleigh law of ferroelectrics, whose slope grows in proportion to the field
(Damjanovic 1998; Kuhnen 2003). Within a plant step v runs from one value to another without
turning, so the plays at its end are exact however long it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num

#: r_n over the voltage limit [1].
PLAYS = (0.125, 0.375, 0.625, 0.875)
#: Largest width of the loop [1]; towards 1/2 the weights become infinite.
WIDEST = 0.3


class Hysteresis(NamedTuple):
    """Play operators, the same for every actuator."""

    play: Num[Array, "N"]  # r_n [V]
    weight: Num[Array, ""]  # w [1]


def design_hysteresis(width: Array, limit: Array) -> Hysteresis:
    """Operators whose loop over +-limit has a given width.

    There P_n opens by 2 min(r_n, limit - r_n) and reaches limit - r_n, so that
    width = w sum min(r_n, limit - r_n)/(limit + w sum (limit - r_n)).

    Args:
        width: largest distance of rising and falling branch over the range of the force, in cycles
            of +-limit, 0 to `WIDEST` [1], ().
        limit: of the actuators' voltage [V], ().
    """
    plays = np.array(PLAYS)
    opening, reach = float(np.sum(np.minimum(plays, 1 - plays))), float(np.sum(1 - plays))
    return Hysteresis(play=plays * limit, weight=width / (opening - width * reach))


def advance_plays(hysteresis: Hysteresis, plays: Array, voltage: Array) -> Array:
    """P_n once the voltage has gone to another value without turning.

    Args:
        hysteresis: the operators.
        plays: before [V], (N, 3, K).
        voltage: now [V], (3, K).

    Returns:
        [V], (N, 3, K); differentiable but where a play is just used up.
    """
    slack = hysteresis.play[:, None, None]
    return jnp.clip(plays, voltage - slack, voltage + slack)


def added_voltage(hysteresis: Hysteresis, plays: Array) -> Array:
    """What the plays add to the voltages by which actuators act, w sum P_n [V], (3, K)."""
    return hysteresis.weight * jnp.sum(plays, axis=0)


def slope_at_limit(width: float) -> float:
    """Force per volt over cycles of +-limit, over that of small signals [1]."""
    operators = design_hysteresis(width, 1.0)
    return 1 + float(np.sum(operators.weight * (1 - np.array(PLAYS))))
