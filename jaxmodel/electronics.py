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
from jaxmodel.parameters import Array, Num

#: Sample period over lag above which the linearised loop treats an amplifier as infinitely fast.
FASTEST = 1e3
_SERIES = 20  # terms for arguments up to 1


class Amplifier(NamedTuple):
    """Remainder of a change of command during one plant step, 1 at its start [1]."""

    course: Num[Array, "3"]  # at start, middle and end of a parabola with the same effect
    left: Num[Array, ""]  # at the end, exp(-h/lag)


def measurement_chain(omega: Array, electronics: Electronics) -> Array:
    """Response from command to sampled signal at omega [rad/s], without the links.

    R = A H B exp(-j omega T (1/2 + d)) sinc(omega T/2): amplifier 1/(1 + j omega lag), high-pass
    j omega/(j omega + omega_h), Butterworth anti-alias filter, delay of d samples as the controller
    knows it, hold.
    """
    period = electronics.period
    s = 1j * omega / electronics.antialias
    hold = jnp.sin(omega * period / 2) / (omega * period / 2)
    lag = -1j * (0.5 + electronics.delay)
    late = hold * jnp.exp(lag * omega * period) / (s * s + jnp.sqrt(2.0) * s + 1)
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
    rate = step / jnp.where(is_slow, lag, jnp.where(step > 0, step, 1.0))
    # int_0^1 exp(-rate (1 - s)) s^(k-1)/(k-1)! ds, the moments about the end of the step
    phi = _phi(rate)
    a, b, c = phi[0], phi[1], 2 * phi[2]
    backwards = (9 * a - 36 * b + 30 * c, -1.5 * a + 15 * b - 15 * c, 3 * a - 24 * b + 30 * c)
    return Amplifier(
        jnp.where(is_slow, jnp.stack(backwards[::-1]), 0.0), jnp.where(is_slow, jnp.exp(-rate), 0.0)
    )


#: Rows and columns of `voltage_passage`.
PASSED = ("z", "z_rate", "s", "remainder", "command")
_DOUBLINGS, _TERMS = 14, 10  # rates up to 1600/h become below 0.1, where ten terms are exact


def voltage_passage(
    step: Array, antialias: Array, highpass: Array | None, lag: Array | None
) -> Array:
    """How actuator voltages pass the patches' drain and the anti-alias filter in one plant step.

    A sensor answers at once to the modes that a model leaves out, so the actuators' voltages v
    reach the converters through the same analogue path as the modes: v = command + remainder,
    z'' = omega_f^2 (v - s - z) - sqrt(2) omega_f z', s' = omega_h (v - s), and the remainder of
    an amplifier's change decays at 1/lag. The exponential of that, exact for held commands, by
    scaling and squaring.

    Args:
        step: h [s], ().
        antialias: omega_f [rad/s], ().
        highpass: omega_h [rad/s], (); None: patches are not drained, s stays zero.
        lag: of the amplifiers [s], () (0: none); None: commands are on the actuators at once.

    Returns:
        Matrix on `PASSED`, (5, 5).
    """
    zero, one = jnp.zeros(()), jnp.ones(())
    drain = zero if highpass is None else zero + highpass
    is_slow = zero if lag is None else jnp.where(lag > 0, 1.0, 0.0)
    some = jnp.where(step > 0, step, 1.0)  # before a command that changes at once there is no time
    decay = zero if lag is None else 1 / jnp.maximum(jnp.where(lag > 0, lag, some), some / FASTEST)
    corner = zero + antialias
    rows = (
        (zero, corner, zero, zero, zero),
        (-corner, -np.sqrt(2.0) * corner, -corner, is_slow * corner, corner),
        (zero, zero, -drain, is_slow * drain, drain),
        (zero, zero, zero, -decay, zero),
        (zero, zero, zero, zero, zero),
    )
    x = jnp.stack([jnp.stack(row) for row in rows]) * (step / 2**_DOUBLINGS)
    identity = jnp.eye(len(rows), dtype=x.dtype)
    power = identity
    for n in reversed(range(_TERMS)):
        power = identity + x @ power / (n + 1)
    for _ in range(_DOUBLINGS):
        power = power @ power
    scale = jnp.stack([one, corner, one, one, one])
    return power * scale[:, None] / scale


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


def observed(by_q: Array, by_voltage: Array, q: Array, voltage: Array) -> Array:
    """What coordinates show, and voltages at once, (3, n)."""
    return jnp.sum(by_q * q[:, None], axis=2) + jnp.sum(by_voltage * voltage[:, None], axis=2)
