"""Input shapers: impulse sequences that leave a flexible mode at rest after a move.

Amplitudes sum to one, times count from 0. Sources: Singer and Seering 1990 (ZV, ZVD, ZVDD);
Singhose, Seering and Singer 1994 (EI); Singhose, Porter, Tuttle and Singer 1997 (two and three
humps); the paper, section 3.1.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import NamedTuple

import numpy as np

from jaxmodel.checks import check_below
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.table import Table


class Impulses(NamedTuple):
    """A shaper: n impulses.

    An impulse of zero amplitude is padding and has no effect anywhere.
    """

    amplitude: Num[Array, "n"]  # [1]
    time: Num[Array, "n"]  # [s]


class Shaper(NamedTuple):
    """A kind of shaper."""

    name: str
    length: int  # impulses [1]
    impulses: Callable[[Array, Array, Array], Impulses]  # of omega, zeta and the tolerance V


class Taps(NamedTuple):
    """A shaper on the sample grid, m taps."""

    weight: Num[Array, "m"]  # [1]
    sample: Num[Array, "m"]  # delay [samples]


def _root(x: Array) -> Array:
    """Return sqrt(max(x, 0)), with gradient zero where x <= 0."""
    x = jnp.asarray(x)
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)


def damped_frequency(omega: Array, zeta: Array) -> Array:
    """Return w_d = w sqrt(1 - z^2) [rad/s] of a mode omega [rad/s], zeta in [0, 1) [1]."""
    return jnp.sqrt(1 - jnp.square(zeta)) * omega


def _half_periods(n: int, omega: Array, zeta: Array) -> Array:
    """Return the times k T_d/2 = k pi/w_d, k = 0..n-1 [s], shape (n,)."""
    return jnp.arange(n) * (np.pi / damped_frequency(omega, zeta))


def _zero_vibration(order: int, omega: Array, zeta: Array) -> Impulses:
    zeta = jnp.asarray(zeta)
    decay = jnp.pi * zeta / jnp.sqrt(1 - jnp.square(zeta))
    binomial = jnp.array([comb(order, k) for k in range(order + 1)])
    amplitude = binomial * jnp.exp(-decay * jnp.arange(order + 1)) / (1 + jnp.exp(-decay)) ** order
    return Impulses(amplitude, _half_periods(order + 1, omega, zeta))


def none() -> Impulses:
    """Return the single impulse that leaves a motion unchanged, shape (1,)."""
    return Impulses(jnp.ones(1), jnp.zeros(1))


def zv(omega: Array, zeta: Array) -> Impulses:
    """Return the zero-vibration shaper, shape (2,).

    A_k = K^k/(1 + K) at k T_d/2, K = exp(-z pi/sqrt(1 - z^2)). Singer and Seering 1990.

    Args:
        omega: natural frequency of the mode [rad/s], shape ().
        zeta: its damping ratio, in [0, 1) [1], shape ().
    """
    return _zero_vibration(1, omega, zeta)


def zvd(omega: Array, zeta: Array) -> Impulses:
    """Return the shaper with zero vibration and zero slope, shape (3,).

    A_k = C(2, k) K^k/(1 + K)^2 at k T_d/2. Arguments as in `zv`.
    """
    return _zero_vibration(2, omega, zeta)


def zvdd(omega: Array, zeta: Array) -> Impulses:
    """Return the shaper with zero vibration and two zero derivatives, shape (4,).

    A_k = C(3, k) K^k/(1 + K)^3 at k T_d/2. Arguments as in `zv`.
    """
    return _zero_vibration(3, omega, zeta)


def ei(omega: Array, zeta: Array, tolerance: Array) -> Impulses:
    """Return the paper's extra-insensitive shaper (13), shape (3,).

    A = [(1 + V)/4, (1 - V)/2, (1 + V)/4] at [0, T_d/2, T_d]: amplitudes of the undamped mode, times
    of the damped one. Good up to zeta = 0.05; beyond that, use `ei_damped`.

    Args:
        omega: natural frequency of the mode [rad/s], shape ().
        zeta: its damping ratio, in [0, 1) [1], shape ().
        tolerance: V, residual vibration accepted at omega, in [0, 1) [1], shape ().

    Raises:
        ValueError: a number out of its range, unless it is traced.

    Example:
        >>> impulses = ei(700.0, 0.01, 0.05)
        >>> len(impulses.amplitude), round(float(jnp.sum(impulses.amplitude)), 12)
        (3, 1.0)
    """
    for name, value, low, high, unit in (
        ("omega", omega, 1e-300, np.inf, "rad/s"),
        ("zeta", zeta, 0.0, 1.0, "1"),
        ("tolerance", tolerance, 0.0, 1.0, "1"),
    ):
        check_below(name, value, low, high, unit)
    tolerance = jnp.asarray(tolerance)
    outer = (1 + tolerance) / 4
    return Impulses(jnp.stack([outer, (1 - tolerance) / 2, outer]), _half_periods(3, omega, zeta))


def ei_damped(omega: Array, zeta: Array, tolerance: Array) -> Impulses:
    """Return the extra-insensitive shaper of a damped mode, shape (3,).

    A_1, A_3 and t_2/T_d are polynomials in V and z that Singhose fitted to the exact solution,
    A_2 = 1 - A_1 - A_3, t_3 = T_d. The residual vibration at omega is V within 6 % of it for z up
    to 0.3 and V from 0.05 to 0.15. Arguments as in `ei`.
    """
    v, z = jnp.asarray(tolerance), jnp.asarray(zeta)
    first = (
        0.249684
        + 0.249623 * v
        + 0.800081 * z
        + 1.23328 * v * z
        + 0.495987 * z**2
        + 3.17316 * v * z**2
    )
    third = (
        0.251489
        + 0.21474 * v
        - 0.832493 * z
        + 1.41498 * v * z
        + 0.851806 * z**2
        - 4.90094 * v * z**2
    )
    middle = (
        0.499899
        + 0.461586 * v * z
        + 4.26169 * v * z**2
        + 1.75601 * v * z**3
        + 8.57843 * v**2 * z
        - 108.644 * v**2 * z**2
        + 336.989 * v**2 * z**3
    )
    period = 2 * np.pi / damped_frequency(omega, z)
    return Impulses(
        jnp.stack([first, 1 - first - third, third]),
        period * jnp.stack([jnp.zeros_like(middle), middle, jnp.ones_like(middle)]),
    )


def ei2(omega: Array, zeta: Array, tolerance: Array) -> Impulses:
    """Return the two-hump extra-insensitive shaper, shape (4,).

    A_1 = A_4 = (3 X^2 + 2 X + 3 V^2)/(16 X), A_2 = A_3 = 1/2 - A_1 at k T_d/2, with
    X = [V^2 (sqrt(1 - V^2) + 1)]^(1/3): amplitudes of the undamped mode. Singhose, Porter,
    Tuttle and Singer 1997. Arguments as in `ei`.
    """
    v = jnp.asarray(tolerance)
    c = 1 + _root(1 - v**2)
    x = jnp.where(v > 0, jnp.cbrt(jnp.where(v > 0, v**2 * c, 1)), 0)
    # V^2/X = X^2/c avoids dividing by X: at V = 0 the shaper becomes the ZVDD.
    outer = (2 + 3 * x + 3 * x**2 / c) / 16
    inner = 0.5 - outer
    return Impulses(jnp.stack([outer, inner, inner, outer]), _half_periods(4, omega, zeta))


def ei3(omega: Array, zeta: Array, tolerance: Array) -> Impulses:
    """Return the three-hump extra-insensitive shaper, shape (5,).

    A_1 = A_5 = [1 + 3 V + 2 sqrt(2 (V^2 + V))]/16, A_2 = A_4 = (1 - V)/4, A_3 = 1 - 2 (A_1 + A_2)
    at k T_d/2: amplitudes of the undamped mode. Source as for `ei2`. Arguments as in `ei`.
    """
    v = jnp.asarray(tolerance)
    outer = (1 + 3 * v + 2 * _root(2 * (v**2 + v))) / 16
    inner = (1 - v) / 4
    middle = 1 - 2 * (outer + inner)
    return Impulses(jnp.stack([outer, inner, middle, inner, outer]), _half_periods(5, omega, zeta))


#: To add one: its function above, and an entry here.
SHAPERS = Table(
    "shaper",
    (
        Shaper("none", 1, lambda omega, zeta, tolerance: none()),
        Shaper("zv", 2, lambda omega, zeta, tolerance: zv(omega, zeta)),
        Shaper("zvd", 3, lambda omega, zeta, tolerance: zvd(omega, zeta)),
        Shaper("zvdd", 4, lambda omega, zeta, tolerance: zvdd(omega, zeta)),
        Shaper("ei", 3, ei),
        Shaper("ei_damped", 3, ei_damped),
        Shaper("ei2", 4, ei2),
        Shaper("ei3", 5, ei3),
    ),
)
#: Number of impulses of the longest shaper.
MAX_IMPULSES = max(shaper.length for shaper in SHAPERS.values())


def design_shaper(kind: Array, omega: Array, zeta: Array, tolerance: Array) -> Impulses:
    """Return the shaper of the given kind, padded with zero amplitudes to `MAX_IMPULSES`.

    Args:
        kind: position in `SHAPERS`, may be traced [1], shape ().
        omega: natural frequency of the mode [rad/s], shape ().
        zeta: its damping ratio, in [0, 1) [1], shape ().
        tolerance: V of the extra-insensitive kinds, in [0, 1) [1], shape ().
    """
    designed = [shaper.impulses(omega, zeta, tolerance) for shaper in SHAPERS.values()]

    def select(field: int) -> Array:
        rows = [jnp.pad(s[field], (0, MAX_IMPULSES - len(s[field]))) for s in designed]
        return jnp.stack(rows)[kind]

    return Impulses(select(0), select(1))


def shaper_duration(impulses: Impulses) -> Array:
    """Return the time of the last impulse with non-zero amplitude, t_n [s], shape ()."""
    return jnp.max(jnp.where(impulses.amplitude != 0, impulses.time, 0))


def _neighbours(impulses: Impulses, period: Array) -> tuple[Array, Array, Array]:
    """Return the samples (2n,) around each impulse and the time from and to them [s], (n,) each."""
    earlier = jnp.floor(impulses.time / period)
    since = impulses.time - earlier * period
    samples = jnp.concatenate([earlier, earlier + 1]).astype(int)
    return samples, since, jnp.asarray(period) - since


def split_linear(impulses: Impulses, period: Array) -> Taps:
    """Return the shaper on a sample grid, each impulse split linearly between two samples.

    A (1 - f) at sample k and A f at k + 1, f = t/T - k. Keeps the mean delay, not the zeros.

    Args:
        impulses: shaper, shape (n,).
        period: T, sample period [s], shape ().

    Returns:
        Taps of shape (2n,).
    """
    samples, since, until = _neighbours(impulses, period)
    shares = jnp.concatenate([until, since]) / period
    return Taps(shares * jnp.tile(impulses.amplitude, 2), samples)


def split_exact(impulses: Impulses, period: Array, omega: Array, zeta: Array) -> Taps:
    """Return the shaper on a sample grid, each impulse split so that one mode sees no difference.

    A e^{z w (t - t_k)} sin(w_d (t_{k+1} - t))/sin(w_d T) at sample k and
    A e^{-z w (t_{k+1} - t)} sin(w_d (t - t_k))/sin(w_d T) at k + 1, both divided by their total so
    that the weights sum to one. Needs w_d T < pi: a sample period below half a period of the mode.

    Args:
        impulses: shaper, shape (n,).
        period: T, sample period [s], shape ().
        omega: natural frequency of the mode [rad/s], shape ().
        zeta: its damping ratio, in [0, 1) [1], shape ().

    Returns:
        Taps of shape (2n,).
    """
    samples, since, until = _neighbours(impulses, period)
    decay, w_d = jnp.multiply(omega, zeta), damped_frequency(omega, zeta)
    shares = jnp.concatenate(
        [
            jnp.exp(decay * since) * jnp.sin(w_d * until),
            jnp.exp(-decay * until) * jnp.sin(w_d * since),
        ]
    )
    weight = shares * jnp.tile(impulses.amplitude, 2)
    return Taps(weight / jnp.sum(weight), samples)


def last_sample(taps: Taps) -> Array:
    """Return the delay of the last tap with non-zero weight [samples], shape ()."""
    return jnp.max(jnp.where(taps.weight != 0, taps.sample, 0))


def in_series(first: Taps, second: Taps) -> Taps:
    """Return both sampled shapers in series, W_i V_j at n_i + m_j samples, shape (n m,)."""
    return Taps(
        jnp.outer(first.weight, second.weight).ravel(),
        jnp.add.outer(first.sample, second.sample).ravel(),
    )


def residual_vibration(impulses: Impulses, omega: Array, zeta: Array) -> Array:
    """Return the vibration left by the shaper, relative to that of a unit impulse [1].

    V = e^{-z w t_n} sqrt(C^2 + S^2), C = sum A_i e^{z w t_i} cos(w_d t_i), S the same with sin:
    (10) with the squares outside the sums and the decay counted once. Gradient zero where V = 0.

    Args:
        impulses: shaper, shape (n,).
        omega: natural frequency [rad/s], shape (...,).
        zeta: damping ratio, in [0, 1) [1], a shape that broadcasts with omega.

    Returns:
        V, in the broadcast shape.

    Example:
        >>> impulses = ei(700.0, 0.0, 0.05)
        >>> f"{residual_vibration(impulses, 700.0, 0.0):.2f}"  # the tolerance, at its own frequency
        '0.05'
    """
    end = shaper_duration(impulses)

    def at(omega: Array, zeta: Array) -> Array:
        weight = impulses.amplitude * jnp.exp(-zeta * omega * (end - impulses.time))
        angle = damped_frequency(omega, zeta) * impulses.time
        return _root(jnp.sum(weight * jnp.cos(angle)) ** 2 + jnp.sum(weight * jnp.sin(angle)) ** 2)

    return jnp.vectorize(at)(omega, zeta)


def sensitivity_curve(impulses: Impulses, ratio: Array, omega: Array, zeta: Array) -> Array:
    """Return (10) at the frequencies ratio * omega [1], in the shape of ratio.

    Args:
        impulses: shaper designed for omega, shape (n,).
        ratio: actual over assumed frequency [1], shape (...,).
        omega: assumed natural frequency [rad/s], shape ().
        zeta: damping ratio, in [0, 1) [1], shape ().
    """
    return residual_vibration(impulses, omega * jnp.asarray(ratio), zeta)


def insensitivity(impulses: Impulses, omega: Array, zeta: Array, level: Array = 0.05) -> Array:
    """Return the width of the band of frequencies with V below a level, in units of omega [1].

    Summed over the ratios from 0 to 2, so that a hump a little above the level, as (13) has on a
    damped mode, costs its own width only.

    Args:
        impulses: shaper designed for omega, shape (n,).
        omega: assumed natural frequency [rad/s], shape ().
        zeta: damping ratio, in [0, 1) [1], shape ().
        level: accepted residual vibration [1], shape ().
    """
    ratio = jnp.linspace(0, 2, 2001)
    excess = sensitivity_curve(impulses, ratio, omega, zeta) - level
    below, size = jnp.maximum(-excess, 0), jnp.abs(excess)
    # A straight line through both ends of a cell is below zero on this fraction of it.
    fraction = (below[1:] + below[:-1]) / (size[1:] + size[:-1])
    return jnp.sum(fraction * jnp.diff(ratio))
