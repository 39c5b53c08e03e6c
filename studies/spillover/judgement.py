"""Judgement of one loop by its poles: damping, gain margin, the mode that breaks it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from studies.engine.stability import follow_poles, gain_margin, mode_by_mode
from studies.spillover.plants import SampledLoop
from studies.study.margin import HIGHEST, LOWEST

#: Gain factors at which modes are traced from no control to the design's gains.
STEPS = np.linspace(0, 1, 17)[1:]
#: A mode or link with this share of the largest one's energy is named with it [1].
PART = 1 / 3


class Judgement(NamedTuple):
    """Judgement of one loop."""

    radius: float  # spectral radius at the given gains [1]
    margin: float  # largest common factor on all gains with every smaller one stable [1]
    frequency_hz: np.ndarray  # of the link modes at the given gains, (r, 3), NaN: overdamped
    damping_ratio: np.ndarray  # [1], (r, 3)
    free_damping: np.ndarray  # without control [1], (r, 3)
    weakest: str  # the mode of least damping
    breaking: str  # what goes unstable first, "" if nothing does up to `HIGHEST`


def judge(loop: SampledLoop) -> Judgement:
    """Judge a loop.

    Args:
        loop: the loop; its gains belong to factor 1.
    """
    poles = cache(loop.poles)
    tracked = follow(loop, STEPS, poles)[-1]
    frequency, zeta = damping(loop, tracked)
    free = np.pad(
        -loop.mode_poles.real / np.abs(loop.mode_poles),
        ((0, loop.n_modes - len(loop.mode_poles)), (0, 0)),
        constant_values=np.nan,
    )
    weakest = ""
    if not np.all(np.isnan(zeta)):
        at = np.unravel_index(np.nanargmin(zeta), zeta.shape)
        weakest = name_motion(loop, 1.0, tracked[at])
    margin = gain_margin(poles, STEPS)
    return Judgement(
        radius=float(np.abs(poles(1.0)).max()),
        margin=margin,
        frequency_hz=frequency,
        damping_ratio=zeta,
        free_damping=free,
        weakest=weakest,
        breaking=breaking_motion(loop, margin),
    )


def worst_of(parts: list[tuple[slice, Judgement]]) -> Judgement:
    """Worst judgement of a law whose channels act one at a time, each with the modes it covers."""
    modes, each = [modes for modes, _ in parts], [judgement for _, judgement in parts]
    lowest = min(each, key=lambda one: one.margin)
    return lowest._replace(
        radius=max(one.radius for one in each),
        frequency_hz=mode_by_mode(modes, [one.frequency_hz for one in each]),
        damping_ratio=mode_by_mode(modes, [one.damping_ratio for one in each]),
    )


def follow(
    loop: SampledLoop, factors: np.ndarray, poles: Callable[[float], np.ndarray]
) -> np.ndarray:
    """Discrete poles of the link modes while the gains grow.

    Args:
        loop: the loop.
        factors: gain factors, rising from near 0 [1], (steps,).
        poles: `loop.poles`, or a cached version.

    Returns:
        (steps, r, 3), NaN where modes are overdamped without control.
    """
    start = np.exp(loop.mode_poles * loop.period)
    path = follow_poles(start.ravel(), map(poles, map(float, factors)))
    path = path.reshape(len(path), -1, 3)
    missing = loop.n_modes - path.shape[1]
    return np.pad(path, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)


def damping(loop: SampledLoop, tracked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequency [Hz] and damping ratio of traced modes.

    A pole z of a mode above half the sample rate is exp(s T) of an s that differs from ln(z)/T by a
    multiple of 2 pi/T: the one nearest to the mode without control is used.

    Args:
        loop: the loop.
        tracked: discrete poles, (..., r, 3).

    Returns:
        two arrays (..., r, 3).
    """
    missing = loop.n_modes - len(loop.mode_poles)
    start = np.pad(loop.mode_poles, ((0, missing), (0, 0)), constant_values=np.nan)
    rate = np.log(tracked) / loop.period
    turn = 2j * np.pi / loop.period
    rate = rate + turn * np.round((start.imag - rate.imag) / turn.imag)
    return np.abs(rate) / (2 * np.pi), -rate.real / np.abs(rate)


def breaking_motion(loop: SampledLoop, margin: float) -> str:
    """What goes unstable just beyond the margin, "" if that is `HIGHEST`."""
    if margin >= HIGHEST:
        return ""
    factor = max(1.001 * margin, LOWEST)
    poles = loop.poles(factor)
    return name_motion(loop, factor, poles[np.argmax(np.abs(poles))])


def name_motion(loop: SampledLoop, factor: float, pole: complex) -> str:
    """What moves at a pole: "mode 7 of links 1+2 (5606 Hz)", or the drive of the sliders.

    The link modes named hold most of the energy omega^2 |q|^2 + |q'|^2 of the eigenvector. Whether
    the motion belongs to a link, the drive or a filter is decided by participation factors,
    products of entries of left and right eigenvectors (Perez-Arriaga, Verghese and Schweppe 1982):
    the pole leaving the unit circle can be a filter's, fed through by a far stiffer mode that
    merely follows. The frequency is that of these modes of these links with held ends.

    Args:
        loop: the loop.
        factor: on all gains [1].
        pole: one of its poles then.
    """
    right, left = _eigenvectors(loop.open + factor * loop.feedback, pole)
    r = loop.n_modes
    last = 6 + 6 * r  # the rest is sensors behind their filters and the controller
    share = left * right
    drive, links, filters = (abs(part.sum()) for part in (share[:6], share[6:last], share[last:]))
    hertz = abs(np.log(pole)) / loop.period / (2 * np.pi)
    if drive > max(links, filters):
        return f"drive of the sliders ({hertz:.0f} Hz)"
    q, q_rate = np.abs(right[6:last].reshape(2, 3, r))
    energy = (loop.omega * q) ** 2 + q_rate**2
    modes, moving = _leading(energy.sum(axis=0)), _leading(energy.sum(axis=1))
    own = ", ".join(f"{loop.omega[moving, j].mean() / (2 * np.pi):.0f}" for j in modes)
    text = f"{_listed('mode', modes)} of {_listed('link', moving)} ({own} Hz)"
    if links > filters:
        return text
    if hertz < 1:
        return f"{text}, statically"
    return f"a controller's filter at {hertz:.0f} Hz, fed by {text}"


def _leading(energy: np.ndarray) -> list[int]:
    """The largest one and all with at least `PART` of it."""
    return [int(k) for k in np.flatnonzero(energy >= PART * energy.max())]


def _listed(name: str, numbers: list[int]) -> str:
    """Like "links 1+2", numbers from 0."""
    return f"{name}{'s' if len(numbers) > 1 else ''} {'+'.join(str(k + 1) for k in numbers)}"


def _eigenvectors(matrix: np.ndarray, pole: complex) -> tuple[np.ndarray, np.ndarray]:
    """Right and left eigenvector of a pole by inverse iteration, (n,) each."""
    # slightly off the pole to keep the matrix regular
    shifted = matrix - pole * (1 + 1e-9) * np.eye(len(matrix))
    right = left = np.ones(len(matrix), complex)
    for _ in range(3):
        right = np.linalg.solve(shifted, right / np.linalg.norm(right))
        left = np.linalg.solve(shifted.T, left / np.linalg.norm(left))
    return right, left
