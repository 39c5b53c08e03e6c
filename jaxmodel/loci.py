"""The eigenvalues of L along the frequency axis, and where they make the loop unstable.

The loop with all gains times k has a pole on the imaginary axis where an eigenvalue of L(j omega)
is 1/k. So the gain margin is the inverse of the rightmost point at which one of the eigenvalues'
curves crosses the positive real axis (characteristic loci; MacFarlane and Postlethwaite 1977).
The curves turn no faster than the damping of the uncontrolled modes allows, so the frequencies to
visit are known beforehand. `follow_loci` is an elementwise step for the same executors as the loop
over samples; the iteration of Durand and Kerner carries eigenvalues from frequency to frequency.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from jaxmodel.lazy import jax, jnp
from jaxmodel.pairs import Pair
from jaxmodel.parameters import Array, Num
from jaxmodel.return_difference import (
    LoopGain,
    LoopResponse,
    characteristic_polynomial,
    evaluate_loop_gain,
)
from jaxmodel.sampled_loop import RADIUS_TOLERANCE

#: Iterations at each frequency.
ITERATIONS = 4
#: A value is close to the axis where its imaginary part is less than this share of its real one.
CLOSE = 0.2


class Loci(NamedTuple):
    """State of the sweep: n eigenvalues, one for each channel."""

    value: Pair  # [1], (n,)
    omega: Num[Array, ""]  # where they have it [rad/s]; 0: nowhere yet
    # rightmost crossing of each curve by linear interpolation [1], and where [rad/s]; 0: none
    crossing: Num[Array, "n"]
    place: Num[Array, "n"]
    # largest value close to the axis, crossing or not [1], and where [rad/s]; 0: none
    close: Num[Array, "n"]
    close_at: Num[Array, "n"]


class FrequencyPoint(NamedTuple):
    """A frequency of the sweep."""

    omega: Num[Array, ""]  # [rad/s], rising, never 0
    cosine: Num[Array, ""]  # of omega T
    sine: Num[Array, ""]


def start_loci(value: Pair) -> Loci:
    """State before the first station, with first guesses, (n, ...)."""
    zero = 0 * value.re
    return Loci(value=value, omega=zero[0], crossing=zero, place=zero, close=zero, close_at=zero)


def follow_loci(constants: tuple[LoopResponse, Array], station: FrequencyPoint, loci: Loci) -> Loci:
    """Carry the eigenvalues to the next frequency.

    Args:
        constants: response of the loop; spread of `evaluate_loop_gain`, one for each channel.
        station: the next frequency.
        loci: so far.
    """
    response, spread = constants
    at = _axis(response, station.omega, station.cosine, station.sine)
    loop_gain = evaluate_loop_gain(response, *at, spread)
    value, last = _improve_values(loop_gain, loci.value), loci.value
    # where the straight line between two values meets the real axis
    rise = value.im - last.im
    was_above, is_above = last.im > 0, value.im > 0
    is_through = (was_above & ~is_above) | (is_above & ~was_above)
    share = jnp.where(is_through, -last.im / jnp.where(is_through, rise, 1.0), 0.0)
    meets = last.re + share * (value.re - last.re)
    is_more = is_through & (loci.omega > 0) & (meets > loci.crossing)
    is_close = (jnp.abs(value.im) < CLOSE * value.re) & (value.re > loci.close)
    return Loci(
        value=value,
        omega=station.omega,
        crossing=jnp.where(is_more, meets, loci.crossing),
        place=jnp.where(is_more, loci.omega + share * (station.omega - loci.omega), loci.place),
        close=jnp.where(is_close, value.re, loci.close),
        close_at=jnp.where(is_close, station.omega, loci.close_at),
    )


def _axis(response: LoopResponse, omega: Array, cosine: Array, sine: Array) -> tuple[Pair, Pair]:
    """s and exp(-s T) at the largest growth rate that counts as stable."""
    growth = RADIUS_TOLERANCE / response.period
    return Pair(growth + 0 * omega, omega), Pair(cosine, -sine) * (1 - RADIUS_TOLERANCE)


def loop_gain_on_axis(response: LoopResponse, omega: Array) -> LoopGain:
    """L(j omega), (...)."""
    angle = omega * response.period
    return evaluate_loop_gain(response, *_axis(response, omega, jnp.cos(angle), jnp.sin(angle)))


def _improve_values(loop_gain: LoopGain, values: Pair) -> Pair:
    """Eigenvalues improved one by one, each using the newest of the others (Durand, Kerner)."""

    @jax.jit  # kernels write it once
    def better(values: Pair) -> Pair:
        x = values[0]
        apart = x - values[1]
        for k in range(2, values.re.shape[0]):
            apart = apart * (x - values[k])
        return x - characteristic_polynomial(loop_gain, x) * apart.inverse()

    def improve(values: Pair, _: None) -> tuple[Pair, None]:
        x, join = better(values), jnp.concatenate
        return Pair(join([values.re[1:], x.re[None]]), join([values.im[1:], x.im[None]])), None

    return jax.lax.scan(improve, values, None, length=ITERATIONS * values.re.shape[0])[0]


class AxisCrossing(NamedTuple):
    """An estimate of where an eigenvalue is real and positive, to be refined."""

    omega: Num[Array, ""]  # [rad/s]
    value: Num[Array, ""]  # the eigenvalue, 1/k [1]
    cosine: Num[Array, ""]  # of omega T
    sine: Num[Array, ""]
    step: Num[Array, ""]  # the last one as a share of the largest allowed
    by_omega: Pair  # derivatives of det(x - L) by frequency and eigenvalue, ()
    by_value: Pair


class Crossing(NamedTuple):
    """Where an eigenvalue is real and positive."""

    value: Num[Array, ""]  # the eigenvalue [1], 0: nowhere
    omega: Num[Array, ""]  # [rad/s]
    by_omega: Pair  # slopes of det(x - L) there
    by_value: Pair


#: Largest steps of `refine_crossing`, as shares of frequency and eigenvalue.
STRIDE = (0.01, 0.2)
_TERMS = 8


def start_crossing(omega: Array, value: Array, cosine: Array, sine: Array) -> AxisCrossing:
    """State before the first step from a guess, see `AxisCrossing`, (...)."""
    zero = 0 * omega
    none = Pair(zero, zero)
    return AxisCrossing(
        omega=omega, value=value, cosine=cosine, sine=sine, step=zero, by_omega=none, by_value=none
    )


def refine_crossing(
    constants: tuple[LoopResponse, Crossing], _: tuple[()], crossing: AxisCrossing
) -> AxisCrossing:
    """A step of Newton's iteration on det(x - L(j omega)) = 0 for real omega and x.

    Args:
        constants: response of the loop; the point to divide out.
        crossing: so far.
    """
    response, known = constants
    omega, value, zero = crossing.omega, crossing.value, jnp.zeros_like(crossing.omega)
    one = jnp.ones_like(zero)
    at = _axis(response, omega, crossing.cosine, crossing.sine)
    shift = at[1]

    def remaining(loop_gain: LoopGain, omega: Array, x: Array) -> Pair:
        value = characteristic_polynomial(loop_gain, Pair(x, jnp.zeros_like(x)))
        away = known.by_omega * (omega - known.omega) + known.by_value * (x - known.value)
        is_there = jnp.where(known.value > 0, one, zero)
        return value * (away * is_there + (1 - is_there)).inverse()

    shift_rate = shift * Pair(zero, -response.period * one)  # d/d omega of exp(-j omega T)
    loop_gain, gain_rate = jax.jvp(
        partial(evaluate_loop_gain, response), at, (Pair(zero, one), shift_rate)
    )
    residual, by_omega = jax.jvp(partial(remaining, x=value), (loop_gain, omega), (gain_rate, one))
    _, by_value = jax.jvp(partial(remaining, loop_gain, omega), (value,), (one,))
    area = by_omega.re * by_value.im - by_omega.im * by_value.re
    over = 1 / jnp.where(area == 0, one, area)
    d_omega = (residual.im * by_value.re - residual.re * by_value.im) * over
    d_value = (residual.re * by_omega.im - residual.im * by_omega.re) * over
    step = jnp.maximum(
        jnp.abs(d_omega) / (STRIDE[0] * jnp.abs(omega)),
        jnp.abs(d_value) / (STRIDE[1] * jnp.abs(value)),
    )
    share = 1 / jnp.maximum(step, 1.0)
    d_omega, d_value = share * d_omega, share * d_value
    angle = Pair(zero, -response.period * d_omega)
    ahead = angle * (1 / _TERMS) + 1.0
    for n in range(_TERMS - 1, 0, -1):
        ahead = ahead * angle * (1 / n) + 1.0
    after = shift * ahead * (1 / (1 - RADIUS_TOLERANCE))
    return AxisCrossing(
        omega=omega + d_omega,
        value=value + d_value,
        cosine=after.re,
        sine=-after.im,
        step=step,
        by_omega=by_omega,
        by_value=by_value,
    )
