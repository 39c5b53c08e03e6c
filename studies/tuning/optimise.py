"""Descent of many starts of many families at once, limits by an augmented Lagrangian.

A start whose trial does not finish tries a shorter step; one that has never finished is frozen.
Neither affects the others. On a front, families pass good designs on to their neighbours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy

from studies.errors import StudyError
from studies.tuning.descent import Adam, Descent, Lbfgs, Trial
from studies.tuning.evaluate import Evaluation, Evaluator
from studies.tuning.spec import BASELINE, Family, TuneSpec

#: Iterations between updates of the multipliers.
ROUND = 5
#: A limit counts as kept if exceeded by at most this share.
KEPT = 1e-3
#: Sobol points screened for each start, by the linearised loop alone.
SCREENED = 8
#: A tuning ends when no start has improved on its best by this share within this many iterations.
GAIN, PATIENCE = 1e-3, 12
#: Initial penalty of the limits; the objective counts as 1.
PENALTY = 10.0


class Progress(NamedTuple):
    """Progress of a tuning, saved and resumed; NumPy arrays, starts first."""

    iteration: np.ndarray  # done, ()
    family: np.ndarray  # of each start, position in `spec.moving`, (B,)
    place: np.ndarray  # of the next trial between the bounds, 0 to 1, (B, p)
    base: np.ndarray  # last accepted one, (B, p)
    base_objective: np.ndarray  # nan before the first, (B,)
    base_slope: np.ndarray  # (B, p), by places
    base_limits: np.ndarray  # (B, m)
    base_limit_slope: np.ndarray  # (B, m, p), by places
    multiplier: np.ndarray  # of the limits, (B, m)
    penalty: np.ndarray  # (B,)
    worst: np.ndarray  # violation at the last update of the multipliers, (B,)
    is_frozen: np.ndarray  # (B,)
    best_place: np.ndarray  # (B, p)
    best_objective: np.ndarray  # inf before the first, (B,)
    best_limits: np.ndarray  # values over limits - 1, (B, m)
    best_peaks: np.ndarray  # values of the limited metrics, (B, m)
    least: np.ndarray  # smallest value of each limit among all designs of a family, (F, m)
    gained: np.ndarray  # iteration at which a start of each family last improved, (F,)
    history: np.ndarray  # objective, violation, largest one first; nan where not run, (n, B, 2)
    descent: tuple[np.ndarray, ...]  # state of the method

    def winner(self, family: int) -> int:
        """The best start of a family: limits kept first, then the smallest objective."""
        members = np.flatnonzero(self.family == family)
        order = np.lexsort((self.best_objective[members], excess(self.best_limits[members])))
        return int(members[order[0]])

    def beyond(self, start: int) -> float:
        """How far a start's best design exceeds its limits, beyond what counts as kept."""
        return float(excess(self.best_limits[[start]])[0])

    def alike(self, family: int, share: float) -> np.ndarray:
        """Starts of a family that end within a share of its best one's objective."""
        best = self.winner(family)
        is_near = self.best_objective <= (1 + share) * self.best_objective[best]
        is_kept = excess(self.best_limits) <= self.beyond(best)
        return np.flatnonzero((self.family == family) & is_near & is_kept)

    def least_so_far(self) -> np.ndarray:
        """Objective of each start's best trial that keeps the limits, by iterations, (n, B)."""
        done = self.history[: int(self.iteration)]
        return np.fmin.accumulate(np.where(done[..., 1] <= KEPT, done[..., 0], np.nan))


def excess(limits: np.ndarray) -> np.ndarray:
    """Largest violation beyond what counts as kept, (B,)."""
    worst = limits.max(axis=1, initial=-np.inf) if limits.shape[1] else np.zeros(len(limits))
    return np.maximum(worst - KEPT, 0.0)


def start_families(spec: TuneSpec) -> np.ndarray:
    """Family of every start, (B,)."""
    return np.repeat(np.arange(len(spec.moving)), spec.tune.starts)


def first_places(spec: TuneSpec, evaluator: Evaluator) -> np.ndarray:
    """Initial designs: in each family the baseline, then Sobol points.

    Points whose linearised loop keeps the limits come first, in order of the linear machine's
    residual vibration.

    Returns:
        (B, p) between 0 and 1.
    """
    baseline, count = spec.free.places(), spec.tune.starts
    places = []
    for k, family in enumerate(spec.moving):
        places.append(baseline[None])
        if count == 1:
            continue
        sobol = scipy.stats.qmc.Sobol(len(baseline), rng=spec.tune.seed)
        points = sobol.random(1 << int(np.ceil(np.log2(SCREENED * count))))
        points = np.where(family.is_free, points, baseline)
        values = np.where(family.is_free, spec.free.values(points), np.nan)
        beyond, residual = evaluator.linear.screen(k * count, values)
        order = np.lexsort((residual, np.maximum(beyond, 0.0)))
        places.append(points[np.sort(order[: count - 1])])
    return np.concatenate(places)


def begin(spec: TuneSpec, evaluator: Evaluator) -> Progress:
    """State before the first iteration."""
    return _fresh_progress(spec, first_places(spec, evaluator))


def _fresh_progress(spec: TuneSpec, place: np.ndarray) -> Progress:
    """Unevaluated starts at places between the bounds (B, p)."""
    starts, p = place.shape
    m = len(spec.limit_names)
    return Progress(
        iteration=np.array(0),
        family=start_families(spec),
        place=place,
        base=place.copy(),
        base_objective=np.full(starts, np.nan),
        base_slope=np.zeros((starts, p)),
        base_limits=np.zeros((starts, m)),
        base_limit_slope=np.zeros((starts, m, p)),
        multiplier=np.zeros((starts, m)),
        penalty=np.full(starts, PENALTY),
        worst=np.full(starts, np.inf),
        is_frozen=np.zeros(starts, bool),
        best_place=place.copy(),
        best_objective=np.full(starts, np.inf),
        best_limits=np.full((starts, m), np.inf),
        best_peaks=np.full((starts, m), np.nan),
        least=np.full((len(spec.moving), m), np.inf),
        gained=np.zeros(len(spec.moving), int),
        history=np.full((spec.tune.iterations, starts, 2), np.nan),
        descent=method(spec).begin(place),
    )


def method(spec: TuneSpec) -> Descent:
    """The requested descent method."""
    return Adam(spec.tune.iterations) if spec.tune.method == "adam" else Lbfgs()


def advance(spec: TuneSpec, evaluator: Evaluator, at: Progress) -> Progress:
    """One iteration: evaluate the trials, keep the best, step downhill.

    Args:
        spec: of the tuning.
        evaluator: of it.
        at: current progress.

    Raises:
        StudyError: in the first iteration, a free parameter without any effect.
    """
    k = int(at.iteration)
    evaluation = evaluator.evaluate(spec.free.values(at.place))
    if k == 0:
        _check_dependence(spec, at, evaluation)
    is_fine = np.isfinite(evaluation.objective) & np.isfinite(evaluation.limits).all(axis=1)
    is_fine &= np.isfinite(evaluation.slope).all(axis=1) & np.isfinite(evaluation.limit_slope).all(
        (1, 2)
    )
    is_fine &= np.isfinite(at.place).all(axis=1) & ~at.is_frozen
    at = _record(at, evaluation, is_fine)
    chain = spec.free.slopes(at.place)  # from values to places
    slope, limit_slope = evaluation.slope * chain, evaluation.limit_slope * chain[:, None]
    merit, merit_slope = _lagrangian(
        at, evaluation.objective, slope, evaluation.limits, limit_slope
    )
    base_merit, base_slope = _lagrangian(
        at, at.base_objective, at.base_slope, at.base_limits, at.base_limit_slope
    )
    trial = Trial(
        base=at.base,
        place=at.place,
        base_merit=np.where(np.isfinite(base_merit), base_merit, np.inf),
        merit=np.where(is_fine, merit, np.nan),
        base_slope=base_slope,
        slope=np.where(is_fine[:, None], merit_slope, 0.0),
    )
    state, is_taken, place = method(spec).step(at.descent, trial)

    def select(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return np.where(is_taken.reshape((-1,) + (1,) * (new.ndim - 1)), new, old)

    free = evaluator.is_free
    at = at._replace(
        iteration=np.array(k + 1),
        base=select(at.place, at.base),
        base_objective=select(evaluation.objective, at.base_objective),
        base_slope=select(slope, at.base_slope),
        base_limits=select(evaluation.limits, at.base_limits),
        base_limit_slope=select(limit_slope, at.base_limit_slope),
        place=np.where(free & ~at.is_frozen[:, None], place, at.place),
        descent=state,
    )
    return _hand_on(spec, _update_multipliers(at)) if (k + 1) % ROUND == 0 else at


def _check_dependence(spec: TuneSpec, at: Progress, evaluation: Evaluation) -> None:
    for position, family in enumerate(spec.moving):
        members = (at.family == position) & np.isfinite(evaluation.objective)
        is_idle = np.all(evaluation.slope[members] == 0, axis=0) & family.is_free
        is_idle &= np.all(evaluation.limit_slope[members] == 0, axis=(0, 1))
        idle = [name for name, is_one in zip(spec.free.names, is_idle, strict=True) if is_one]
        if idle and members.any():
            raise StudyError(
                f"tune.free: in family {family.name!r} neither the objective nor a limit depends "
                f"on {', '.join(idle)}; leave that out"
            )


def _record(at: Progress, evaluation: Evaluation, is_fine: np.ndarray) -> Progress:
    """Progress with this iteration's findings recorded."""
    k = int(at.iteration)
    violation = evaluation.limits.max(axis=1, initial=-np.inf)
    history = at.history.copy()
    history[k] = np.where(
        is_fine[:, None], np.stack([evaluation.objective, violation], axis=1), np.nan
    )
    new, old = excess(evaluation.limits), excess(at.best_limits)
    is_better = (new < old) | ((new == old) & (evaluation.objective < at.best_objective))
    is_better &= is_fine
    with np.errstate(invalid="ignore"):
        step = (new < old) | (evaluation.objective < (1 - GAIN) * at.best_objective)
    gained = at.gained.copy()
    gained[np.unique(at.family[is_better & step])] = k
    chosen, least = is_better[:, None], at.least.copy()
    np.minimum.at(least, at.family[is_fine], evaluation.limits[is_fine])
    return at._replace(
        is_frozen=at.is_frozen | (~is_fine & ~np.isfinite(at.best_objective)),
        best_place=np.where(chosen, at.place, at.best_place),
        best_objective=np.where(is_better, evaluation.objective, at.best_objective),
        best_limits=np.where(chosen, evaluation.limits, at.best_limits),
        best_peaks=np.where(chosen, evaluation.peaks, at.best_peaks),
        least=least,
        gained=gained,
        history=history,
    )


def _lagrangian(
    at: Progress,
    objective: np.ndarray,
    slope: np.ndarray,
    limits: np.ndarray,
    limit_slope: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """f + sum (rho/2) max(0, c + lambda/rho)^2 and its slope, (B,) and (B, p)."""
    force = np.maximum(at.multiplier + at.penalty[:, None] * limits, 0.0)
    merit = objective + np.sum(force**2, axis=1) / (2 * at.penalty)
    return merit, slope + np.einsum("bm,bmp->bp", force, limit_slope)


def _update_multipliers(at: Progress) -> Progress:
    """New multipliers; a larger penalty if the violation has not halved."""
    is_known = np.isfinite(at.base_objective)
    multiplier = np.maximum(at.multiplier + at.penalty[:, None] * at.base_limits, 0.0)
    worst = np.maximum(at.base_limits.max(axis=1, initial=0.0), 0.0)
    is_slow = is_known & (worst > KEPT) & (worst > at.worst / 2)
    return at._replace(
        multiplier=np.where(is_known[:, None], multiplier, at.multiplier),
        penalty=np.where(is_slow, np.minimum(2 * at.penalty, 1e6), at.penalty),
        worst=np.where(is_known, worst, at.worst),
    )


def _hand_on(spec: TuneSpec, at: Progress) -> Progress:
    """Move the worst start of a family to another family's better design, and continue there.

    Eligible families move no additional numbers of the same study; their limit on a front can
    differ.
    """
    for k, family in enumerate(spec.moving):
        members = np.flatnonzero(at.family == k)
        donors = [
            at.winner(j) for j, other in enumerate(spec.moving) if _can_take(spec, family, other)
        ]
        if not donors or len(members) < 2:
            continue
        own = at.winner(k)
        limits = {j: _limits_in(spec, at, j, family) for j in donors}
        kept = [
            j for j in donors if np.isfinite(limits[j]).all() and not excess(limits[j][None])[0]
        ]
        best = min(kept, key=lambda j: at.best_objective[j], default=own)
        is_kept = at.beyond(own) == 0
        if best != own and (at.best_objective[best] < at.best_objective[own] or not is_kept):
            worst = max(members, key=lambda j: at.best_objective[j])
            at = _move(spec, at, int(worst), best, limits[best])
    return at


def _can_take(spec: TuneSpec, family: Family, other: Family) -> bool:
    """Whether another family's designs are valid in this one, except for the limit on a front."""
    is_part = bool((family.is_free | ~other.is_free).all())
    is_same_study = repr(family.columns) == repr(other.columns)
    differing = {name for name, x in family.limits.items() if other.limits[name] != x}
    is_known = all(
        name == spec.front_limit and family.limits[name] != BASELINE for name in differing
    )
    return other is not family and is_same_study and is_part and is_known


def _limits_in(spec: TuneSpec, at: Progress, start: int, family: Family) -> np.ndarray:
    """Violation of another family's limits by a start's best design, (m,)."""
    limits, along = at.best_limits[start].copy(), spec.front_limit
    if along in spec.limit_names and family.limits[along] != BASELINE:
        k = spec.limit_names.index(along)
        limits[k] = at.best_peaks[start, k] / float(family.limits[along]) - 1
    return limits


def _move(spec: TuneSpec, at: Progress, start: int, to: int, limits: np.ndarray) -> Progress:
    """Progress with a start moved to another's best place, with its limits in the new family."""
    place, base = at.place.copy(), at.base_objective.copy()
    place[start], base[start] = at.best_place[to], np.nan
    best = {
        name: getattr(at, name).copy() for name in ("best_place", "best_objective", "best_peaks")
    }
    for array in best.values():
        array[start] = array[to]
    best_limits = at.best_limits.copy()
    best_limits[start] = limits
    fresh = method(spec).begin(at.place)
    state = tuple(np.array(x) for x in at.descent)
    for now, new in zip(state, fresh, strict=True):
        if now.ndim and now.shape[0] == len(place):
            now[start] = new[start]
    return at._replace(
        place=place, base_objective=base, descent=state, best_limits=best_limits, **best
    )


def optimise(
    spec: TuneSpec,
    evaluator: Evaluator,
    at: Progress | None,
    keep: Callable[[Progress], None],
) -> Progress:
    """Iterate to the end, or until nothing improves any more.

    Args:
        spec: of the tuning.
        evaluator: for the families of `start_families`.
        at: progress of an interrupted tuning; None for a new one.
        keep: called after each iteration.
    """
    at = begin(spec, evaluator) if at is None else _resize(at, spec.tune.iterations)
    while not has_ended(spec, at):
        at = advance(spec, evaluator, at)
        keep(at)
    return _hand_on(spec, at)


def is_compatible(spec: TuneSpec, at: Progress) -> bool:
    """Whether saved progress has the arrays of this tuning; iterations can differ."""

    def forms(progress: Progress) -> list[Any]:
        *arrays, history, descent = progress
        kinds = [np.asarray(x).dtype.kind for x in (history, *arrays, *descent)]
        return [*kinds, np.shape(history)[1:], *map(np.shape, (*arrays, *descent))]

    expected = _fresh_progress(spec, np.zeros((len(start_families(spec)), len(spec.free.names))))
    return (
        forms(at) == forms(expected)
        and np.array_equal(at.family, expected.family)
        and 0 <= int(at.iteration) <= len(at.history)
    )


def _resize(at: Progress, iterations: int) -> Progress:
    """Progress adapted to a different number of iterations."""
    history = np.full((max(iterations, int(at.iteration)), *at.history.shape[1:]), np.nan)
    history[: int(at.iteration)] = at.history[: int(at.iteration)]
    return at._replace(history=history)


def has_ended(spec: TuneSpec, at: Progress) -> bool:
    """Whether all iterations are done, or further ones are useless; Adam needs all of them."""
    has_waited = spec.tune.method == "lbfgs" and (at.iteration - at.gained > PATIENCE).all()
    return bool(at.iteration >= spec.tune.iterations or at.is_frozen.all() or has_waited)
