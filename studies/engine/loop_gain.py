"""L of many loops at many frequencies, by the compiled response of `jaxmodel.sampled_response`.

Points of all loops go through one program, as many as there are, on this machine's cores.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.controller import Controller
from jaxmodel.parameters import Array
from jaxmodel.sampled_response import SampledLoopResponse, command_gain, controller_response
from studies.engine.programs import kept_jit

#: Points of a call at most, and those evaluated at once, which stay in a processor's cache.
SIZE, AT_ONCE = 1024, 32


class LoopGains(NamedTuple):
    """L(e^(j omega T)) = -K P of n loops at the m commands that act."""

    response: SampledLoopResponse  # leaves (N, ...)
    owner: np.ndarray  # response of each loop, (n,)
    acting: np.ndarray  # numbers of the commands, (m,)

    @property
    def period(self) -> np.ndarray:
        """Sample time [s], (n,)."""
        return np.asarray(self.response.plant.period)[self.owner]

    @property
    def top(self) -> np.ndarray:
        """Half the sample rate [rad/s], (n,)."""
        return np.pi / self.period

    def part(self, rows: np.ndarray) -> LoopGains:
        """Some of the loops, also repeated."""
        return self._replace(owner=self.owner[rows])

    def searched(self, omega: np.ndarray) -> np.ndarray:
        """L to 1e-4, (n, F, m, m).

        Args:
            omega: above 0 [rad/s], (n, F).
        """
        return self._gains(omega, np.zeros(omega.shape), is_exact=False)

    def exact(self, omega: np.ndarray, delay: np.ndarray | None = None) -> np.ndarray:
        """L with all images of the spectrum, (n, F, m, m).

        Args:
            omega: above 0 [rad/s], (n, F).
            delay: a further one [samples], (n, F); None: none.
        """
        return self._gains(omega, np.zeros(omega.shape) if delay is None else delay, is_exact=True)

    def at_delay(self, omega: np.ndarray, delay: np.ndarray) -> np.ndarray:
        """L to 1e-4 with further delays, arguments as for `exact`."""
        return self._gains(omega, delay, is_exact=False)

    def _gains(self, omega: np.ndarray, delay: np.ndarray, is_exact: bool) -> np.ndarray:
        owner = np.repeat(self.owner, omega.shape[1])
        m, found = len(self.acting), [np.zeros((0, len(self.acting), len(self.acting)), complex)]
        for first in range(0, omega.size, SIZE):
            part = [x[first : first + SIZE] for x in (owner, omega.ravel(), delay.ravel())]
            count = len(part[0])
            part = [np.concatenate([x, np.repeat(x[-1:], SIZE - count)]) for x in part]
            gain = np.asarray(_command_gains(is_exact, self.response, count, *part))[:count]
            found.append(gain[:, self.acting][..., self.acting])
        return np.concatenate(found).reshape(*omega.shape, m, m)


@kept_jit(static_argnums=0)
def _command_gains(
    is_exact: bool,
    response: SampledLoopResponse,
    count: Array,
    owner: Array,
    omega: Array,
    delay: Array,
) -> Array:
    """L at the first points, (SIZE, 3 K, 3 K)."""

    def one(k: Array, w: Array, late: Array) -> Array:
        return command_gain(jax.tree.map(lambda x: x[k], response), w, late, is_exact)

    def some(number: Array, found: Array) -> Array:
        first = number * AT_ONCE
        points = (jax.lax.dynamic_slice(x, (first,), (AT_ONCE,)) for x in (owner, omega, delay))
        return jax.lax.dynamic_update_slice_in_dim(found, jax.vmap(one)(*points), first, 0)

    like = jax.eval_shape(one, owner[0], omega[0], delay[0])
    found = jnp.zeros((SIZE, *like.shape), like.dtype)
    return jax.lax.fori_loop(0, (count + AT_ONCE - 1) // AT_ONCE, some, found)


def loop_gains(response: SampledLoopResponse) -> LoopGains:
    """Loop gains by frequency responses, leaves (n, ...), NumPy in float64."""
    acting = np.flatnonzero(np.any(acting_commands(response.controller), axis=0))
    return LoopGains(response, np.arange(len(response.plant.period)), acting)


@kept_jit(is_quick=True)
def acting_commands(controller: Controller) -> Array:
    """Which commands act, (n, l K)."""

    def seen(one: Controller) -> Array:
        each = [controller_response(one, np.exp(1j * angle)) != 0 for angle in (0.3, 3.0)]
        return (each[0] | each[1]).any(axis=1)

    return jax.vmap(seen)(controller)
