"""The linearised sampled loop: exact discretisation, spectral radius, modal damping, gain margin.

Stability is judged here and never from a run: saturation keeps an unstable loop bounded. Plant with
drive and anti-alias filter is discretised exactly for held voltages; the controller is the loop's
own `controller_step`, linear once rounding and limits are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.controller import ControllerState, controller_step
from jaxmodel.linear import linearise
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare

#: Spectral radius above 1 by more than this is unstable; free rigid modes sit at 1 with rounding.
RADIUS_TOLERANCE = 1e-7


class LoopMatrices(NamedTuple):
    """Closed-loop transition matrix over one sample: open + factor * feedback."""

    open: Array  # all gains zero, (n, n)
    feedback: Array  # what the gains add, (n, n)
    plant: Array  # A of the continuous plant without control, for its poles, (m, m)


def closed_loop(structure: Structure, case: Case, pose: Array) -> LoopMatrices:
    """Transition matrix of plant, filters, delay and controller per sample; differentiable.

    Args:
        structure: static choices with feedback "sampled".
        case: the numbers; its gains belong to factor 1.
        pose: where to linearise [m, m, rad], (3,).

    Returns:
        LoopMatrices.
    """
    smooth = structure._replace(is_smooth=True, feedback="sampled")
    loop = prepare(smooth, case).loop
    plant = linearise(smooth, loop, pose, case.electronics.antialias)
    n, n_voltages = plant.state.shape[0], plant.voltage.shape[1]
    held = jnp.zeros((n + n_voltages,) * 2, plant.state.dtype)
    held = held.at[:n, :n].set(plant.state).at[:n, n:].set(plant.voltage)
    # balance velocities against positions, or the exponential loses digits to scaling
    scale = jnp.concatenate([_balance(smooth, loop.omega), jnp.full((n_voltages,), 1e6)])
    exact = jax.scipy.linalg.expm(held / scale[:, None] * scale * case.electronics.period)
    exact = (exact * scale[:, None] / scale)[:n]
    channels, patches = structure.n_channels, structure.n_patches

    def advance(x: Array, factor: Array) -> Array:
        state, line = x[:n], jnp.reshape(x[n : n + 9 * channels], (3, 3, channels))
        voltage = jnp.reshape(x[n + 9 * channels :], (3, patches))
        controller = loop.controller._replace(velocity_gain=factor * loop.controller.velocity_gain)
        if controller.position_gain is not None:
            controller = controller._replace(position_gain=factor * controller.position_gain)
        before = ControllerState(line[0], (line[1], line[2]), voltage)
        filtered = jnp.reshape(plant.sensor @ state, (3, patches))
        after, _ = controller_step(controller, before, filtered, None, True)
        moved = exact @ jnp.concatenate([state, jnp.ravel(voltage)])
        parts = (moved, after.first, *after.second, after.voltage)
        return jnp.concatenate([jnp.ravel(part) for part in parts])

    start = jnp.zeros((n + 9 * channels + n_voltages,), plant.state.dtype)
    jacobian = jax.jacfwd(advance)
    without = jacobian(start, 0.0)
    return LoopMatrices(without, jacobian(start, 1.0) - without, plant.state)


def _balance(structure: Structure, omega: Array) -> Array:
    """Typical size of each entry of x: velocities are 1000 times positions."""
    modes = 3 * structure.n_modes
    size = np.concatenate([np.ones(3), np.full(3, 1e3)] + [np.full(modes, s) for s in (1, 1e3) * 2])
    return jnp.asarray(size, omega.dtype)


#: Squarings for the value and for the gradient of `slowest_decay`.
SQUARINGS, AVERAGED = 50, 34
#: Growth per sample that weighs powers in the gradient: the last million of them count.
GROWTH = 1e-6


def slowest_decay(transition: Array, period: Array) -> Array:
    """Decay rate -ln(rho)/T of the slowest motion, rho the spectral radius; negative if unstable.

    By repeated squaring, rho = lim |M^n|^(1/n), with the norm taken out each time: batched
    anywhere, where eigenvalues of unsymmetric matrices are not. A complex pair makes |M^n| swing
    with n, and its derivative with it, however large n is; so the gradient is that of
    ln(sum over n of |M^n|^2 s^(-2n)) with s just below rho, in which the swings cancel.

    Args:
        transition: M of x_(k+1) = M x_k, (n, n).
        period: T [s], ().

    Returns:
        [1/s], ().
    """
    value = jax.lax.stop_gradient(_log_radius(transition))
    slope = _summed(transition, jnp.exp(value - GROWTH))
    return -(value + slope - jax.lax.stop_gradient(slope)) / period


def _log_radius(matrix: Array) -> Array:
    """ln(rho), to some 1e-14."""

    def square(carried: tuple[Array, Array], share: Array) -> tuple[tuple[Array, Array], None]:
        power, total = carried
        size = jnp.sqrt(jnp.sum(power * power))
        power = power / size
        return (power @ power, total + jnp.log(size) * share), None

    shares = jnp.asarray(0.5 ** np.arange(SQUARINGS), matrix.dtype)
    return jax.lax.scan(square, (matrix, jnp.zeros((), matrix.dtype)), shares)[0][1]


def _summed(matrix: Array, size: Array) -> Array:
    """ln(tr sum_(j < n) B^j B^j')/2m with B = matrix/size and n = 2^AVERAGED, by doubling.

    m is the mean of j as the sum weighs it, so that the derivative is that of ln(rho).
    """

    def double(carried: tuple, _: None) -> tuple[tuple, None]:
        power, log_power, total, log_total = carried
        size = jnp.sqrt(jnp.sum(power * power))
        power, log_power = power / size, log_power + jnp.log(size)
        # both terms of total + power total power', without the factor that would be too large
        most = jnp.maximum(log_power, 0.0)
        later = jnp.exp(2 * (log_power - most)) * (power @ total @ power.T)
        total = jnp.exp(-2 * most) * total + later
        trace = jnp.trace(total)
        log_total = log_total + 2 * most + jnp.log(trace)
        return (power @ power, 2 * log_power, total / trace, log_total), None

    zero, one = jnp.zeros((), matrix.dtype), jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    start = matrix / size, zero, one, zero
    (*_, log_total), _ = jax.lax.scan(double, start, None, length=AVERAGED)
    count = 2.0**AVERAGED
    mean = count / -np.expm1(-2 * GROWTH * count) - 1 / -np.expm1(-2 * GROWTH)
    return log_total / (2 * mean)


class LoopReport(NamedTuple):
    """Judgement of a sampled loop (on the host)."""

    spectral_radius: float  # of the closed loop [1]
    gain_margin: float  # largest common factor on all gains with every smaller one stable [1]
    frequency_hz: np.ndarray  # of the tracked link modes with control [Hz], (J, 3)
    damping_ratio: np.ndarray  # [1], (J, 3): three assembled modes per link mode

    @property
    def is_stable(self) -> bool:
        """Whether this loop and every one with smaller gains is stable."""
        return self.spectral_radius <= 1 + RADIUS_TOLERANCE and self.gain_margin >= 1


_closed_loop = jax.jit(closed_loop, static_argnums=0)


def loop_report(
    structure: Structure, case: Case, pose: Array, n_tracked: int = 3, limit: float = 64.0
) -> LoopReport:
    """Spectral radius, gain margin and damping of the lowest link modes.

    Modes are followed from zero gain to full gain, so that filter poles are not mistaken for them.

    Args:
        structure: static choices.
        case: the numbers.
        pose: where to linearise [m, m, rad], (3,).
        n_tracked: J, link modes to follow.
        limit: margins beyond this are reported as it [1].

    Returns:
        LoopReport.
    """
    # what the matrices do not depend on must not cost a compilation
    plain = structure._replace(n_steps=1, substeps=1, n_frequencies=1, has_noise=False)
    matrices = jax.tree.map(np.asarray, _closed_loop(plain, case, pose))
    period = float(case.electronics.period)

    def poles(factor: float) -> np.ndarray:
        return np.linalg.eigvals(matrices.open + factor * matrices.feedback)

    radius = float(np.abs(poles(1.0)).max())
    tracked = _follow(matrices, poles, period, n_tracked)
    decay = np.log(tracked) / period
    frequency = np.abs(decay) / (2 * np.pi)
    zeta = -decay.real / np.abs(decay)
    return LoopReport(radius, gain_margin(poles, limit), frequency, zeta)


def gain_margin(poles, limit: float = 64.0) -> float:
    """Largest factor up to which `poles(factor)` stays in the unit circle, without a gap.

    Args:
        poles: function of the gain factor returning the loop's poles.
        limit: where to stop looking [1].

    Returns:
        the factor [1]; 0 where even the smallest one tried (0.01) is unstable.
    """

    def is_stable(factor: float) -> bool:
        return bool(np.abs(poles(factor)).max() <= 1 + RADIUS_TOLERANCE)

    low, grid = 0.0, np.geomspace(0.01, limit, 48)
    for high in grid:
        if not is_stable(high):
            break
        low = high
    else:
        return limit
    if low == 0.0:
        return 0.0
    while high - low > 1e-4 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return float(low)


def _follow(matrices: LoopMatrices, poles, period: float, n_tracked: int) -> np.ndarray:
    """Discrete poles of the first link modes at full gain, (J, 3)."""
    start = _link_poles(matrices.plant, n_tracked)
    tracked = np.exp(start.ravel() * period)
    velocity = np.zeros_like(tracked)
    for factor in np.linspace(0, 1, 41)[1:]:
        candidates = list(poles(factor))
        guess, found = tracked + velocity, []
        for wanted in guess:
            nearest = int(np.argmin(np.abs(np.array(candidates) - wanted)))
            found.append(candidates.pop(nearest))
        velocity, tracked = np.array(found) - tracked, np.array(found)
    return np.pad(
        tracked.reshape(-1, 3), ((0, n_tracked - tracked.size // 3), (0, 0)), constant_values=np.nan
    )


def _link_poles(state: np.ndarray, n_tracked: int) -> np.ndarray:
    """Poles of the uncontrolled link modes, grouped by three in ascending frequency, (J, 3).

    They are the eigenvalues whose eigenvectors live in the modal coordinates.
    """
    modes = (state.shape[0] - 6) // 4
    keep = np.r_[0:6, 6 : 6 + 2 * modes]
    value, vector = np.linalg.eig(state[np.ix_(keep, keep)])
    upper = value.imag > 0
    vector, value = vector[:, upper], value[upper]
    weight = np.abs(vector[:3]).max(axis=0) / np.abs(vector[6 : 6 + modes]).max(axis=0)
    # at most three pairs belong to the pose on its drive: the ones with the largest pose share
    n_rigid = value.size - modes
    flexible = np.sort_complex(1j * value[np.argsort(weight)[: value.size - max(n_rigid, 0)]])
    flexible = flexible[np.argsort(np.abs(flexible))] / 1j
    kept = min(flexible.size // 3, n_tracked)  # overdamped modes have no such pole
    return flexible[: 3 * kept].reshape(kept, 3)
