"""Velocity (and position) estimates of the sampled controller, one filter chain per channel.

Every estimator is a first-order section followed by a second-order one, so that only their
coefficients differ. The second section keeps its state before the numerators, so it serves two
outputs.

- `modal_phase`: high-pass (Tustin) times low-pass (Tustin, prewarped) whose output a q + b q' is
  chosen so that analogue electronics, delay, hold and filter together are exactly j omega at the
  assembled frequency omega of the mode: exact amplitude and phase where the mode vibrates.
- `difference`: backward difference behind a first-order low-pass. A warning, not a proposal: it
  destabilises the paper's gains on a plant with seven modes or more.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Electronics
from jaxmodel.electronics import measurement_chain
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num

KINDS = ("modal_phase", "difference")


class Estimator(NamedTuple):
    """Coefficients per channel; z^-1 polynomials, leading denominator term 1."""

    # numerator b0, b1 and denominator a1
    first: tuple[Num[Array, "links C"], Num[Array, "links C"], Num[Array, "links C"]]
    denominator: tuple[Num[Array, "links C"], Num[Array, "links C"]]  # a1, a2 of the second section
    # its numerator for the velocity
    velocity: tuple[Num[Array, "links C"], Num[Array, "links C"], Num[Array, "links C"]]
    # and for the position
    position: tuple[Num[Array, "links C"], Num[Array, "links C"], Num[Array, "links C"]]
    direct: Num[Array, "links C"]  # share of the raw channel signal in the position


def design_estimator(
    omega: Array, electronics: Electronics, lowpass_ratio: Array, lowpass_zeta: Array
) -> Estimator:
    """Design either kind of estimator, selected by a traced index.

    Args:
        omega: assembled frequency at which the chain is exact [rad/s], (3, C).
        electronics: kind, sample time, filters; what lies between command and sample.
        lowpass_ratio: kappa, low-pass corner over omega [1], () or (C,).
        lowpass_zeta: damping of the low-pass [1], () or (C,).

    Returns:
        Estimator.
    """
    phase = _modal_phase(omega, electronics, lowpass_ratio, lowpass_zeta)
    plain = _difference(omega, electronics.period, electronics.difference_cutoff)
    is_phase = jnp.asarray(electronics.estimator) == KINDS.index("modal_phase")

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(is_phase, a, b)

    return Estimator(
        first=tuple(map(choose, phase.first, plain.first)),
        denominator=tuple(map(choose, phase.denominator, plain.denominator)),
        velocity=tuple(map(choose, phase.velocity, plain.velocity)),
        position=tuple(map(choose, phase.position, plain.position)),
        direct=choose(phase.direct, plain.direct),
    )


def second_order(corner: Array, zeta: Array, period: Array) -> tuple[Array, Array, Array]:
    """Low-pass w^2/(s^2 + 2 zeta w s + w^2) by Tustin, s = c (z-1)/(z+1), exact at w.

    Args:
        corner: w [rad/s], below half the sample rate.
        zeta: damping [1].
        period: sample time T [s].

    Returns:
        (low, a1, a2) of low (1 + z^-1)^2/(1 + a1 z^-1 + a2 z^-2).
    """
    warp = jnp.tan(corner * period / 2)  # w/c
    lead = 1 + 2 * zeta * warp + warp * warp
    a1, a2 = 2 * (warp * warp - 1) / lead, (1 - 2 * zeta * warp + warp * warp) / lead
    return warp * warp / lead, a1, a2


class FilterState(NamedTuple):
    """What the filters remember from sample to sample."""

    first: Num[Array, "links C"]  # of the first-order section
    # delay line of the second-order section
    second: tuple[Num[Array, "links C"], Num[Array, "links C"]]


def advance_filters(
    estimator: Estimator, state: FilterState, channel: Array
) -> tuple[FilterState, tuple[Array, Array, Array]]:
    """Filters one sample on, and the delay line of which estimates are sums.

    Args:
        estimator: coefficients.
        state: from the last sample.
        channel: the channels' signals, (3, C).
    """
    b0, b1, a1 = estimator.first
    high = b0 * channel + state.first
    newest = high - estimator.denominator[0] * state.second[0]
    newest = newest - estimator.denominator[1] * state.second[1]
    after = FilterState(b1 * channel - a1 * high, (newest, state.second[0]))
    return after, (newest, *state.second)


def weighted(numerator: tuple[Array, Array, Array], line: tuple[Array, Array, Array]) -> Array:
    """An estimate from the delay line, (3, C)."""
    return sum(n * x for n, x in zip(numerator, line, strict=True))


def responses(estimator: Estimator, z: Array) -> tuple[Array, Array]:
    """H_v(z) [1/s] and H_p(z) [1], estimates of rate and value per value.

    Args:
        estimator: coefficients, (3, C) each.
        z: complex, (3, C).
    """
    back = 1 / z
    b0, b1, a1 = estimator.first
    second = 1 + estimator.denominator[0] * back + estimator.denominator[1] * back**2
    shared = (b0 + b1 * back) / ((1 + a1 * back) * second)
    rate, value = (
        shared * (n0 + n1 * back + n2 * back**2)
        for n0, n1, n2 in (estimator.velocity, estimator.position)
    )
    return rate, value + estimator.direct


def _modal_phase(omega: Array, electronics: Electronics, kappa: Array, zeta: Array) -> Estimator:
    period = electronics.period
    zeta = jnp.broadcast_to(zeta, omega.shape)
    # high-pass s/(s + w) by Tustin
    half = electronics.highpass * period / 2
    gain, pole = 1 / (1 + half), (half - 1) / (1 + half)
    first = (gain * jnp.ones_like(omega), -gain * jnp.ones_like(omega), pole * jnp.ones_like(omega))
    # its numerator is low (1 + z^-1)^2; that of s LP is c low (1 - z^-2)
    low, a1, a2 = second_order(kappa * omega, zeta, period)

    z = jnp.exp(-1j * omega * period)  # z^-1 on the unit circle
    high_response = first[0] * (1 - z) / (1 + first[2] * z)
    low_response = low * (1 + z) ** 2 / (1 + a1 * z + a2 * z * z)
    chain = measurement_chain(omega, electronics) * high_response * low_response
    rate = jnp.tan(omega * period / 2)  # (z-1)/(z+1) = j tan(omega T/2)

    def numerator(target: Array) -> tuple[Array, Array, Array]:
        ratio = target / chain
        value, slope = jnp.real(ratio), jnp.imag(ratio) / rate
        return low * (value + slope), low * 2 * value, low * (value - slope)

    return Estimator(
        first=first,
        denominator=(a1, a2),
        velocity=numerator(1j * omega),
        position=numerator(1.0 + 0j * omega),
        direct=jnp.zeros_like(omega),
    )


def _difference(omega: Array, period: Array, cutoff: Array) -> Estimator:
    one, zero = jnp.ones_like(omega), jnp.zeros_like(omega)
    pole = jnp.exp(-cutoff * period)
    gain = (1 - pole) / period
    return Estimator(
        first=(gain * one, -gain * one, -pole * one),
        denominator=(zero, zero),
        velocity=(one, zero, zero),
        position=(zero, zero, zero),
        direct=one,
    )
