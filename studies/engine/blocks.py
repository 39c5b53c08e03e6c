"""A controller without channels in the form code needs: systems of controlled links, in blocks.

All arrays have the groups first: the controlled links, each with its own system, or one system for
all links together. Blocks are pairs of states: a pair of poles, or two real ones. Where that would
cost digits, as nearly equal poles of a long delay line can, each group is one block of the states
that its law was designed in, with the delay line as a shift register.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel.controller import Controller
from jaxmodel.state_space import IllConditionedError, StateSpace, dense, modal_form, used_states

#: What pairs of states may change of a command over the largest, a third of what exports allow [1],
#: and over how many samples both are compared.
ALIKE, COMPARED = 3e-13, 2**13


class ModalBlocks(NamedTuple):
    """G groups of N blocks with M sensors and as many actuators; NumPy arrays."""

    n_links: int  # of the machine
    link: np.ndarray  # controlled links, from 0
    first: np.ndarray  # sensor and actuator of each group's first port, from 0, (G,)
    system: StateSpace  # of these groups, blocks of b states

    @property
    def kind(self) -> str:
        """As `ActiveChannels.kind`."""
        return "none"

    @property
    def names(self) -> list[str]:
        """Readable names of the states."""
        groups, n, size, _ = self.system.state.shape
        places = [f"link {i + 1}, " for i in self.link] if len(self.link) == groups else [""]
        return [
            f"{at}block {k + 1}.{r + 1}" for at in places for k in range(n) for r in range(size)
        ]

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
    """Blocks of a machine's system, NumPy arrays; links without output are left out."""
    is_on = np.any(system.leave, axis=(2, 3)) | np.any(system.direct, axis=2)
    is_on = is_on.reshape(n_links, -1)
    used, n_patches = np.flatnonzero(is_on.any(axis=1)), is_on.shape[1]
    if system.state.shape[0] == 1:
        groups, first = [0], np.array([0])
    else:
        groups, first = list(used), used * n_patches
    own = [jax.tree.map(lambda part, g=g: part[g : g + 1], system) for g in groups]
    if system.state.shape[2] != 2:
        own = [_observed(one) for one in own]
        pairs = [_to_pairs(one) for one in own]
        # all groups have blocks of one size
        own = own if None in pairs else pairs
    return ModalBlocks(n_links, used, first, _stack_groups(own))


def _observed(one: StateSpace) -> StateSpace:
    """One group as one block, without states that nothing depends on, as older commands."""
    a, b, c, d = dense(one)
    tell = None if one.anti_windup is None else one.anti_windup.reshape(b.shape)
    used = used_states(a, c)
    return StateSpace(
        state=a[None, None][..., used, :][..., used],
        enter=b[None, None, used],
        leave=c[None, :, None, used],
        direct=d[None],
        anti_windup=None if tell is None else tell[None, None, used],
    )


def _to_pairs(one: StateSpace) -> StateSpace | None:
    """One group, its blocks of two states; None: that would cost digits."""
    a, b, c, d = dense(one)
    size, tell = len(d), one.anti_windup
    if tell is not None:
        b = np.hstack([b, tell.reshape(len(a), size)])
    try:
        form = modal_form(a, b, c, worst=1 / np.finfo(float).eps)
    except IllConditionedError:
        return None
    pairs = StateSpace(
        state=form.state[None],
        enter=form.enter[None, ..., :size],
        leave=form.leave[None],
        direct=d[None],
        anti_windup=None if tell is None else form.enter[None, ..., size:],
    )
    return pairs if _largest_change(one, pairs) <= ALIKE else None


def _largest_change(one: StateSpace, pairs: StateSpace) -> float:
    """What differs of a command, over the largest that sensors or limits can make it."""
    ways = [(one, pairs)]
    if one.anti_windup is not None:
        ways.append((one._replace(enter=one.anti_windup), pairs._replace(enter=pairs.anti_windup)))
    found = [[responses(x, 0, COMPARED).command for x in way] for way in ways]
    away = [np.abs(x - y).sum(axis=(1, 2)).max() for x, y in found]
    # limits change a demand by less than its size
    return float(np.max([away[0] / np.abs(found[0][0]).sum(axis=(1, 2)).max(), *away[1:]]))


def _stack_groups(parts: list[StateSpace]) -> StateSpace:
    """Groups side by side, padded with states that stay 0."""

    def stacked(*each: np.ndarray) -> np.ndarray:
        most = np.max([x.shape for x in each], axis=0)
        return np.concatenate([np.pad(x, [(0, n) for n in most - x.shape]) for x in each])

    whole: StateSpace = jax.tree.map(stacked, *parts)
    return whole


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

    state: np.ndarray  # of each state, per sensor, (N, b, M, n)
    command: np.ndarray  # of each actuator, per sensor, (M, M, n)
    kicked: np.ndarray  # of each actuator, to what is added to a state, (M, N, b, n)


def responses(system: StateSpace, group: int, n: int) -> ImpulseResponses:
    """Impulse responses, block by block.

    Args:
        system: in blocks.
        group: which group.
        n: samples.
    """
    state, enter, leave, direct = (part[group] for part in system[:4])
    leave = np.moveaxis(leave, 0, -1)  # (N, b, M)
    moved = _powers(state, enter, n - 1)
    command = np.einsum("kbp,nkbm->pmn", leave, moved)
    kicked = _powers(np.swapaxes(state, 1, 2), leave, n - 1)
    return ImpulseResponses(
        state=_later(np.moveaxis(moved, 0, -1)),
        command=np.concatenate([direct[..., None], command], axis=-1),
        kicked=_later(np.moveaxis(kicked, (0, 3), (-1, 0))),
    )


def _later(x: np.ndarray) -> np.ndarray:
    """A sample later, along the last axis."""
    return np.concatenate([np.zeros_like(x[..., :1]), x], axis=-1)


def _powers(matrix: np.ndarray, start: np.ndarray, n: int) -> np.ndarray:
    """M^k S for k = 0 to n - 1 by doubling, (n, ...)."""
    rows = start[None]
    while len(rows) < n:
        rows = np.concatenate([rows, matrix @ rows])
        matrix = matrix @ matrix
    return rows[:n]
