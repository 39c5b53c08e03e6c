"""Gain margins of many loops in one program.

Curves of eigenvalues are followed along the frequency axis (`jaxmodel.loci`), densely beside the
modes that are strong enough to matter. Their rightmost crossings of the positive real axis are
then found by Newton's iteration, repeated with the point found divided out, since similar links
have crossings close together. Loops in which something seen was not found, or a mode left out
could matter, are looked at again in a finer sweep. Shapes: structure first, lanes last.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.loci import (
    Crossing,
    FrequencyPoint,
    Loci,
    follow_loci,
    loop_gain_on_axis,
    refine_crossing,
    start_crossing,
    start_loci,
)
from jaxmodel.loop_figures import HIGHEST, LOWEST
from jaxmodel.pairs import Pair
from jaxmodel.parameters import Array, Num, Shaped
from jaxmodel.return_difference import (
    NARROWEST,
    AssembledModes,
    LoopResponse,
    characteristic_polynomial,
)
from jaxmodel.sampled_loop import RADIUS_TOLERANCE
from jaxmodel.steps import Steps, in_groups, lanes_of


class FrequencySweep(NamedTuple):
    """Frequencies of a sweep along the axis."""

    background: int  # between `LOWEST_HZ` and half the sample rate
    beside: np.ndarray  # next to each mode of the machine, multiples of its zeta omega
    modes: int  # the strongest ones


#: The sweep, and a finer one for loops in doubt.
SWEEPS = (
    FrequencySweep(160, np.tan(np.linspace(-1.47, 1.47, 12)), 20),
    FrequencySweep(400, np.tan(np.linspace(-1.5, 1.5, 24)), 1000),
)
LOWEST_HZ = 5.0
#: Replaces 0 [rad/s], where the hold would be 0/0.
STILL = 0.01
#: Separates the eigenvalues of idle channels, on the sweep and at the ends of the axis.
SPREAD, FINE_SPREAD = 1e-3, 1e-6
#: Beyond this an eigenvalue on the sweep was thrown away by another one and does not return [1].
FARTHEST = 1e6
#: Crossings examined per case, and as many points where a curve only comes close to the axis.
CHOSEN = 4
#: Guesses of the first eigenvalues are near 1: stronger loops are examined with weaker gains [1].
STRONG = 30.0
#: Modes left out may matter where the margin is not this many times stricter than theirs [1].
SAFE = 3.0
#: Steps of Newton's iteration, and the last step that counts as converged.
NEWTON, CONVERGED = 16, 1e-3
#: Starting points for crossings near the rightmost one found, as multiples of it.
AGAIN = (1.02, 1.1, 1.005)
#: A crossing seen on the sweep is in doubt if Newton's iteration ends farther from it than this
#: factor; a curve close to the axis counts beyond the rightmost crossing by at least the second.
NEAR, BEYOND = 1.2, 1.02
#: Visits at an end of the axis, and where a sweep begins.
VISITS = 24


class GainMargins(NamedTuple):
    """Of n loops."""

    margin: Num[Array, "n"]  # [1]
    omega: Num[Array, "n"]  # of what goes unstable there [rad/s], NaN: nothing
    is_static: Shaped[Array, "n"]  # whether that is the static stiffness
    is_known: Shaped[Array, "n"]  # whether the search saw all it had to


def gain_margins(
    response: LoopResponse, modes: AssembledModes, strength: tuple[Array, Array], steps: Steps
) -> GainMargins:
    """Largest factors on all gains with every smaller one stable.

    Args:
        response: of the loops, lanes last.
        modes: of the machines without control.
        strength: `loop_strength`, (n,), and `mode_strength`, (m, n).
        steps: runs elementwise steps.
    """
    whole, each = jax.lax.stop_gradient(strength)
    weaker = jnp.maximum(whole / STRONG, 1.0)
    moving = _with_gains(response, 1 / weaker)
    response, modes = jax.lax.stop_gradient((moving, modes))
    least = jnp.maximum(1 / (HIGHEST * weaker), SPREAD)
    at_end, where = _end_eigenvalues(response, least, steps)
    given = response, modes, each / weaker, least, at_end
    found = _search(given, SWEEPS[0], steps)

    def again(at: Array) -> tuple[Crossing, Array, Array]:
        return _search(lanes_of(given, at), SWEEPS[1], steps)

    crossing, is_doubtful, is_lost = in_groups(again, found[1], found)
    is_static = at_end > crossing.value
    value = jnp.where(is_static, at_end, crossing.value)
    omega = jnp.where(is_static, where, crossing.omega)
    breaks = value > least
    value = _moved(moving, jnp.where(breaks, value, 1.0), jnp.where(breaks, omega, STILL), breaks)
    margin = jnp.where(breaks, 1 / (weaker * value), HIGHEST)
    # even without control: the machine, or a filter of a mode too close to the sample rate
    falls = (modes.growth * response.period > RADIUS_TOLERANCE) | _filters_grow(response)
    is_finite = jnp.stack(
        [jnp.isfinite(x).reshape(-1, len(margin)).all(axis=0) for x in jax.tree.leaves(response)]
    ).all(axis=0)
    margin = jnp.where(falls | (margin < LOWEST), 0.0, margin)
    omega = jnp.where(falls, 0.0, jnp.where(breaks, omega, jnp.nan))
    is_blind = ~(breaks | falls) & (HIGHEST * weaker * SPREAD > 1)
    return GainMargins(
        margin=jnp.where(is_finite, margin, jnp.nan),
        omega=jnp.where(is_finite, omega, jnp.nan),
        is_static=is_static & (omega == 0) & ~falls,
        is_known=~(is_doubtful | is_lost | is_blind) | falls | ~is_finite,
    )


@jax.custom_jvp
def _moved(response: LoopResponse, value: Array, omega: Array, is_there: Array) -> Array:
    """Values of crossings, whose derivatives are those of det(x - L(j omega)) = 0.

    Args:
        response: of the loops.
        value, omega: of their crossings, or of L at an end of the axis, where it is real, (n,).
        is_there: whether loops have one, (n,).
    """
    return value


@_moved.defjvp
def _moved_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    response, value, omega, is_there = primals
    top = np.pi / response.period
    at = jnp.clip(omega, STILL, top * (1 - 1e-6))
    one, zero = jnp.ones_like(value), jnp.zeros_like(value)

    def difference(response: LoopResponse, at: Array, x: Array) -> Pair:
        return characteristic_polynomial(loop_gain_on_axis(response, at), Pair(x, zero))

    def slope(along: Any) -> Pair:
        change: Pair = jax.jvp(difference, (response, at, value), along)[1]
        return change

    still = jax.tree.map(jnp.zeros_like, response)
    by_omega, by_value = slope((still, one, zero)), slope((still, zero, one))
    push = slope((tangents[0], zero, zero))
    # at an end of the axis nothing moves along it
    is_end = (at <= STILL) | (at >= top * (1 - 1e-6))
    by_omega = Pair(
        jnp.where(is_end, -by_value.im, by_omega.re), jnp.where(is_end, by_value.re, by_omega.im)
    )
    area = by_omega.re * by_value.im - by_omega.im * by_value.re
    area = jnp.where(is_there & (area != 0), area, 1.0)
    moved = (push.re * by_omega.im - push.im * by_omega.re) / area
    return value, jnp.where(is_there, moved, 0.0)


def _search(
    loops: tuple[LoopResponse, AssembledModes, Array, Array, Array],
    sweep: FrequencySweep,
    steps: Steps,
) -> tuple[Crossing, Array, Array]:
    """The rightmost crossings; whether more may have been there, and whether curves were lost.

    Args:
        loops: responses, modes without control and their strength, least value that counts, and
            that at the ends of the axis.
        sweep: where to look.
        steps: runs elementwise steps.
    """
    response, modes, strength, least, at_end = loops
    omega = sweep_frequencies(modes, strength, response.period, sweep)
    begin = _eigenvalues_at(response, SPREAD, omega[0], steps)
    loci = _visit(response, SPREAD, begin, omega, steps)
    size = jnp.hypot(loci.value.re, loci.value.im)
    is_lost = ~jnp.all(size < FARTHEST, axis=0)
    seen, place = _largest(loci.crossing, loci.place)
    close, beside = _largest(loci.close, loci.close_at)
    is_seen = seen > 0.8 * least
    is_close = close > jnp.maximum(0.8 * least, BEYOND * seen[0])
    count = len(seen)
    found = _from_many(
        response,
        jnp.concatenate([seen, close]),
        jnp.concatenate([place, beside]),
        jnp.concatenate([is_seen, is_close]),
        steps,
    )
    best = jnp.argmax(found.value, axis=0)
    crossing = jax.tree.map(lambda x: jnp.take_along_axis(x, best[None], axis=0)[0], found)
    there = found.value[:count]
    is_near = (there < NEAR * seen) & (seen < NEAR * there)
    decides = jnp.maximum(crossing.value, at_end)
    is_strange = is_seen & ~is_near & (seen > decides)
    left_out = jnp.sort(strength, axis=0)[::-1][sweep.modes :][:1]
    is_doubtful = is_strange.any(axis=0) | (decides < SAFE * left_out).any(axis=0)

    def beside_it(crossing: Crossing, start_at: Array) -> tuple[Crossing, None]:
        other = _from_one(response, crossing, start_at, steps)
        is_more = other.value > crossing.value
        return jax.tree.map(lambda a, b: jnp.where(is_more, b, a), crossing, other), None

    return jax.lax.scan(beside_it, crossing, np.array(AGAIN))[0], is_doubtful, is_lost


def _largest(value: Array, place: Array) -> tuple[Array, Array]:
    """The largest values of each lane, falling, and their places; NaN and less become 0."""
    value = jnp.where(value > 0, value, 0.0)
    order = jnp.argsort(-value, axis=0)[:CHOSEN]
    return jnp.take_along_axis(value, order, axis=0), jnp.take_along_axis(place, order, axis=0)


def sweep_frequencies(
    modes: AssembledModes, strength: Array, period: Array, sweep: FrequencySweep
) -> Array:
    """Frequencies of the sweep, rising [rad/s], (F, n)."""
    top = np.pi / period
    lowest = 2 * np.pi * LOWEST_HZ
    background = lowest * (top / lowest) ** np.linspace(0, 1, sweep.background)[:, None]
    rows = jnp.argsort(-strength, axis=0)[: sweep.modes]
    centre, decay = (jnp.take_along_axis(x, rows, axis=0) for x in (modes.omega, modes.decay))
    width = jnp.maximum(decay, NARROWEST * centre)
    beside = fold_frequency(centre, top) + sweep.beside[:, None, None] * width
    omega = jnp.concatenate([background, jnp.abs(beside).reshape(-1, len(top))])
    omega = jnp.where(omega > top, 2 * top - omega, omega)
    return jnp.sort(jnp.clip(omega, 1.0, top * (1 - 1e-6)), axis=0)


def fold_frequency(omega: Array, top: Array) -> Array:
    """Frequencies after aliasing, 0 to pi/T."""
    return jnp.abs((omega + top) % (2 * top) - top)


def _visit(response: LoopResponse, spread: float, first: Pair, omega: Array, steps: Steps) -> Loci:
    angle = omega * response.period
    inputs = FrequencyPoint(omega, jnp.cos(angle), jnp.sin(angle))
    apart = _spread(response, spread)
    return steps(follow_loci, (response, apart), inputs, start_loci(first), len(omega))


def _eigenvalues_at(response: LoopResponse, spread: float, omega: Array, steps: Steps) -> Pair:
    """Eigenvalues of L at a frequency of each loop [rad/s], (m, n)."""
    count = np.prod(response.velocity_gain.shape[:2])
    first = Pair(*(jnp.broadcast_to(x[:, None], (len(x), len(omega))) for x in _ring(count)))
    return _visit(response, spread, first, jnp.tile(omega, (VISITS, 1)), steps).value


def _from_many(
    response: LoopResponse, value: Array, omega: Array, is_chosen: Array, steps: Steps
) -> Crossing:
    """Newton's iteration from several points of each loop, (k, n)."""
    flat, lane = is_chosen.ravel(), jnp.tile(jnp.arange(value.shape[1]), len(value))
    start = value.ravel(), omega.ravel()

    def work(at: Array) -> Crossing:
        value, omega = lanes_of(start, at)
        return _converged(lanes_of(response, lane[at]), value, omega, _nowhere(value), steps)

    found = in_groups(work, flat, _nowhere(start[0]))
    shaped: Crossing = jax.tree.map(lambda x: x.reshape(value.shape), found)
    return shaped


def _from_one(response: LoopResponse, known: Crossing, start_at: Array, steps: Steps) -> Crossing:
    """Newton's iteration slightly to the right of a point known, which is divided out."""

    def work(at: Array) -> Crossing:
        mine, own = lanes_of((response, known), at)
        return _converged(mine, own.value * start_at, own.omega, own, steps)

    return in_groups(work, known.value > 0, _nowhere(known.value))


def _nowhere(like: Array) -> Crossing:
    zero = jnp.zeros_like(like)
    return Crossing(zero, zero, Pair(zero, zero), Pair(zero, zero))


def _converged(
    response: LoopResponse, value: Array, omega: Array, known: Crossing, steps: Steps
) -> Crossing:
    """Where Newton's iteration ends; the value is 0 where it does not converge."""
    angle = omega * response.period
    guess = start_crossing(omega, value, jnp.cos(angle), jnp.sin(angle))
    last = steps(refine_crossing, (response, known), (), guess, NEWTON)
    is_there = (last.step < CONVERGED) & (last.value > 0) & jnp.isfinite(last.value)
    value = jnp.where(is_there, last.value, 0.0)
    return Crossing(value, last.omega, last.by_omega, last.by_value)


def _end_eigenvalues(response: LoopResponse, least: Array, steps: Steps) -> tuple[Array, Array]:
    """Largest eigenvalue above `least` at the ends of the axis, 0: none, and where [rad/s], (n,).

    L is real there, so its curves end on the real axis without crossing it: position feedback loses
    its static stiffness at 0, differences their sign at pi/T.
    """
    top = np.pi / response.period
    value, omega = jnp.zeros_like(top), jnp.full_like(top, jnp.nan)
    for place, name in ((0 * top + STILL, 0 * top), (top * (1 - 1e-6), top)):
        last = _eigenvalues_at(response, FINE_SPREAD, place, steps)
        is_real = (last.re > least) & (jnp.abs(last.im) < 1e-3 * last.re)
        largest = jnp.max(jnp.where(is_real, last.re, 0.0), axis=0)
        omega = jnp.where(largest > value, name, omega)
        value = jnp.maximum(value, largest)
    return value, omega


def _ring(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Initial guesses of eigenvalues, scattered over the unit circle."""
    k = np.arange(count)
    ring = np.exp(2j * np.pi * (k + 0.3) / count) * (0.2 + 0.8 * ((4 * k) % count) / count)
    return ring.real, ring.imag


def _spread(response: LoopResponse, size: float) -> Array:
    """See `evaluate_loop_gain`: up to `size`, different for each channel, (n, C, lanes)."""
    shape = response.velocity_gain.shape
    n = shape[0] * shape[1]
    return jnp.broadcast_to(size * (1 + np.arange(n).reshape(*shape[:2], 1)) / n, shape)


def _filters_grow(response: LoopResponse) -> Array:
    """Whether the filter of a channel that acts is unstable by itself, (n,)."""
    first, (a1, a2) = response.estimator.first[2], response.estimator.denominator
    edge = 1 + RADIUS_TOLERANCE
    is_calm = (jnp.abs(first) < edge) & (jnp.abs(a2) < edge) & (jnp.abs(a1) < edge + a2)
    acts = response.velocity_gain != 0
    if response.position_gain is not None:
        acts = acts | (response.position_gain != 0)
    return jnp.any(~is_calm & acts, axis=(0, 1))


def _with_gains(response: LoopResponse, factor: Array) -> LoopResponse:
    """The loops with all gains times a factor, (n,)."""
    position = response.position_gain
    return response._replace(
        velocity_gain=response.velocity_gain * factor,
        position_gain=None if position is None else position * factor,
    )
