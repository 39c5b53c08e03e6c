"""The analogue electronics between patches and converters, and their effect on a vibration.

A sensor patch is a capacitance C drained by the input R of its amplifier: the controller sees the
voltage behind a high-pass of corner 1/(R C), then behind the anti-alias filter. A command passes
an amplifier, a first-order lag, before it bends a link.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.case import Electronics
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array

#: Sample period over lag above which the linearised loop treats an amplifier as infinitely fast.
FASTEST = 1e3
_SERIES = 20  # terms for arguments up to 1


class Amplifier(NamedTuple):
    """Remainder of a change of command during one plant step, 1 at its start [1]."""

    course: Array  # at start, middle and end of a parabola with the same effect, (3,)
    left: Array  # at the end, exp(-h/lag), ()


def measurement_chain(omega: Array, electronics: Electronics) -> Array:
    """Response from command to sampled signal at omega [rad/s], without the links.

    R = A H B exp(-j omega T (1/2 + 1)) sinc(omega T/2): amplifier 1/(1 + j omega lag), high-pass
    j omega/(j omega + omega_h), Butterworth anti-alias filter, delay of one sample, hold.
    """
    period = electronics.period
    s = 1j * omega / electronics.antialias
    hold = jnp.sin(omega * period / 2) / (omega * period / 2)
    late = hold * jnp.exp(-1.5j * omega * period) / (s * s + jnp.sqrt(2.0) * s + 1)
    seen = 1j * omega / (1j * omega + electronics.sensor_highpass)
    return late * seen / (1 + 1j * omega * electronics.amplifier_lag)


def design_amplifier(step: Array, lag: Array) -> Amplifier:
    """Amplifier over one plant step.

    exp(-t/lag) is replaced by the parabola that equals it in its first three moments over the
    step, so that links get the right impulse however short the lag: sampling the exponential
    itself at the three instants would leave a fast amplifier a sixth of a step behind.

    Args:
        step: h [s], ().
        lag: time constant of the amplifier [s], (); 0: no lag.

    Returns:
        Amplifier.
    """
    is_slow = lag > 0
    rate = step / jnp.where(is_slow, lag, step)
    # int_0^1 exp(-rate (1 - s)) s^(k-1)/(k-1)! ds, the moments about the end of the step
    phi = _phi(rate)
    a, b, c = phi[0], phi[1], 2 * phi[2]
    backwards = (9 * a - 36 * b + 30 * c, -1.5 * a + 15 * b - 15 * c, 3 * a - 24 * b + 30 * c)
    return Amplifier(
        jnp.where(is_slow, jnp.stack(backwards[::-1]), 0.0), jnp.where(is_slow, jnp.exp(-rate), 0.0)
    )


def _phi(rate: Array) -> list[Array]:
    """phi_1..phi_3(-rate) with phi_k(x) = sum x^n/(n + k)!, rate > 0."""
    is_small = rate < 1
    small, large = jnp.where(is_small, rate, 1.0), jnp.where(is_small, 1.0, rate)
    result, last = [], jnp.exp(-large)
    factorial = np.cumprod([1.0, *range(1, _SERIES + 3)])
    for k in (1, 2, 3):
        last = (1 / factorial[k - 1] - last) / large
        series = jnp.zeros_like(small)
        for n in reversed(range(_SERIES)):
            series = series * -small + 1 / factorial[n + k]
        result.append(jnp.where(is_small, series, last))
    return result
