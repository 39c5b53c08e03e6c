"""A linearised loop on the host, and what moves at its poles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.sampled_loop import RADIUS_TOLERANCE, LoopMatrices
from studies.engine.eigenvalues import eigenvalues

#: A mode or link with this share of the largest one's energy is named with it [1].
PART = 1 / 3


class SampledLoop(NamedTuple):
    """A linearised loop on the host."""

    open: np.ndarray  # transition over a sample without gains, (n, n)
    feedback: np.ndarray  # what the gains add, (n, n)
    mode_poles: np.ndarray  # of the link modes without control [rad/s], NaN: overdamped, (J, 3)
    omega: np.ndarray  # of the links' coordinates [rad/s], (3, R)
    has_stretch: bool  # the last of them is an elongation
    period: float  # [s]
    is_drive: np.ndarray  # whether an entry of the state belongs to pose or drive, (n,)

    @property
    def n_modes(self) -> int:
        """Of each link."""
        return self.omega.shape[1] - self.has_stretch

    @property
    def is_open_loop_stable(self) -> bool:
        """Whether the plant is stable without control: no link beyond its critical force."""
        return bool(np.abs(self.poles(0.0)).max() <= 1 + RADIUS_TOLERANCE)

    def poles(self, factor: float) -> np.ndarray:
        """Discrete poles with all gains times a factor, (n,)."""
        return eigenvalues(self.open + factor * self.feedback)


def sampled_loop(
    matrices: LoopMatrices, omega: np.ndarray, period: float, n_tracked: int, has_stretch: bool
) -> SampledLoop:
    """A loop on the host from matrices of `jaxmodel.sampled_loop`, NumPy arrays."""
    count, size, last = len(omega), len(matrices.plant), 2 * (len(omega) + omega.size)
    place = np.arange(len(matrices.open))
    is_drive = (place < 2 * count) | ((place >= last) & (place < size))  # its motors' states
    if matrices.reference is not None:  # the states that it enters are those of a sampled drive
        is_drive |= np.any(matrices.reference != 0, axis=1)
    return SampledLoop(
        open=matrices.open,
        feedback=matrices.feedback,
        mode_poles=link_poles(matrices.plant, count, n_tracked, n_motors=size - last),
        omega=omega,
        has_stretch=has_stretch,
        period=period,
        is_drive=is_drive,
    )


def link_poles(
    state: np.ndarray, n_links: int, n_tracked: int, n_rigid: int | None = None, n_motors: int = 0
) -> np.ndarray:
    """Poles [rad/s] of the uncontrolled link modes, by order, then ascending, (J, n_links).

    A pole belongs to the order of modes, or to the pose on its drives, that takes part in its
    eigenvector most, by participation factors as in `name_motion`; of all ways to give each pole
    one place, the one with the largest sum. An order of which a mode is overdamped, and so has no
    such pole, is NaN.

    Args:
        state: A of the plant, `LoopMatrices.plant`.
        n_links: their number.
        n_tracked: J.
        n_rigid: coordinates before the modes; None: as many as links, those of the pose.
        n_motors: states after the modes, of motors, which count as the drives'.
    """
    first, last = 2 * (n_links if n_rigid is None else n_rigid), len(state) - n_motors
    from scipy.linalg import eig
    from scipy.optimize import linear_sum_assignment  # they take a quarter of a second

    value, left, right = eig(state, left=True)
    upper = value.imag > 0
    value, factor = value[upper], (left.conj() * right)[:, upper]
    factor = (factor / factor.sum(axis=0)).real
    orders = factor[first:last].reshape(2, n_links, -1, value.size).sum(axis=(0, 1))
    share = np.vstack([factor[:first].sum(axis=0) + factor[last:].sum(axis=0), orders])
    place = np.repeat(np.arange(len(share)), [first // 2 + n_motors, *[n_links] * len(orders)])
    which, at = linear_sum_assignment(share[place].T, maximize=True)
    order = np.full(value.size, -1)
    order[which] = place[at] - 1
    poles = np.full((n_tracked, n_links), np.nan, complex)
    for j in range(n_tracked):
        if np.sum(order == j) == n_links:
            poles[j] = sorted(value[order == j], key=abs)
    return poles


def name_motion(loop: SampledLoop, factor: float, pole: complex) -> str:
    """What moves at a pole: "mode 7 of links 1+2 (5606 Hz)", "stretch of link 3", or the drives.

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
    n, r = loop.omega.shape
    # the rest is sensors behind their filters, the controller, and the drive
    first, last = 2 * n, 2 * n + 2 * n * r
    share = left * right
    parts = (share[loop.is_drive], share[first:last], share[last:][~loop.is_drive[last:]])
    drive, links, filters = (abs(part.sum()) for part in parts)
    hertz = abs(np.log(pole)) / loop.period / (2 * np.pi)
    if drive > max(links, filters):
        return f"drives ({hertz:.0f} Hz)"
    q, q_rate = np.abs(right[first:last].reshape(2, n, r))
    energy = (loop.omega * q) ** 2 + q_rate**2
    by_order = energy.sum(axis=0)
    modes, moving = _dominant(by_order[: loop.n_modes]), _dominant(energy.sum(axis=1))
    own = ", ".join(f"{loop.omega[moving, j].mean() / (2 * np.pi):.0f}" for j in modes)
    text = f"{_numbered('mode', modes)} of {_numbered('link', moving)} ({own} Hz)"
    if loop.has_stretch and by_order.argmax() == loop.n_modes:
        text = f"stretch of {_numbered('link', moving)}"
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
