"""Margins and H-infinity norms of the sampled loop, from its frequency response.

Norms are searched on a grid that follows the machine's modes, then refined with the complete
response; margins are searched by `studies.engine.robustness`. Figures are differentiable: where a
peak or a crossing lies does not change its value to first order, so gradients are taken at the
place found (envelope theorem), by all numbers of `SampledLoopResponse`. A stable loop is assumed.
docs/theory.md, "Margins by frequency response".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.loop_figures import MOST_DELAY, MOST_PHASE, PEAKS
from jaxmodel.parameters import Array, Num
from jaxmodel.return_difference import NARROWEST, assembled_modes
from jaxmodel.sampled_response import SampledLoopResponse, close_loop, command_gain
from jaxmodel.scaling import best_scaling
from jaxmodel.state_space import StateSpace

#: Frequencies of a search: evenly on a logarithmic axis, and beside each mode.
BACKGROUND, BESIDE = 120, np.tan(np.linspace(-1.45, 1.45, 12))
LOWEST_HZ = 0.5
#: Local maxima that are refined.
REFINED = 2
#: Zooms on a maximum, and points of each.
ZOOMS, POINTS = 4, 5


class MarginPlace(NamedTuple):
    """Where a margin is, from a search."""

    value: Num[Array, ""]  # the margin in its unit
    omega: Num[Array, ""]  # [rad/s]
    sign: Num[Array, ""]  # of the phase, 1 or -1; otherwise 1


def margin_at(response: SampledLoopResponse, name: str, place: MarginPlace) -> Array:
    """A margin with its derivatives, at the place that a search found (envelope theorem).

    Args:
        response: of the loop.
        name: of `MARGINS`: `disk_margin` alpha of Seiler, Packard and Gahinet (2020), every
            actuator with its own complex uncertainty, sigma = 0, by the upper bound of mu that
            diagonal scaling gives, which errs to the safe side [1]; `phase_margin` of all
            actuators at once [deg]; `delay_margin` of all actuators at once [samples].
        place: from `studies.engine.robustness`; not differentiated.

    Returns:
        The margin, ().
    """
    place = jax.lax.stop_gradient(place)
    if name == "disk_margin":
        return _disk_margin(response, place.omega)
    is_phase = name == "phase_margin"
    unit, most = (180 / np.pi, MOST_PHASE) if is_phase else (1.0, MOST_DELAY)

    def gain(response: SampledLoopResponse, w: Array, t: Array) -> Array:
        if not is_phase:
            return command_gain(response, w, t)
        return jnp.exp(-1j * place.sign * t) * command_gain(response, w)

    fixed = jax.lax.stop_gradient(response)
    has_one, turn = place.value < most, place.value / unit
    _, by_w, by_t = _with_slopes(lambda w, t: _determinant(gain(fixed, w, t)), place.omega, turn)
    # safe numbers where there is none, or gradients would not be numbers
    slopes = jnp.where(has_one, by_w, 1.0), jnp.where(has_one, by_t, 1j)
    moved = _determinant(gain(response, place.omega, turn))
    slope = jnp.where(has_one, _solve(moved, *slopes)[1], 0.0)
    return place.value + unit * (slope - jax.lax.stop_gradient(slope))


def norm_peaks(response: SampledLoopResponse, names: tuple[str, ...]) -> dict[str, Array]:
    """H-infinity norms of a stable loop.

    Args:
        response: of the loop, see `response_of_loop`.
        names: of `PEAKS`.

    Returns:
        Each figure, (): `sensitivity_peak`, largest singular value of S at the commands [1];
        `control_effort_peak`, of sensor voltages to commands [1]; `disturbance_deflection_peak`, of
        held drive forces to chord deflections [m/N].

    Example:
        >>> peaks = norm_peaks(response, ("sensitivity_peak",))  # doctest: +SKIP
    """
    fixed = jax.lax.stop_gradient(response)
    omega = search_frequencies(fixed)
    coarse = jax.lax.map(
        lambda w: {
            name: coarse_norm(getattr(close_loop(fixed, w, False), _FIELD[name])) for name in names
        },
        omega,
        batch_size=BATCH,
    )
    return {name: _norm_peak(response, omega, coarse[name], _FIELD[name]) for name in names}


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


# --- margins ------------------------------------------------------------------------------------


def _disk_margin(response: SampledLoopResponse, omega: Array) -> Array:
    """1 over the upper bound of mu(S - I/2) at a frequency, ()."""

    def excess(response: SampledLoopResponse) -> Array:
        gain = command_gain(response, omega)
        eye = np.eye(gain.shape[-1])
        return jnp.linalg.inv(eye + gain) - eye / 2

    best = jax.lax.stop_gradient(best_scaling(excess(jax.lax.stop_gradient(response))))
    slope = jnp.real(jnp.sum(jnp.conj(best.slope) * excess(response)))
    return 1 / (best.bound + slope - jax.lax.stop_gradient(slope))


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
