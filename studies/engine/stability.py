"""Stability of a linearised sampled loop: spectral radius, gain margin, damping of its modes.

Eigenvalues of small matrices, on the host; `jaxmodel.sampled_loop` builds the matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from jaxmodel.axial import axial_force
from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller, linear_parts
from jaxmodel.laws import LAWS
from jaxmodel.linear import Moment
from jaxmodel.motion import PathSample, end_of_path, sample_path
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import RADIUS_TOLERANCE, LoopMatrices, closed_loop
from studies.study.margin import HIGHEST, LOWEST, MARGIN_MODES

#: Largest ratio of successive gain factors [1].
STRIDE = 1.25
#: The first factor, and the ratio of smaller ones if it is unstable [1].
FIRST, DESCENT = 0.01, 4.0


#: Gain factors at which modes are traced from no control to the given gains [1].
STEPS = np.linspace(0, 1, 41)[1:]


def with_margin_modes(
    structure: Structure, case: Case, least: int = MARGIN_MODES
) -> tuple[Structure, Case]:
    """The same loop, or loops, with at least this many plant modes, before any motion."""
    n_modes = max(least, structure.n_modes)
    modes = np.maximum(least, np.asarray(case.n_modes))
    still = np.zeros((*np.shape(case.initial.modal)[:-1], n_modes))
    case = case._replace(n_modes=modes, initial=case.initial._replace(modal=still))
    # drop everything a loop about rest does not depend on, which would cost a compilation
    structure = structure._replace(
        n_modes=n_modes,
        n_steps=1,
        substeps=1,
        is_linear=False,
        n_frequencies=1,
        has_noise=False,
        metrics=(),
        is_smooth=True,
        feedback="sampled",
        has_position_gain=True,
    )
    return structure, case


class LoopReport(NamedTuple):
    """Judgement of a sampled loop."""

    spectral_radius: float  # of the closed loop [1]
    gain_margin: float  # largest common factor on all gains with every smaller one stable [1]
    frequency_hz: np.ndarray  # of the tracked controlled link modes [Hz], (J, 3)
    damping_ratio: np.ndarray  # [1], (J, 3): three assembled modes per link mode
    breaking_hz: float  # of the pole that leaves the unit circle at the margin, NaN: none does

    @property
    def is_stable(self) -> bool:
        """Whether this loop and every one with smaller gains is stable."""
        return self.spectral_radius <= 1 + RADIUS_TOLERANCE and self.gain_margin >= 1


class MotionReport(NamedTuple):
    """How the forces of a motion change the margin: at rest, and where they are largest."""

    time: np.ndarray  # [s], (k,)
    axial_force: np.ndarray  # tension in the links [N], (k, 3)
    gain_margin: np.ndarray  # of the loop with the instant frozen [1], (k,)


_closed_loop = jax.jit(closed_loop, static_argnums=0)


#: Instants of a motion at which axial forces are evaluated.
INSTANTS = 401


def _poles(still: np.ndarray, moved: np.ndarray, factor: float) -> np.ndarray:
    """Discrete poles with all gains times a factor."""
    return np.linalg.eigvals(still + factor * moved)


@partial(jax.jit, static_argnums=0)
def _controller(structure: Structure, case: Case) -> Controller:
    return prepare(structure, case).loop.controller


def _parts(
    structure: Structure, case: Case, law: Controller | None = None
) -> list[tuple[slice, Controller | None]]:
    """Controllers to judge, and the modes that each covers; None: the case's own."""
    if law is None and not LAWS[structure.law].is_switching:
        return [(slice(None), None)]
    law = _controller(structure, case) if law is None else law
    return [*linear_parts(jax.tree.map(np.asarray, law))]


@partial(jax.jit, static_argnums=0)
def _forces(structure: Structure, case: Case) -> tuple[Array, PathSample, Array]:
    """Instants of the unshaped motion, and the tension in the links [N], (n, 3)."""
    plant = prepare(structure, case).loop.plant
    time = jnp.linspace(0.0, 1.0, INSTANTS) * end_of_path(case.path)
    sample = sample_path(case.path, time)
    each = jax.vmap(axial_force, (None, 0, 0, 0, None))
    return time, sample, each(plant, *sample, case.load.wrench)


def motion_report(structure: Structure, case: Case) -> MotionReport:
    """Gain margins with the forces that act during the unshaped motion.

    Linearised at its start and where the tension in a link is largest or smallest, with that
    instant frozen, with at least `MARGIN_MODES` plant modes.

    Args:
        structure: static choices, feedback "sampled".
        case: the numbers.

    Raises:
        LinAlgError: an entry of the loop's matrices is not finite.
    """
    plain, case = with_margin_modes(structure, case)
    time, sample, force = jax.tree.map(np.asarray, _forces(plain, case))
    chosen = np.unique([0, *force.argmin(axis=0), *force.argmax(axis=0)])
    wrench = np.asarray(case.load.wrench, force.dtype)

    parts = _parts(plain, case)

    def margin(k: int) -> float:
        moment = Moment(sample.velocity[k], sample.acceleration[k], wrench)
        margins = []
        for _, part in parts:
            matrices = _closed_loop(plain, case, sample.position[k], part, moment)
            poles = partial(_poles, np.asarray(matrices.open), np.asarray(matrices.feedback))
            margins.append(gain_margin(cache(poles)))
        return min(margins)

    with threadpool_limits(1, "blas"):
        margins = [margin(k) for k in chosen]
    return MotionReport(time[chosen], force[chosen], np.array(margins))


def loop_report(
    structure: Structure,
    case: Case,
    pose: Array,
    n_tracked: int = 3,
    law: Controller | None = None,
    n_modes: int = MARGIN_MODES,
) -> LoopReport:
    """Spectral radius, gain margin and damping of the lowest link modes.

    Modes are traced from zero gain to full gain, so that filter poles are not mistaken for them.
    If channels act one at a time, the report is the worst over them, each judged alone.

    Args:
        structure: static choices.
        case: the numbers.
        pose: where to linearise [m, m, rad], (3,).
        n_tracked: J, link modes to follow.
        law: controller to judge instead of the case's own.
        n_modes: plant modes per link at least.

    Raises:
        LinAlgError: an entry of the loop's matrices is not finite.
    """
    plain, case = with_margin_modes(structure, case, n_modes)
    parts = _parts(plain, case, law)
    period = float(case.electronics.period)
    with threadpool_limits(1, "blas"):  # many small matrices: more threads only slow them down
        reports = [
            _judged(_closed_loop(plain, case, pose, part), period, n_tracked) for _, part in parts
        ]
    chosen = [modes for modes, _ in parts]
    least = min(reports, key=lambda one: one.gain_margin)
    return LoopReport(
        spectral_radius=max(one.spectral_radius for one in reports),
        gain_margin=least.gain_margin,
        frequency_hz=mode_by_mode(chosen, [one.frequency_hz for one in reports]),
        damping_ratio=mode_by_mode(chosen, [one.damping_ratio for one in reports]),
        breaking_hz=least.breaking_hz,
    )


def mode_by_mode(modes: list[slice], each: list[np.ndarray]) -> np.ndarray:
    """Merge the results of a law's parts, each for its own modes; the first part's for the rest.

    Args:
        modes: those each part covers, see `linear_parts`.
        each: each part's result for all modes, (J, ...).
    """
    whole = np.array(each[0])
    for chosen, values in zip(modes, each, strict=True):
        whole[chosen] = values[chosen]
    return whole


def _judged(matrices: LoopMatrices, period: float, n_tracked: int) -> LoopReport:
    matrices = jax.tree.map(np.asarray, matrices)
    poles = cache(partial(_poles, matrices.open, matrices.feedback))
    start = np.exp(link_poles(matrices.plant, n_tracked).ravel() * period)
    tracked = follow_poles(start, map(poles, map(float, STEPS)))[-1].reshape(-1, 3)
    decay = np.log(tracked) / period
    missing = ((0, n_tracked - len(tracked)), (0, 0))
    frequency, zeta = (
        np.pad(x, missing, constant_values=np.nan)
        for x in (np.abs(decay) / (2 * np.pi), -decay.real / np.abs(decay))
    )
    radius = float(np.abs(poles(1.0)).max())
    margin = gain_margin(poles, STEPS)
    return LoopReport(
        spectral_radius=radius,
        gain_margin=margin,
        frequency_hz=frequency,
        damping_ratio=zeta,
        breaking_hz=_breaking_hz(poles, margin, period),
    )


def _breaking_hz(poles: Callable[[float], np.ndarray], margin: float, period: float) -> float:
    """Frequency of the pole that is unstable just beyond a margin [Hz], NaN if none is."""
    if margin >= HIGHEST:
        return np.nan
    beyond = poles(max(1.001 * margin, LOWEST))
    pole = beyond[np.argmax(np.abs(beyond))]
    return float(abs(np.angle(pole)) / (2 * np.pi * period))


def gain_margin(
    poles: Callable[[float], np.ndarray],
    first: np.ndarray | None = None,
    highest: float = HIGHEST,
) -> float:
    """Largest factor on all gains with every smaller one stable.

    Args:
        poles: discrete poles by factor; called repeatedly with the same factor, so cache it.
        first: factors to start with, rising [1]; default: only `FIRST`.
        highest: where to stop [1].

    Returns:
        [1], with a relative error of 1e-4; 0 if even `LOWEST` is unstable.
    """

    @cache
    def excess(factor: float) -> float:
        return float(np.log(np.abs(poles(factor)).max()) - np.log1p(RADIUS_TOLERANCE))

    first = np.array([FIRST]) if first is None else first
    first = first[first < highest]
    last = float(first[-1]) if len(first) else highest
    count = int(np.ceil(np.log(highest / last) / np.log(STRIDE)))
    low = 0.0
    for high in map(float, [*first[:-1], *np.geomspace(last, highest, count + 1)]):
        if excess(high) > 0:
            break
        low = high
    else:
        return highest
    low = low or high / DESCENT
    while excess(low) > 0:
        if low <= LOWEST:
            return 0.0
        high, low = low, low / DESCENT
    from scipy.optimize import brentq  # takes a quarter of a second

    return float(brentq(excess, low, high, xtol=2e-5 * low, rtol=2e-5))


def follow_poles(start: np.ndarray, sets: Iterable[np.ndarray]) -> np.ndarray:
    """Trace poles while the loop changes step by step.

    Each is matched to the pole nearest to its extrapolated position; none is matched twice.

    Args:
        start: poles to follow, (m,).
        sets: all poles of the loop after each step, (n,) each.

    Returns:
        the poles after each step, (steps, m).
    """
    tracked, velocity, path = start, np.zeros_like(start), []
    for candidates in map(list, sets):
        found = []
        for wanted in tracked + velocity:
            nearest = int(np.argmin(np.abs(np.array(candidates) - wanted)))
            found.append(candidates.pop(nearest))
        velocity, tracked = np.array(found) - tracked, np.array(found)
        path.append(tracked)
    return np.array(path)


def link_poles(state: np.ndarray, n_tracked: int) -> np.ndarray:
    """Poles [rad/s] of the uncontrolled link modes, in threes by ascending frequency, (J, 3).

    These are the eigenvalues whose eigenvectors lie mainly in the modal coordinates.

    Args:
        state: A of the plant, `LoopMatrices.plant`.
        n_tracked: J at most; overdamped modes have no such pole.
    """
    modes = (state.shape[0] - 6) // 2
    value, vector = np.linalg.eig(state)
    upper = value.imag > 0
    vector, value = vector[:, upper], value[upper]
    weight = np.abs(vector[:3]).max(axis=0) / np.abs(vector[6 : 6 + modes]).max(axis=0)
    # at most three pairs belong to the pose on its drive: those with the largest pose share
    n_rigid = value.size - modes
    flexible = np.sort_complex(1j * value[np.argsort(weight)[: value.size - max(n_rigid, 0)]])
    flexible = flexible[np.argsort(np.abs(flexible))] / 1j
    kept = min(flexible.size // 3, n_tracked)
    return flexible[: 3 * kept].reshape(kept, 3)
