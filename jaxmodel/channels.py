"""Feedback by channels: modal filter, estimator, gains and synthesizer, channel by channel.

Modes of a link are channels under modal control, patches under strain rate feedback. Shapes: links
first, then patches (K) or channels (C), then lanes. `jaxmodel.state_space` is the other form of
feedback, with the same methods.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.estimator import Estimator, FilterState, advance_filters, weighted
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num


class Channels(NamedTuple):
    """Coefficients of the channels of each link."""

    filter: Num[Array, "links C K"]  # channels from sensor voltages [m/V] (SRF: identity)
    estimator: Estimator
    velocity_gain: Num[Array, "links C"]  # [N s/m] (SRF: [s])
    position_gain: Num[Array, "links C"] | None  # [N/m] (SRF: [1]), None if there is none
    synthesizer: Num[Array, "links K C"]  # voltages from channel forces [V/N] (SRF: identity)
    # [rad/s]: among a link's channels with a value above 0, only the one of highest modal
    # energy acts (modified IMSC); None: all act
    rival_omega: Num[Array, "links C"] | None = None

    @property
    def acting(self) -> np.ndarray:
        """Channels with gains, (3, C); NumPy arrays."""
        position = 0.0 if self.position_gain is None else self.position_gain
        return np.asarray((self.velocity_gain != 0) | (position != 0))

    @property
    def has_output(self) -> bool:
        """Whether it does anything; NumPy arrays."""
        return bool(np.any(self.acting))

    def at_rest(self) -> FilterState:
        """State zero."""
        zero = jnp.zeros_like(jnp.asarray(self.velocity_gain))
        return FilterState(zero, (zero, zero))

    def step(self, state: FilterState, voltage: Array) -> tuple[FilterState, Array]:
        """One sample.

        Args:
            state: from the last sample.
            voltage: of the sensors [V], (3, K).

        Returns:
            (next state, voltages wanted on the actuators [V], (3, K)).
        """
        channel = jnp.sum(self.filter * voltage[:, None], axis=2)
        state, line = advance_filters(self.estimator, state, channel)
        rate = weighted(self.estimator.velocity, line)
        force = -self.velocity_gain * rate
        if self.position_gain is not None or self.rival_omega is not None:
            value = weighted(self.estimator.position, line) + self.estimator.direct * channel
            if self.position_gain is not None:
                force = force - self.position_gain * value
            if self.rival_omega is not None:
                force = force * strongest(self.rival_omega, value, rate)
        return state, jnp.sum(self.synthesizer * force[:, None], axis=2)

    def limited(self, state: FilterState, change: Array) -> FilterState:
        """The next state: what limits change does not matter to filters of sensors."""
        return state

    def amplified(self, factor: Array) -> Channels:
        """All gains times a factor: one for all, or one for each channel, (3, C)."""
        position = self.position_gain
        return self._replace(
            velocity_gain=factor * self.velocity_gain,
            position_gain=None if position is None else factor * position,
        )

    def without_rivals(self) -> Channels:
        """The same where all channels act."""
        return self._replace(rival_omega=None)

    def linear_parts(self) -> list[tuple[slice, Channels]]:
        """See `jaxmodel.controller.linear_parts`."""
        if self.rival_omega is None:
            return [(slice(None), self)]
        parts = []
        for j in np.flatnonzero(np.any(self.rival_omega, axis=0)):
            alone = np.arange(self.rival_omega.shape[1]) == j
            part = self.amplified(alone)._replace(rival_omega=np.zeros_like(self.rival_omega))
            parts.append((slice(j, j + 1), part))
        return parts or [(slice(None), self)]

    def padded(self, n_channels: int) -> Channels:
        """The same with idle channels, so that all laws have one shape; NumPy arrays."""
        shape = self.velocity_gain.shape
        more = n_channels - shape[1]

        def pad(x: Array, axis: int = 1) -> np.ndarray:
            return np.pad(x, [(0, more if k == axis else 0) for k in range(x.ndim)])

        def repeat(x: Array) -> np.ndarray:
            return np.pad(np.broadcast_to(x, shape), ((0, 0), (0, more)), mode="edge")

        position, rival = self.position_gain, self.rival_omega
        return Channels(
            filter=pad(self.filter),
            estimator=jax.tree.map(repeat, self.estimator),
            velocity_gain=pad(self.velocity_gain),
            position_gain=pad(np.zeros(shape) if position is None else position),
            synthesizer=pad(self.synthesizer, 2),
            rival_omega=None if rival is None else pad(rival),
        )


def strongest(omega: Array, value: Array, rate: Array) -> Array:
    """1 for the channel of highest modal energy (omega q)^2 + q'^2 of each link, 0 for its rivals.

    Modified IMSC (Baz and Poh 1988): all actuators of a link serve one mode at a time. A channel
    with omega = 0 has no rivals and always acts.

    Args:
        omega: frequency of each channel [rad/s], (3, C).
        value: estimated q [m], (3, C).
        rate: estimated q' [m/s], (3, C).
    """
    is_rival = omega > 0
    energy = jnp.where(is_rival, (omega * value) ** 2 + rate**2, 0.0)
    is_first = energy >= jnp.max(energy, axis=1, keepdims=True)
    return jnp.where(is_rival & ~is_first, 0.0, 1.0).astype(energy.dtype)
