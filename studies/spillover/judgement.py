"""What moves at the poles of a loop, in words: the mode of least damping, and what breaks it."""

from __future__ import annotations

import numpy as np

from studies.engine.stability import LoopFigures, SampledLoop, breaking_factor, pole_beyond
from studies.study.margin import HIGHEST

#: A mode or link with this share of the largest one's energy is named with it [1].
PART = 1 / 3


def weakest_mode(loop: SampledLoop, figures: LoopFigures) -> str:
    """The mode of least damping, "" if all are overdamped.

    Args:
        loop: the loop.
        figures: its figures.
    """
    ratio = figures.damping_ratio
    if np.all(np.isnan(ratio)):
        return ""
    at = np.unravel_index(np.nanargmin(ratio), ratio.shape)
    zeta, omega = ratio[at], 2 * np.pi * figures.frequency_hz[at]
    decay = omega * (-zeta + 1j * np.sqrt(max(1 - zeta**2, 0.0)))
    return name_motion(loop, 1.0, np.exp(decay * loop.period))


def breaking_motion(loop: SampledLoop, margin: float) -> str:
    """What goes unstable just beyond the margin, "" if that is `HIGHEST`."""
    if margin >= HIGHEST:
        return ""
    return name_motion(loop, breaking_factor(margin), pole_beyond(loop, margin))


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
    modes, moving = _dominant(energy.sum(axis=0)), _dominant(energy.sum(axis=1))
    own = ", ".join(f"{loop.omega[moving, j].mean() / (2 * np.pi):.0f}" for j in modes)
    text = f"{_numbered('mode', modes)} of {_numbered('link', moving)} ({own} Hz)"
    if links > filters:
        return text
    if hertz < 1:
        return f"{text}, statically"
    return f"a controller's filter at {hertz:.0f} Hz, fed by {text}"


def _dominant(energy: np.ndarray) -> list[int]:
    """The largest one and all with at least `PART` of it."""
    return [int(k) for k in np.flatnonzero(energy >= PART * energy.max())]


def _numbered(name: str, numbers: list[int]) -> str:
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
