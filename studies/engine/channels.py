"""The controller in the form code needs: only active channels, gains folded into numerators.

A channel is a controlled mode of a link (modal control) or a patch (strain rate feedback).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxmodel.channels import Channels
from jaxmodel.controller import Controller


class ActiveChannels(NamedTuple):
    """M channels in the order of links; numbers in SI units."""

    kind: str  # what a channel is, "mode" or "patch"
    link: np.ndarray  # from 0, (M,)
    number: np.ndarray  # of the mode or patch, from 0, (M,)
    filter: np.ndarray  # channel from sensor voltages [m/V] or [1], (M, K)
    first: np.ndarray  # high-pass b0, b1 and a1, (M, 3)
    denominator: np.ndarray  # a1, a2 of the second section [1], (M, 2)
    force: np.ndarray  # its numerator times the gains, sign included [N/m] or [V/V], (M, 3)
    direct: np.ndarray  # force per channel signal past the filters [N/m] or [V/V], (M,)
    synthesizer: np.ndarray  # voltages from the channel's force [V/N] or [1], (M, K)
    # where channels of a link act one at a time: per rival, two rows of (inner, old, older, signal)
    # whose squares sum to its modal energy (omega q)^2 + q'^2 [m2/s2], 0 for others, (M, 2, 4)
    energy: np.ndarray | None = None

    @property
    def is_rival(self) -> np.ndarray:
        """Channels that act only while no other channel of their link has more energy, (M,)."""
        if self.energy is None:
            return np.zeros(len(self.link), bool)
        return np.any(self.energy, axis=(1, 2))

    @property
    def names(self) -> list[str]:
        """Readable names of the channels."""
        pairs = zip(self.link, self.number, strict=True)
        return [f"link {i + 1}, {self.kind} {j + 1}" for i, j in pairs]

    @property
    def slowest_pole(self) -> float:
        """Largest modulus of a pole of the filters [1]."""
        poles = [np.roots([1.0, *denominator]) for denominator in self.denominator]
        return float(max(np.abs([*self.first[:, 2], *np.concatenate(poles)])))

    def memory(self, share: float) -> int:
        """Samples after which only this share of the start is left, for a pole below 1."""
        return int(np.ceil(np.log(share) / np.log(max(self.slowest_pole, 0.1)))) + 8

    @property
    def has_direct(self) -> bool:
        return bool(np.any(self.direct))


def acting(link: np.ndarray, is_rival: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """Which channels act: among a link's rivals only those of highest energy, (..., M).

    Args:
        link: of each channel, (M,).
        is_rival: see `ActiveChannels`, (M,).
        energy: in any common unit, (..., M).
    """
    is_served = np.ones(energy.shape, bool)
    for m in np.flatnonzero(is_rival):
        others = np.flatnonzero(is_rival & (link == link[m]))
        is_served[..., m] = energy[..., m] >= energy[..., others].max(axis=-1)
    return is_served


def fold(feedback: Channels, kind: str) -> ActiveChannels:
    """Active channels of a controller.

    u = -k_d v - k_p x, with v and x outputs of one filter, has one numerator -k_d n_v - k_p n_x.

    Args:
        feedback: NumPy arrays; a channel without gains is left out.
        kind: what a channel is, "mode" or "patch".
    """
    estimator, velocity = feedback.estimator, feedback.velocity_gain
    position = feedback.position_gain
    if position is None:
        position = np.zeros_like(velocity)
    link, number = np.nonzero((velocity != 0) | (position != 0))
    at = link, number

    def gathered(parts: tuple[Any, ...]) -> np.ndarray:
        return np.stack([np.broadcast_to(part, velocity.shape)[at] for part in parts], axis=1)

    energy, rival = None, feedback.rival_omega
    if rival is not None and np.any(rival):
        omega, direct = np.broadcast_to(rival, velocity.shape)[at], gathered((estimator.direct,))
        rate = np.hstack([gathered(estimator.velocity), 0 * direct])
        place = omega[:, None] * np.hstack([gathered(estimator.position), direct])
        energy = np.stack([rate * (omega > 0)[:, None], place], axis=1)
    force = -velocity[at][:, None] * gathered(estimator.velocity)
    force = force - position[at][:, None] * gathered(estimator.position)
    return ActiveChannels(
        kind=kind,
        link=link,
        number=number,
        filter=feedback.filter[at],
        first=gathered(estimator.first),
        denominator=gathered(estimator.denominator),
        force=force,
        direct=-position[at] * np.broadcast_to(estimator.direct, velocity.shape)[at],
        synthesizer=np.swapaxes(feedback.synthesizer, 1, 2)[at],
        energy=energy,
    )


def unfold(channels: ActiveChannels, like: Controller) -> Controller:
    """A controller equivalent to the channels, with gains of 1.

    Args:
        channels: of the same law as `like`, for instance with rounded coefficients.
        like: supplies what the channels leave open.
    """
    whole = like.feedback
    assert isinstance(whole, Channels)
    at = channels.link, channels.number
    gain = np.zeros_like(whole.velocity_gain)
    gain[at] = 1.0

    def spread(values: np.ndarray, rest: np.ndarray) -> np.ndarray:
        spread = np.array(np.broadcast_to(rest, gain.shape))
        spread[at] = values
        return spread

    def columns(table: np.ndarray, rest: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(spread(column, part) for column, part in zip(table.T, rest, strict=True))

    estimator = whole.estimator
    none = np.zeros_like(gain)
    taps, back = np.array(whole.filter), np.swapaxes(np.array(whole.synthesizer), 1, 2)
    taps[at], back[at] = channels.filter, channels.synthesizer
    feedback = whole._replace(
        filter=taps,
        synthesizer=np.swapaxes(back, 1, 2),
        velocity_gain=gain,
        position_gain=gain,
        estimator=estimator._replace(
            first=columns(channels.first, estimator.first),
            denominator=columns(channels.denominator, estimator.denominator),
            velocity=columns(-channels.force, (none,) * len(estimator.position)),
            position=(none,) * len(estimator.position),
            direct=spread(-channels.direct, none),
        ),
    )
    return like._replace(feedback=feedback)
