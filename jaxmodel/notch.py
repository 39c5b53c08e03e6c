"""Notch filters between sensors and feedback, one for each link.

(s^2 + d w omega s + omega^2)/(s^2 + w omega s + omega^2) by Tustin, prewarped so that frequency and
depth are exact: gain d at omega, width w of the stop band over omega. A sampled controller takes it
after the ADC and the feed-through, so it acts on all of a link's sensors alike.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Control
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num


class Notch(NamedTuple):
    """Coefficients of each link; z^-1 polynomials, leading denominator term 1."""

    b0: Num[Array, "links ..."]
    b1: Num[Array, "links ..."]
    b2: Num[Array, "links ..."]
    a1: Num[Array, "links ..."]
    a2: Num[Array, "links ..."]


#: Memory of the filters, of each sensor, (3, K) each.
NotchState = tuple[Array, Array]


def design_notch(control: Control, period: Array) -> Notch:
    """The notches of a case; a link whose frequency is 0 has none.

    Args:
        control: `notch` [rad/s], below half the sample rate, `notch_depth` and `notch_width` [1].
        period: T [s], ().
    """
    is_on = jnp.asarray(control.notch) > 0
    warp = jnp.tan(jnp.where(is_on, control.notch, 1.0) * period / 2)
    square, wide = warp * warp, control.notch_width * warp
    lead, middle = 1 / (1 + wide + square), 2 * (square - 1)
    shallow = control.notch_depth * wide

    def own(value: Array, otherwise: float) -> Array:
        return jnp.where(is_on, lead * value, otherwise)

    return Notch(
        b0=own(1 + shallow + square, 1.0),
        b1=own(middle, 0.0),
        b2=own(1 - shallow + square, 0.0),
        a1=own(middle, 0.0),
        a2=own(1 - wide + square, 0.0),
    )


def advance_notch(notch: Notch, state: NotchState, voltage: Array) -> tuple[NotchState, Array]:
    """One sample.

    Args:
        notch: coefficients.
        state: from the last sample.
        voltage: of the sensors [V], (3, K).

    Returns:
        (next state, filtered [V], (3, K)).
    """
    b0, b1, b2, a1, a2 = (x[:, None] for x in notch)
    after = b0 * voltage + state[0]
    return (b1 * voltage - a1 * after + state[1], b2 * voltage - a2 * after), after


def notch_response(notch: Notch, z: Array) -> Array:
    """Response of each link's filter [1], complex.

    Args:
        notch: coefficients, shaped to broadcast with z.
        z: complex.
    """
    back = 1 / z
    above = notch.b0 + notch.b1 * back + notch.b2 * back**2
    return above / (1 + notch.a1 * back + notch.a2 * back**2)
