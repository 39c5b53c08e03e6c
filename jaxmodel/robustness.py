"""Margins and H-infinity norms of the sampled loop, from its frequency response.

Each figure is searched on a grid that follows the machine's modes, then refined with the complete
response. Figures are differentiable: where a peak or a crossing lies does not change its value to
first order, so gradients are taken at the place found (envelope theorem), by all numbers of
`SampledLoopResponse`. A stable loop is assumed. docs/theory.md, "Margins by frequency response".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel.frequency_response import (
    FEW,
    SampledLoopResponse,
    close_loop,
    command_gain,
    command_gain_images,
)
from jaxmodel.lazy import jax, jnp
from jaxmodel.loop_figures import MARGINS, MOST_DELAY, PEAKS
from jaxmodel.parameters import Array
from jaxmodel.return_difference import NARROWEST, assembled_modes
from jaxmodel.scaling import best_scaling, scaled
from jaxmodel.state_space import StateSpace

#: Frequencies of a search: evenly on a logarithmic axis, and beside each mode.
BACKGROUND, BESIDE = 120, np.tan(np.linspace(-1.45, 1.45, 12))
LOWEST_HZ = 0.5
#: Local maxima whose scaling is optimised, and those that are refined.
LOOKED_AT, REFINED = 6, 2
#: Zooms on a maximum, and points of each.
ZOOMS, POINTS = 4, 5
#: Frequencies at which an eigenvalue of L can have modulus 1, at most.
STRONG = 288
#: Steps of delay [samples] and of phase [rad] on the map of crossings, and steps of one part of it.
DELAY_STEP, PHASE_STEP, PART = 1 / 8, np.pi / 32, 16
#: Cells of the map that are refined, eigenvalues in each, and Newton's steps.
CELLS, EACH, NEWTON = 3, 4, 8


def robustness_figures(response: SampledLoopResponse, names: tuple[str, ...]) -> dict[str, Array]:
    """Figures of a stable loop.

    Args:
        response: of the loop, see `response_of_loop`.
        names: of `MARGINS` and `PEAKS`.

    Returns:
        Each figure, (): `disk_margin` alpha of Seiler, Packard and Gahinet (2020), every actuator
        with its own complex uncertainty, sigma = 0, by the upper bound of mu that diagonal scaling
        gives, which errs to the safe side [1]; `phase_margin` of all actuators at once [deg];
        `delay_margin` of all actuators at once [samples]; `sensitivity_peak`, largest singular
        value of S at the commands [1]; `control_effort_peak`, of sensor voltages to commands [1];
        `disturbance_deflection_peak`, of held slider forces to chord deflections [m/N].

    Example:
        >>> figures = robustness_figures(response, ("disk_margin",))  # doctest: +SKIP
    """
    fixed = jax.lax.stop_gradient(response)
    omega = search_frequencies(fixed)
    figures = {}
    if set(names) & set(MARGINS):
        images = jax.lax.map(lambda w: command_gain_images(fixed, w), omega, batch_size=BATCH)
        if "disk_margin" in names:
            figures["disk_margin"] = _disk_margin(response, omega, jnp.sum(images, axis=1))
        strong = _strong_part(omega, images)
        if "phase_margin" in names:
            figures["phase_margin"] = jnp.rad2deg(_phase_margin(response, strong))
        if "delay_margin" in names:
            figures["delay_margin"] = _delay_margin(response, strong)
    peaks = [name for name in PEAKS if name in names]
    if peaks:
        coarse = jax.lax.map(
            lambda w: {
                name: coarse_norm(getattr(close_loop(fixed, w, False), _FIELD[name]))
                for name in peaks
            },
            omega,
            batch_size=BATCH,
        )
        for name in peaks:
            figures[name] = _norm_peak(response, omega, coarse[name], _FIELD[name])
    return {name: figures[name] for name in names}


_FIELD = {name: name.removesuffix("_peak") for name in PEAKS}
#: Frequencies at once, which stay in a processor's cache.
BATCH = 49


def search_frequencies(response: SampledLoopResponse) -> Array:
    """Rising [rad/s], dense beside the modes of the machine and of a controller, (F,)."""
    plant = response.plant
    modes, top = assembled_modes(plant), np.pi / plant.period
    lowest = 2 * np.pi * LOWEST_HZ
    background = lowest * (top / lowest) ** np.linspace(0, 1, BACKGROUND)
    centre, decay = modes.omega, modes.decay
    if isinstance(response.controller.feedback, StateSpace):
        pole = jnp.linalg.eigvals(response.controller.feedback.state)
        rate = jnp.log(jnp.maximum(jnp.abs(pole), 1e-9)) / plant.period
        centre = jnp.concatenate([centre, jnp.ravel(jnp.abs(jnp.angle(pole)) / plant.period)])
        decay = jnp.concatenate([decay, jnp.ravel(jnp.abs(rate))])
    width = jnp.maximum(decay, NARROWEST * centre)
    beside = centre + BESIDE[:, None] * width
    folded = jnp.abs((beside + top) % (2 * top) - top)  # after aliasing
    omega = jnp.concatenate([background, jnp.ravel(folded)])
    return jnp.sort(jnp.clip(omega, lowest, top * (1 - 1e-6)))


# --- peaks of singular values ---------------------------------------------------------------------


def coarse_norm(matrix: Array) -> Array:
    """Largest singular value to 1 %, from the trace of powers, ()."""
    power = jnp.conj(matrix.T) @ matrix
    size = jnp.real(jnp.trace(power)) + jnp.finfo(power.real.dtype).tiny
    power, log = power / size, jnp.log(size)
    for _ in range(6):
        power, log = power @ power, 2 * log
        size = jnp.real(jnp.trace(power))
        power, log = power / size, log + jnp.log(size)
    return jnp.exp(log / 2**7)


def _local_maxima(value: Array, count: int) -> Array:
    """Places of the largest local maxima on a grid, (count,)."""
    left = jnp.concatenate([value[:1], value[:-1]])
    right = jnp.concatenate([value[1:], value[-1:]])
    return jax.lax.top_k(jnp.where((value >= left) & (value >= right), value, 0.0), count)[1]


def _refined(evaluate: Callable[[Array], Array], omega: Array, place: Array) -> tuple[Array, Array]:
    """Where a function is largest between the neighbours of a place on the grid, and its value.

    Zooming in, then the vertex of a parabola.
    """
    left = omega[jnp.maximum(place - 1, 0)]
    right = omega[jnp.minimum(place + 1, omega.size - 1)]

    def zoom(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        points, value = state
        best = jnp.clip(jnp.argmax(value), 1, POINTS - 2)
        points = points[best - 1] + (points[best + 1] - points[best - 1]) * share
        return points, jax.lax.map(evaluate, points)

    share = np.linspace(0, 1, POINTS)
    # the first zoom takes the whole interval
    wide = jnp.full(POINTS, right).at[0].set(left)
    start = wide, jnp.zeros(POINTS).at[1].set(1.0)
    points, value = jax.lax.fori_loop(0, ZOOMS, zoom, start)
    best = jnp.clip(jnp.argmax(value), 1, POINTS - 2)
    before, here, after = (value[best + k] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    is_round = (here >= jnp.maximum(before, after)) & (bend < 0)
    shift = jnp.where(is_round, (before - after) / jnp.where(is_round, 2 * bend, 1.0), 0.0)
    vertex = points[best] + shift * (points[1] - points[0])
    return jnp.where(is_round, vertex, points[jnp.argmax(value)]), jnp.max(value)


def _norm_peak(response: SampledLoopResponse, omega: Array, coarse: Array, field: str) -> Array:
    """Largest singular value over all frequencies, ()."""
    fixed = jax.lax.stop_gradient(response)

    def matrix(response: SampledLoopResponse, w: Array) -> Array:
        return getattr(close_loop(response, w), field)

    def norm(w: Array) -> Array:
        return jnp.linalg.svd(matrix(fixed, w), compute_uv=False)[0]

    places = _local_maxima(coarse, REFINED)
    found, value = jax.lax.map(lambda k: _refined(norm, omega, k), places)
    at = found[jnp.argmax(value)]
    left, size, right = jnp.linalg.svd(jax.lax.stop_gradient(matrix(fixed, at)))
    slope = jnp.real(jnp.conj(left[:, 0]) @ matrix(response, at) @ jnp.conj(right[0]))
    return size[0] + slope - jax.lax.stop_gradient(slope)


def _disk_margin(response: SampledLoopResponse, omega: Array, coarse: Array) -> Array:
    """1/max of the upper bound of mu(S - I/2), ()."""
    fixed, eye = jax.lax.stop_gradient(response), np.eye(coarse.shape[-1])

    def excess(gain: Array) -> Array:
        return jnp.linalg.inv(eye + gain) - eye / 2

    def bound(w: Array) -> Array:
        return best_scaling(excess(command_gain(fixed, w))).bound

    rough = jax.lax.map(lambda gain: coarse_norm(scaled(excess(gain))), coarse, batch_size=BATCH)
    places = _local_maxima(rough, LOOKED_AT)
    better = jax.lax.map(lambda k: best_scaling(excess(coarse[k])).bound, places)
    places = places[jax.lax.top_k(better, REFINED)[1]]
    found, value = jax.lax.map(lambda k: _refined(bound, omega, k), places)
    at = found[jnp.argmax(value)]
    best = jax.lax.stop_gradient(best_scaling(excess(command_gain(fixed, at))))
    slope = jnp.real(jnp.sum(jnp.conj(best.slope) * excess(command_gain(response, at))))
    return 1 / (best.bound + slope - jax.lax.stop_gradient(slope))


# --- crossings: an eigenvalue of L that reaches -1 ------------------------------------------------


class _Strong(NamedTuple):
    """Where an eigenvalue of L can have modulus 1, whatever the phases of its parts."""

    omega: Array  # rising, the last repeated [rad/s], (Q,)
    images: Array  # (Q, I, n, n)
    is_any: Array  # ()


def _strong_part(omega: Array, images: Array) -> _Strong:
    """An eigenvalue is at most that of the moduli (Perron and Frobenius)."""
    power = jnp.sum(jnp.abs(images), axis=1)
    log = jnp.zeros(omega.shape)
    for _ in range(5):
        size = jnp.max(jnp.sum(power, axis=2), axis=1) + jnp.finfo(power.dtype).tiny
        power, log = power / size[:, None, None], log + jnp.log(size)
        power, log = power @ power, 2 * log
    radius = jnp.exp((log + jnp.log(jnp.max(jnp.sum(power, axis=2), axis=1))) / 2**5)
    count = min(STRONG, omega.size)
    least = jnp.maximum(0.95, jax.lax.top_k(radius, count)[0][-1])
    is_strong = radius >= least
    near = is_strong.at[1:].max(is_strong[:-1]).at[:-1].max(is_strong[1:])
    (rows,) = jnp.nonzero(near, size=count, fill_value=omega.size - 1)
    return _Strong(omega[rows], images[rows], jnp.any(radius >= 1))


def _first_crossing(
    on_grid: Callable[[Array], Array],
    exact: Callable[[SampledLoopResponse, Array, Array, Array], Array],
    response: SampledLoopResponse,
    strong: _Strong,
    signs: np.ndarray,
    step: float,
    most: float,
) -> Array:
    """Smallest t at which det(I + L(omega, t)) = 0 at some omega, `most` if there is none, ().

    The determinant's phase turns once round each cell of the (omega, t) map that holds a zero.

    Args:
        on_grid: determinants by t, (signs, Q) from (signs,).
        exact: L of (response, omega, t, sign).
        response: of the loop.
        strong: where to look.
        signs: of t.
        step: of t on the map.
        most: where the search ends.
    """
    fixed, n_parts = jax.lax.stop_gradient(response), int(np.ceil(most / step / PART))

    def cells(part: Array) -> tuple[Array, Array, Array]:
        """Smallest t of cells with a zero, frequencies there, and numbers, (CELLS,)."""
        t = (part * PART + np.arange(PART + 1)) * step
        value = jax.lax.map(lambda x: on_grid(x * signs), t)  # (t, signs, Q)
        phase = jnp.angle(value)

        def turned(a: Array, b: Array) -> Array:
            return (b - a + np.pi) % (2 * np.pi) - np.pi

        along = turned(phase[:, :, :-1], phase[:, :, 1:])
        up = turned(phase[:-1], phase[1:])
        turns = along[:-1] + up[:, :, 1:] - along[1:] - up[:, :, :-1]
        # where in the cell, by a plane through three corners
        corner = value[:-1, :, :-1]
        dw, dt = _solve(corner, value[:-1, :, 1:] - corner, value[1:, :, :-1] - corner)
        at = t[:-1, None, None] + step * jnp.clip(dt, 0, 1)
        at = jnp.where(jnp.abs(turns) > np.pi, at, jnp.inf)
        width = strong.omega[1:] - strong.omega[:-1]
        omega = strong.omega[:-1] + width * jnp.clip(dw, 0, 1)
        first, number = jax.lax.top_k(-jnp.ravel(at), CELLS)
        return -first, jnp.ravel(omega)[number], number

    def guesses(cell: tuple[Array, ...]) -> tuple[Array, Array]:
        """Several eigenvalues can reach -1 in one cell: where each does by its derivatives."""
        start, near, width, sign = cell
        start = jnp.where(jnp.isinf(start), step, start)
        gain, by_w, by_t = _with_slopes(lambda w, t: exact(fixed, w, t, sign), near, start)
        value, vector = jnp.linalg.eig(gain)
        inverse = jnp.linalg.pinv(vector)
        slopes = (jnp.sum(inverse.T * (x @ vector), axis=0) for x in (by_w, by_t))
        dw, dt = _solve(1 + value, *slopes)
        is_near = (jnp.abs(dw) < 1.5 * width) & (jnp.abs(dt) < 1.5 * step) & (start + dt > 0)
        later, at = jax.lax.top_k(-jnp.where(is_near, start + dt, start + 4 * step), EACH)
        is_near = is_near[at].at[-1].set(True)
        w = jnp.where(is_near, near + dw[at], near)
        return w.at[-1].set(near), jnp.where(is_near, -later, start).at[-1].set(start)

    def polished(guess: tuple[Array, ...]) -> tuple[Array, ...]:
        near, start, width, sign = guess

        def newton(_: int, at: tuple[Array, ...]) -> tuple[Array, ...]:
            w, t = at[:2]
            value, by_w, by_t = _with_slopes(
                lambda w, t: _determinant(exact(fixed, w, t, sign)), w, t
            )
            dw, dt = _solve(value, by_w, by_t)
            dw, dt = jnp.clip(dw, -width, width), jnp.clip(dt, -step, step)
            return w + dw, t + dt, jnp.abs(dt) / step + jnp.abs(dw) / width, by_w, by_t

        begin = near, start, jnp.inf, 0j * near, 0j * near
        w, t, last, by_w, by_t = jax.lax.fori_loop(0, NEWTON, newton, begin)
        is_there = (jnp.abs(t - start) < 3 * step) & (t > 0) & (last < 1e-6)
        return w, jnp.where(is_there, t, jnp.inf), by_w, by_t

    def confirmed(start: Array, near: Array, number: Array) -> tuple[Array, ...]:
        """The zero of smallest t among those cells: t, omega, sign and slopes there."""
        column = number % (strong.omega.size - 1)
        width = strong.omega[column + 1] - strong.omega[column]
        width = jnp.where(width > 0, width, 1.0)
        sign = jnp.asarray(signs)[number // (strong.omega.size - 1) % len(signs)]
        near, first = map(jnp.ravel, jax.lax.map(guesses, (start, near, width, sign)))
        width, sign = jnp.repeat(width, EACH), jnp.repeat(sign, EACH)
        w, t, by_w, by_t = jax.lax.map(polished, (near, first, width, sign))
        t = jnp.where(jnp.repeat(jnp.isinf(start), EACH), jnp.inf, t)
        best = jnp.argmin(t)
        return t[best], w[best], sign[best], by_w[best], by_t[best]

    real, whole = strong.omega.dtype, strong.images.dtype
    nothing = (
        jnp.array(jnp.inf, real),
        strong.omega[0],
        jnp.ones((), real),
        jnp.zeros((), whole),
        jnp.zeros((), whole),
    )

    def advance(state: tuple[Array, ...]) -> tuple[Array, ...]:
        found = cells(state[0])
        # a cell may seem to hold a zero where the map is too coarse: those are passed over
        zero = jax.lax.cond(jnp.isinf(found[0][0]), lambda *_: nothing, confirmed, *found)
        return state[0] + 1, *zero

    _, t, w, sign, by_w, by_t = jax.lax.while_loop(
        lambda state: (state[0] < n_parts) & jnp.isinf(state[1]),
        advance,
        (jnp.where(strong.is_any, 0, n_parts), *nothing),
    )
    has_one = jnp.isfinite(t)
    at = jnp.where(has_one, w, strong.omega[0]), jnp.where(has_one, t, step)
    moved = _determinant(exact(response, *at, sign))
    # safe numbers where there is none, or gradients would not be numbers
    slopes = jnp.where(has_one, by_w, 1.0), jnp.where(has_one, by_t, 1j)
    slope = jnp.where(has_one, _solve(moved, *slopes)[1], 0.0)
    return jnp.minimum(jnp.minimum(t, most) + slope - jax.lax.stop_gradient(slope), most)


def _determinant(gain: Array) -> Array:
    return jnp.linalg.det(np.eye(gain.shape[-1]) + gain)


def _with_slopes(
    function: Callable[[Array, Array], Array], w: Array, t: Array
) -> tuple[Array, Array, Array]:
    """Value and derivatives by omega and t."""

    def both(x: Array) -> tuple[Array, Array]:
        value = function(x[0], x[1])
        return value, value

    slopes, value = jax.jacfwd(both, has_aux=True)(jnp.stack([w, t]))
    return value, slopes[..., 0], slopes[..., 1]


def _solve(value: Array, by_w: Array, by_t: Array) -> tuple[Array, Array]:
    """Real (dw, dt) with value + by_w dw + by_t dt = 0, complex numbers."""
    area = jnp.imag(jnp.conj(by_w) * by_t)
    area = jnp.where(area == 0, 1.0, area)
    return jnp.imag(jnp.conj(by_t) * value) / area, -jnp.imag(jnp.conj(by_w) * value) / area


def _phase_margin(response: SampledLoopResponse, strong: _Strong) -> Array:
    """Smallest common phase that makes the loop unstable [rad], ()."""
    total = jnp.sum(strong.images, axis=1)

    def on_grid(phase: Array) -> Array:
        return jax.vmap(lambda x: _determinant(jnp.exp(-1j * x) * total))(phase)

    def exact(response: SampledLoopResponse, w: Array, t: Array, sign: Array) -> Array:
        return jnp.exp(-1j * sign * t) * command_gain(response, w)

    both = np.array([1.0, -1.0])
    return _first_crossing(on_grid, exact, response, strong, both, PHASE_STEP, np.pi)


def _delay_margin(response: SampledLoopResponse, strong: _Strong) -> Array:
    """Smallest common delay that makes the loop unstable [samples], ()."""
    order = np.arange(-FEW, FEW + 1)
    angle = strong.omega[:, None] * response.plant.period + 2 * np.pi * order  # (Q, I)

    def on_grid(delay: Array) -> Array:
        turned = jnp.exp(-1j * angle * delay[0])
        return _determinant(jnp.einsum("qi,qiab->qab", turned, strong.images))[None]

    def exact(response: SampledLoopResponse, w: Array, t: Array, sign: Array) -> Array:
        return command_gain(response, w, t)

    return _first_crossing(on_grid, exact, response, strong, np.ones(1), DELAY_STEP, MOST_DELAY)
