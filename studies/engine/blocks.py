"""A controller without channels in the form code needs: systems of controlled links, in 2x2 blocks.

All arrays have the groups first: the controlled links, each with its own system, or one system for
all links together.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
import scipy

from jaxmodel.controller import Controller
from jaxmodel.state_space import IllConditionedError, StateSpace, dense, modal_form
from studies.errors import StudyError


class ModalBlocks(NamedTuple):
    """G groups of N blocks with M sensors and as many actuators; NumPy arrays."""

    n_links: int  # of the machine
    link: np.ndarray  # controlled links, from 0
    first: np.ndarray  # sensor and actuator of each group's first port, from 0, (G,)
    system: StateSpace  # of these groups, blocks of 2 states

    @property
    def kind(self) -> str:
        """As `ActiveChannels.kind`."""
        return "none"

    @property
    def names(self) -> list[str]:
        """Readable names of the states."""
        groups, n = self.system.state.shape[:2]
        places = [f"link {i + 1}, " for i in self.link] if len(self.link) == groups else [""]
        return [f"{at}block {k + 1}.{r + 1}" for at in places for k in range(n) for r in range(2)]

    @property
    def slowest_pole(self) -> float:
        """Largest modulus of a pole [1]."""
        poles = np.linalg.eigvals(self.system.state)
        return float(np.abs(poles).max(initial=0.0))

    def memory(self, share: float) -> int:
        """Samples after which only this share of the start is left, for a pole below 1."""
        return int(np.ceil(np.log(share) / np.log(max(self.slowest_pole, 0.1)))) + 8

    def of_groups(self, volts: np.ndarray) -> np.ndarray:
        """Voltages of ports by group, (..., G, M), from those of all patches, (..., n, K)."""
        size = self.system.direct.shape[1]
        at = self.first[:, None] + np.arange(size)
        return volts.reshape(*volts.shape[:-2], -1)[..., at]

    def of_patches(self, volts: np.ndarray, n_patches: int) -> np.ndarray:
        """The reverse, 0 for patches of no group."""
        size = self.system.direct.shape[1]
        whole = np.zeros((*volts.shape[:-2], self.n_links * n_patches), volts.dtype)
        whole[..., self.first[:, None] + np.arange(size)] = volts
        return whole.reshape(*volts.shape[:-2], self.n_links, n_patches)


def modal_blocks(system: StateSpace, n_links: int) -> ModalBlocks:
    """Modal blocks of a machine's system, NumPy arrays; links without output are left out.

    Raises:
        StudyError: no well-conditioned modal form.
    """
    is_on = np.any(system.leave, axis=(2, 3)) | np.any(system.direct, axis=2)
    is_on = is_on.reshape(n_links, -1)
    used, n_patches = np.flatnonzero(is_on.any(axis=1)), is_on.shape[1]
    if system.state.shape[0] == 1:
        groups, first = [0], np.array([0])
    else:
        groups, first = list(used), used * n_patches
    return ModalBlocks(n_links, used, first, _stack_groups([_to_pairs(system, g) for g in groups]))


def _to_pairs(system: StateSpace, group: int) -> StateSpace:
    """One group, its blocks of two states."""
    one = jax.tree.map(lambda part: part[group : group + 1], system)
    if system.state.shape[2] == 2:
        return one
    a, b, c, d = dense(one)
    size, tell = len(d), one.anti_windup
    if tell is not None:
        b = np.hstack([b, tell.reshape(len(a), size)])
    try:
        form = modal_form(a, b, c)
    except IllConditionedError as error:
        raise StudyError(f"the controller has {error}") from None
    enter = form.enter[None, ..., :size]
    tell = None if tell is None else form.enter[None, ..., size:]
    return StateSpace(
        state=form.state[None],
        enter=enter,
        leave=form.leave[None],
        direct=d[None],
        anti_windup=tell,
    )


def _stack_groups(parts: list[StateSpace]) -> StateSpace:
    """Groups side by side, padded with blocks that stay 0."""
    most = max((part.state.shape[1] for part in parts), default=0)
    tell = [part.anti_windup for part in parts if part.anti_windup is not None]

    def padded(x: np.ndarray, axis: int) -> np.ndarray:
        more = most - x.shape[axis]
        return np.pad(x, [(0, more if k == axis else 0) for k in range(x.ndim)])

    return StateSpace(
        state=np.concatenate([padded(x.state, 1) for x in parts]),
        enter=np.concatenate([padded(x.enter, 1) for x in parts]),
        leave=np.concatenate([padded(x.leave, 2) for x in parts]),
        direct=np.concatenate([x.direct for x in parts]),
        anti_windup=np.concatenate([padded(x, 1) for x in tell]) if tell else None,
    )


def unfold_blocks(blocks: ModalBlocks, like: Controller) -> Controller:
    """A controller equivalent to the blocks; `like` supplies what they leave open."""
    system, count = blocks.system, len(like.feedback.state)  # type: ignore[union-attr]
    if count == 1:
        return like._replace(feedback=system)

    def spread(part: np.ndarray) -> np.ndarray:
        whole = np.zeros((count, *part.shape[1:]))
        whole[blocks.link] = part
        return whole

    return like._replace(feedback=jax.tree.map(spread, system))


class ImpulseResponses(NamedTuple):
    """Impulse responses of one group over n samples."""

    state: np.ndarray  # of each state, per sensor, (N, 2, M, n)
    command: np.ndarray  # of each actuator, per sensor, (M, M, n)
    kicked: np.ndarray  # of each actuator, to what is added to a state, (M, N, 2, n)


def responses(system: StateSpace, group: int, n: int) -> ImpulseResponses:
    """Impulse responses by second-order filters, block by block.

    Args:
        system: blocks of two states.
        group: which group.
        n: samples.
    """
    state, enter, leave, direct = (part[group] for part in system[:4])
    count, size = len(state), len(direct)
    impulse = np.zeros(n)
    impulse[0] = 1.0
    response = ImpulseResponses(
        state=np.zeros((count, 2, size, n)),
        command=np.zeros((size, size, n)),
        kicked=np.zeros((size, count, 2, n)),
    )
    response.command[:, :, 0] = direct
    for k, a in enumerate(state):
        below = [1.0, -np.trace(a), np.linalg.det(a)]
        # (z - A)^-1 = (z + A - tr A)/(z^2 - z tr A + det A), in powers of 1/z
        last = a + below[1] * np.eye(2)
        moved = np.array(
            [
                [scipy.signal.lfilter([0.0, i == r, last[i, r]], below, impulse) for r in (0, 1)]
                for i in (0, 1)
            ]
        )
        response.state[k] = np.einsum("irn,rm->imn", moved, enter[k])
        response.command[:] += np.einsum("pi,imn->pmn", leave[:, k], response.state[k])
        response.kicked[:, k] = np.einsum("pi,irn->prn", leave[:, k], moved)
    return response
