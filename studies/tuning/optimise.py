"""Many starts at once, each downhill by Adam, limits by an augmented Lagrangian.

Everything between the bounds is scaled to [0, 1]; a step that would leave it ends at the bound. A
start whose runs stop finishing goes half the way back to its best design; one that has none is
frozen. Neither spoils another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from scipy.stats import qmc

from studies.errors import StudyError
from studies.tuning.evaluate import Evaluation, Evaluator
from studies.tuning.spec import TuneSpec

#: First and last step, as a share of the bounds.
FIRST_STEP, LAST_STEP = 0.05, 0.002
#: Iterations between two updates of the multipliers.
ROUND = 5
#: A limit counts as kept up to this share of it.
KEPT = 1e-3
#: Sobol points that are looked at for each start, by the linearised loop alone.
LOOKED_AT = 8


class Progress(NamedTuple):
    """Where a tuning stands; NumPy arrays, starts first. What is saved and resumed."""

    iteration: np.ndarray  # done, ()
    scale: np.ndarray  # objective that counts as 1, ()
    place: np.ndarray  # of the next design between the bounds, 0 to 1, (B, p)
    multiplier: np.ndarray  # of the limits, (B, m)
    penalty: np.ndarray  # (B,)
    worst: np.ndarray  # violation at the last update of the multipliers, (B,)
    is_frozen: np.ndarray  # (B,)
    best_place: np.ndarray  # (B, p)
    best_objective: np.ndarray  # inf before the first, (B,)
    best_limits: np.ndarray  # values over limits - 1, (B, m)
    history: np.ndarray  # objective, violation, largest one first; nan where not run, (n, B, 2)
    adam: tuple[np.ndarray, ...]  # leaves of optax's state

    @property
    def winner(self) -> int:
        """The best start: limits kept first, then the smallest objective."""
        return int(np.lexsort((self.best_objective, _excess(self.best_limits)))[0])


def _excess(limits: np.ndarray) -> np.ndarray:
    """Largest violation beyond what counts as kept, (B,)."""
    worst = limits.max(axis=1, initial=-np.inf) if limits.shape[1] else np.zeros(len(limits))
    return np.maximum(worst - KEPT, 0.0)


def first_places(spec: TuneSpec, evaluator: Evaluator) -> np.ndarray:
    """Where the starts begin: the study itself, then Sobol points, most stable loops first.

    Args:
        spec: of the tuning.
        evaluator: of it.

    Returns:
        (B, p) between 0 and 1.
    """
    own, count = spec.free.places(), spec.tune.starts
    if count == 1:
        return own[None]
    sobol = qmc.Sobol(len(own), rng=spec.tune.seed)
    looked_at = sobol.random(1 << int(np.ceil(np.log2(LOOKED_AT * count))))
    excess = evaluator.loop_excess(spec.free.values(looked_at))
    order = np.argsort(np.maximum(excess, 0.0), kind="stable")
    return np.concatenate([own[None], looked_at[np.sort(order[: count - 1])]])


def begin(spec: TuneSpec, evaluator: Evaluator) -> Progress:
    """Before the first iteration.

    Raises:
        StudyError: nothing depends on a free number.
    """
    place = first_places(spec, evaluator)
    found = evaluator.evaluate(spec.free.values(place))
    _check_dependence(spec, found)
    objective = found.objective
    sizes = objective[np.isfinite(objective) & (objective > 0)]
    starts, m = len(place), len(evaluator.limit_names)
    return Progress(
        iteration=np.array(0),
        scale=np.array(sizes[0] if len(sizes) else 1.0),
        place=place,
        multiplier=np.zeros((starts, m)),
        penalty=np.full(starts, 10.0),
        worst=np.full(starts, np.inf),
        is_frozen=np.zeros(starts, bool),
        best_place=place.copy(),
        best_objective=np.full(starts, np.inf),
        best_limits=np.full((starts, m), np.inf),
        history=np.full((spec.tune.iterations, starts, 2), np.nan),
        adam=tuple(np.asarray(x) for x in jax.tree.leaves(_adam(spec).init(place))),
    )


def _check_dependence(spec: TuneSpec, found: Evaluation) -> None:
    is_idle = np.all(found.slope == 0, axis=0) & np.all(found.limit_slope == 0, axis=(0, 1))
    idle = [name for name, is_one in zip(spec.free.names, is_idle, strict=True) if is_one]
    if idle and np.isfinite(found.objective).any():
        raise StudyError(
            f"tune.free: neither the objective nor a limit depends on {', '.join(idle)}; "
            "leave that out"
        )


def _adam(spec: TuneSpec) -> Any:
    steps = max(spec.tune.iterations, 1)
    return optax.adam(optax.cosine_decay_schedule(FIRST_STEP, steps, LAST_STEP / FIRST_STEP))


def advance(spec: TuneSpec, evaluator: Evaluator, at: Progress) -> Progress:
    """One iteration: evaluate the designs, keep the best, move the others downhill.

    Args:
        spec: of the tuning.
        evaluator: of it.
        at: where it stands.
    """
    k = int(at.iteration)
    found = evaluator.evaluate(spec.free.values(at.place))
    violation = found.limits.max(axis=1, initial=-np.inf)
    is_fine = np.isfinite(found.objective) & np.isfinite(found.limits).all(axis=1)
    is_fine &= np.isfinite(found.slope).all(axis=1) & ~at.is_frozen
    history = at.history.copy()
    history[k] = np.where(is_fine[:, None], np.stack([found.objective, violation], axis=1), np.nan)
    is_better = is_fine & _is_better(found, at)
    at = at._replace(
        iteration=np.array(k + 1),
        is_frozen=~is_fine & ~np.isfinite(at.best_objective),
        best_place=np.where(is_better[:, None], at.place, at.best_place),
        best_objective=np.where(is_better, found.objective, at.best_objective),
        best_limits=np.where(is_better[:, None], found.limits, at.best_limits),
        history=history,
    )
    slope = _lagrangian_slope(found, at) * spec.free.slopes(at.place)
    slope = np.where(is_fine[:, None], slope, 0.0)
    adam, tree = _adam(spec), jax.tree.structure(_adam(spec).init(at.place))
    steps, state = adam.update(slope, jax.tree.unflatten(tree, at.adam))
    moved = np.clip(at.place + np.asarray(steps), 0.0, 1.0)
    at = at._replace(
        place=np.where(is_fine[:, None], moved, _halfway(at)),
        adam=tuple(np.asarray(x) for x in jax.tree.leaves(state)),
    )
    return _updated(at, found, is_fine) if (k + 1) % ROUND == 0 else at


def _halfway(at: Progress) -> np.ndarray:
    """Between where starts are and their best designs, (B, p)."""
    middle = (at.place + at.best_place) / 2
    return np.where(np.isfinite(middle), middle, at.best_place)


def _is_better(found: Evaluation, at: Progress) -> np.ndarray:
    """Whether designs beat the best so far: first by their limits, then by the objective."""
    new, old = _excess(found.limits), _excess(at.best_limits)
    return (new < old) | ((new == old) & (found.objective < at.best_objective))


def _lagrangian_slope(found: Evaluation, at: Progress) -> np.ndarray:
    """Slope of f + sum (rho/2) max(0, c + lambda/rho)^2 by the free numbers, (B, p)."""
    force = np.maximum(at.multiplier + at.penalty[:, None] * found.limits, 0.0)
    return found.slope / at.scale + np.einsum("bm,bmp->bp", force, found.limit_slope)


def _updated(at: Progress, found: Evaluation, is_fine: np.ndarray) -> Progress:
    """New multipliers; a larger penalty where the violation has not halved."""
    multiplier = np.maximum(at.multiplier + at.penalty[:, None] * found.limits, 0.0)
    worst = np.maximum(found.limits.max(axis=1, initial=0.0), 0.0)
    is_slow = is_fine & (worst > KEPT) & (worst > at.worst / 2)
    return at._replace(
        multiplier=np.where(is_fine[:, None], multiplier, at.multiplier),
        penalty=np.where(is_slow, np.minimum(2 * at.penalty, 1e6), at.penalty),
        worst=np.where(is_fine, worst, at.worst),
    )


def optimise(
    spec: TuneSpec,
    evaluator: Evaluator,
    at: Progress | None,
    keep: Callable[[Progress], None],
) -> Progress:
    """Iterate to the end.

    Args:
        spec: of the tuning.
        evaluator: for `spec.tune.starts` designs.
        at: where an interrupted one stands; None for a new one.
        keep: called after each iteration.
    """
    at = begin(spec, evaluator) if at is None else at
    while int(at.iteration) < spec.tune.iterations and not at.is_frozen.all():
        at = advance(spec, evaluator, at)
        keep(at)
    return at
