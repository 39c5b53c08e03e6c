"""Machines that the data leave possible: drawn from the likelihood, not from its derivatives.

Each of them is within the region of `REGION` of the data: its chi square has been computed.
"""

from __future__ import annotations

import numpy as np

from studies.fitting.posterior import shape
from studies.fitting.problem import Problem
from studies.fitting.solve import Optimum, Solution
from studies.fitting.statistics import Answer, describe_fit, region_rise

#: Halvings until a drawn place, pulled towards its optimum, is within the region.
HALVINGS = 40
#: Least share of independent machines for which the normal distribution is taken as it is [1].
ALIKE = 0.5
#: Moves of every machine otherwise, with whole motions, and the largest factor of one.
MOVES, MOVES_OF_MOTIONS, FACTOR = 30, 5, 2.0
#: Rise of chi square at one standard deviation from which derivatives are wrong; they promise 1.
SURPRISING = 4.0
#: Rise of chi square that a shortened axis has at least.
LEAST = 0.25
#: Length along which derivatives are checked at most, between the bounds [1].
LONGEST = 0.5


def draw_machines(problem: Problem, solution: Solution, count: int, seed: int) -> np.ndarray:
    """Places between the bounds, (count, p), from about all optima within the region.

    Args:
        problem: what was fitted.
        solution: its optima.
        count: of places.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    limit = solution.best.cost + region_rise(len(solution.best.u)) / 2
    optima = [x for x in solution.optima if x.cost <= limit]
    weight = np.exp([optima[0].cost - x.cost for x in optima])
    share = np.cumsum(weight) / np.sum(weight)
    which = np.searchsorted(share, (np.arange(count) + 0.5) / count)
    parts = [
        _draw_about(problem, one, limit, int(np.sum(which == k)), rng)
        for k, one in enumerate(optima)
        if np.any(which == k)
    ]
    return np.concatenate(parts)


def _draw_about(
    problem: Problem, one: Optimum, limit: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Places about one optimum whose cost is at most the limit, (count, p)."""
    about = shape(correct_information(problem, describe_fit(problem, one.u), one.cost))
    walkers = max(count, 2 * len(one.u) + 2)
    place = about.draw(walkers, int(rng.integers(2**31)))
    cost = problem.costs(place)
    weight = np.where(cost <= limit, one.cost - cost - about.log_density(place), -np.inf)
    weight = np.exp(weight - weight.max()) if np.isfinite(weight).any() else np.zeros(walkers)
    share = np.sum(weight) ** 2 / max(np.sum(weight**2), 1e-300) / walkers
    for _ in range(HALVINGS):
        out = np.flatnonzero(cost > limit)
        if not out.size:
            break
        place[out] = (place[out] + one.u) / 2
        cost[out] = problem.costs(place[out])
    if share < ALIKE:
        place = move_ensemble(problem, place, cost, limit, rng)
    return place[:count]


def correct_information(problem: Problem, answer: Answer, least: float) -> Answer:
    """Its information, corrected along axes on which the cost rises by more than it promises.

    Args:
        problem: what was fitted.
        answer: statistics at an optimum.
        least: the cost there.
    """
    size, axes = np.linalg.eigh(answer.information)
    promised = 1 / np.sqrt(np.maximum(size, 1 / LONGEST**2))
    length, rise, wrong = promised.copy(), np.zeros(len(size)), np.arange(len(size))
    for _ in range(HALVINGS):
        away = length[wrong] * axes[:, wrong]
        ends = np.clip(np.concatenate([answer.place + away.T, answer.place - away.T]), 0, 1)
        rise[wrong] = 2 * np.max((problem.costs(ends) - least).reshape(2, -1), axis=0)
        wrong = wrong[rise[wrong] > SURPRISING]
        if not wrong.size:
            break
        length[wrong] *= np.clip(np.sqrt(2 / rise[wrong]), 0.02, 0.5)
    size = np.where(length < promised, np.maximum(rise, LEAST) / length**2, size)
    return answer._replace(information=(axes * size) @ axes.T)


def move_ensemble(
    problem: Problem, place: np.ndarray, cost: np.ndarray, limit: float, rng: np.random.Generator
) -> np.ndarray:
    """Places after moves that leave the posterior as it is: each along its line to another.

    Affine invariant, so that a narrow valley is no obstacle (Goodman and Weare 2010).

    Args:
        problem: what was fitted.
        place: between the bounds, (n, p).
        cost: at them, (n,).
        limit: largest cost.
        rng: of the moves.
    """
    place, cost = place.copy(), cost.copy()
    halves = np.arange(0, len(place), 2), np.arange(1, len(place), 2)
    moves = MOVES_OF_MOTIONS if problem.has_motions else MOVES
    for move, still in (halves, halves[::-1]) * moves:
        z = (1 + (FACTOR - 1) * rng.random(len(move))) ** 2 / FACTOR
        other = place[rng.choice(still, len(move))]
        trial = other + z[:, None] * (place[move] - other)
        is_inside = np.all((trial > 0) & (trial < 1), axis=1)
        at = np.full(len(move), np.inf)
        at[is_inside] = problem.costs(trial[is_inside])
        gain = (place.shape[1] - 1) * np.log(z) + cost[move] - at
        is_taken = (at <= limit) & (np.log(rng.random(len(move))) < gain)
        place[move[is_taken]], cost[move[is_taken]] = trial[is_taken], at[is_taken]
    return place
