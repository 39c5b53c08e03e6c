"""Descent methods: Adam, or L-BFGS with a separate line search for each start.

All starts are evaluated in one batch, so a line search cannot request values for just one of them.
It runs across iterations instead: a start whose trial is not good enough tries a shorter step in
the next iteration, while the others continue. Places lie between 0 and 1; a step beyond a bound
ends there.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
import optax

#: First and last step of Adam, as a share of the bounds.
FIRST_STEP, LAST_STEP = 0.05, 0.002
#: Longest step of L-BFGS in any number, and the one along the steepest slope.
LONGEST, STEEPEST = 0.15, 0.05
#: Share of the predicted decrease that a step must achieve (Armijo); factor of a rejected step.
PROMISE, SHRINK = 1e-4, 0.35
#: Steps below this share of the first one restart along the slope.
SHORTEST = 0.02
#: Steps that L-BFGS remembers.
MEMORY = 8


_LBFGS = optax.scale_by_lbfgs(memory_size=MEMORY)
_update = jax.jit(_LBFGS.update)


class Trial(NamedTuple):
    """Evaluated designs, and where they came from; starts first."""

    base: np.ndarray  # last accepted place, (B, p)
    place: np.ndarray  # of the trial, (B, p)
    base_merit: np.ndarray  # (B,); inf before the first
    merit: np.ndarray  # nan if it did not finish, (B,)
    base_slope: np.ndarray  # (B, p)
    slope: np.ndarray  # (B, p)


class Descent(Protocol):
    """A descent method. States are tuples of arrays, starts first, so that they can be saved."""

    def begin(self, place: np.ndarray) -> tuple[np.ndarray, ...]:
        """State before the first trial."""
        ...

    def step(
        self, state: tuple[np.ndarray, ...], trial: Trial
    ) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
        """Return (next state, which trials are accepted (B,), next places (B, p))."""
        ...


class Adam:
    """optax.adam with steps that shrink along a cosine."""

    def __init__(self, iterations: int) -> None:
        steps = optax.cosine_decay_schedule(FIRST_STEP, iterations, LAST_STEP / FIRST_STEP)
        self._optimiser = optax.adam(steps)

    def begin(self, place: np.ndarray) -> tuple[np.ndarray, ...]:
        return _arrays(self._optimiser.init(place))

    def step(self, state: Any, trial: Any) -> Any:
        is_fine = np.isfinite(trial.merit)
        slope = np.where(is_fine[:, None], trial.slope, 0.0)
        tree = jax.tree.structure(self._optimiser.init(trial.place))
        steps, after = self._optimiser.update(slope, jax.tree.unflatten(tree, state))
        moved = np.clip(trial.place + np.asarray(steps), 0.0, 1.0)
        # if no run finishes: half the way back
        return _arrays(after), is_fine, np.where(is_fine[:, None], moved, _interpolate(trial, 0.5))


class Lbfgs:
    """optax.scale_by_lbfgs for each start, with a backtracking line search over iterations."""

    def begin(self, place: np.ndarray) -> tuple[np.ndarray, ...]:
        # direction, share of it that the trial goes, then what optax remembers
        return np.zeros_like(place), np.ones(len(place)), *_arrays(jax.vmap(_LBFGS.init)(place))

    def step(self, state: Any, trial: Any) -> Any:
        direction, share, *memory = state
        is_first = ~np.isfinite(trial.base_merit)
        promised = np.sum(trial.base_slope * (trial.place - trial.base), axis=1)
        with np.errstate(invalid="ignore"):
            gained = trial.merit <= trial.base_merit + PROMISE * np.minimum(promised, 0.0)
        is_taken = np.isfinite(trial.merit) & (is_first | gained)
        chosen = is_taken[:, None]
        ahead, memory = self._remember(memory, trial, is_taken)
        base = np.where(chosen, trial.place, trial.base)
        slope = np.where(chosen, trial.slope, trial.base_slope)
        share = np.where(is_taken, 1.0, SHRINK * share)
        is_stuck = share < SHORTEST
        ahead = _keep_inside(base, np.where(chosen, -ahead, direction))
        is_uphill = np.sum(ahead * slope, axis=1) >= 0
        along = (is_stuck | is_uphill)[:, None]
        direction = np.where(along, _steepest(base, slope), _limit_length(ahead))
        share = np.where(is_stuck, 1.0, share)
        after = direction, share, *memory
        return after, is_taken, np.clip(base + share[:, None] * direction, 0.0, 1.0)

    def _remember(self, memory: Any, trial: Any, is_taken: Any) -> Any:
        """(slopes turned into steps by what optax remembers, (B, p), the new memory)."""
        ahead, memory = trial.slope.copy(), [np.array(x) for x in memory]
        tree = jax.tree.structure(_LBFGS.init(trial.place[0]))
        # one start after another: XLA's CPU compiler aborts on a batch of them (jax 0.10)
        for k in np.flatnonzero(is_taken):
            state = jax.tree.unflatten(tree, [x[k] for x in memory])
            ahead[k], after = _update(trial.slope[k], state, trial.place[k])
            for whole, new in zip(memory, jax.tree.leaves(after), strict=True):
                whole[k] = new
        return ahead, tuple(memory)


def _arrays(tree: Any) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(x) for x in jax.tree.leaves(tree))


def _interpolate(trial: Trial, share: float) -> np.ndarray:
    """Between the accepted place and the trial, (B, p)."""
    moved = trial.base + share * (trial.place - trial.base)
    return np.where(np.isfinite(moved), moved, trial.base)


def _keep_inside(place: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The direction without components that leave the bounds."""
    leaves = ((place <= 0) & (direction < 0)) | ((place >= 1) & (direction > 0))
    return np.where(leaves | ~np.isfinite(direction), 0.0, direction)


def _steepest(place: np.ndarray, slope: np.ndarray) -> np.ndarray:
    direction = _keep_inside(place, -slope)
    largest = np.abs(direction).max(axis=1, keepdims=True)
    return direction * STEEPEST / np.where(largest > 0, largest, 1.0)


def _limit_length(direction: np.ndarray) -> np.ndarray:
    largest = np.abs(direction).max(axis=1, keepdims=True)
    return direction * np.minimum(1.0, LONGEST / np.where(largest > 0, largest, 1.0))
