"""Multi-start: rated in one batch, the best are followed by SciPy's trust region method."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import permutations, product
from typing import Any, NamedTuple

import numpy as np
import scipy

from studies.errors import StudyError
from studies.fitting.problem import Problem
from studies.space.free import Free
from studies.study.paths import parse_entry

#: Optima closer than this in the unit cube are the same [1].
SAME = 1e-3
#: Exchanges closer than this share of the links' spread are the same [1].
ALIKE = 0.1
#: Exchanges that are followed, over the starting points that are.
EXCHANGED = 2
#: Half the rise of chi square up to which optima are followed to the end, however many.
NEAR = 20.0
#: Distance kept from the bounds by starting points [1].
INSIDE = 1e-3
#: Distance from the bounds at which optima are looked for once more [1].
AWAY = 0.02


class Optimum(NamedTuple):
    """Where one starting point led."""

    u: np.ndarray  # place between the bounds, (p,)
    cost: float  # half the sum of the loss
    is_converged: bool


class Solution(NamedTuple):
    """All optima, the best first; each is another place."""

    optima: tuple[Optimum, ...]
    rated: int  # starting points
    weighed: np.ndarray  # place at which the measurements' weights were found, (p,)

    @property
    def best(self) -> Optimum:
        """The best one."""
        return self.optima[0]

    @property
    def others(self) -> tuple[Optimum, ...]:
        """Optima elsewhere."""
        return self.optima[1:]

    def rise(self, one: Optimum) -> float:
        """Of chi square at an optimum above that at the best one."""
        return 2 * (one.cost - self.best.cost)


def solve(problem: Problem, starts: int, refine: int, iterations: int, seed: int) -> Solution:
    """Fit by multi-start.

    Links that are much alike can be exchanged for one another with hardly a change in the data, so
    that each optimum's exchanges are starting points, too.

    Args:
        problem: the residuals.
        starts: starting points; the first is the study.
        refine: how many of them are followed, and half of how many exchanges.
        iterations: evaluations of each.
        seed: of the starting points.

    Raises:
        StudyError: no starting point has residuals.
    """
    own = problem.free.places()
    sobol = scipy.stats.qmc.Sobol(len(own), seed=seed)
    drawn = sobol.random_base2(max(int(np.ceil(np.log2(max(starts - 1, 1)))), 0))[: starts - 1]
    first = np.clip(np.vstack([own[None], drawn]), INSIDE, 1 - INSIDE)
    cost = problem.costs(first)
    if not np.isfinite(cost).any():
        raise StudyError("the model fails at every starting point; see the study and the bounds")
    kept = [0] if np.isfinite(cost[0]) else []
    kept += [int(k) for k in np.argsort(cost) if np.isfinite(cost[k]) and k != 0]
    optima = descend_all(problem, first[kept[:refine]], iterations)
    if not optima:
        raise StudyError("no starting point leads to a fit: each leaves where the model works")
    optima = distinct(optima)
    images = exchanges(problem.free.numbers, [x.u for x in optima], problem.bench.study.n_links)
    order = np.argsort(problem.costs(np.array(images).reshape(-1, len(own))))
    best = [images[k] for k in order[: EXCHANGED * refine]]
    optima = distinct(optima + descend_all(problem, best, iterations))
    weighed = optima[0].u
    weigh(problem, weighed)
    # away from the bounds, along which the method may have crept
    near = [x for k, x in enumerate(optima) if k < refine or x.cost - optima[0].cost < NEAR]
    inner = [np.clip(x.u, AWAY, 1 - AWAY) for x in near]
    optima = distinct(descend_all(problem, inner, iterations) or optima)
    return Solution(tuple(optima), len(first), weighed)


def weigh(problem: Problem, u: np.ndarray) -> None:
    """Give the measurements the weights that they have at a place, (p,)."""
    for one in problem.measurements:
        one.reweigh(problem.free.values(u))


def exchanges(
    numbers: Sequence[Free], places: Sequence[np.ndarray], n_links: int
) -> list[np.ndarray]:
    """Further places, with the links' parameters permuted among the links or mirrored.

    Args:
        numbers: free ones; those of a field whose entries are all free within the same bounds
            are exchanged.
        places: optima between the bounds, each (p,).
        n_links: of the mechanism.
    """
    fields: dict[tuple[Any, ...], dict[int, int]] = {}
    for k, one in enumerate(numbers):
        entry = parse_entry(one.name)
        if entry is not None and entry.indices:
            key = entry.field, entry.indices[1:], one.span
            fields.setdefault(key, {})[entry.indices[0]] = k
    every = range(n_links)
    links = np.array([[x[i] for i in every] for x in fields.values() if set(x) == set(every)])
    images: list[np.ndarray] = []
    for u in places if len(links) else ():
        mirrored = np.clip(2 * u[links].mean(axis=1, keepdims=True) - u[links], 0, 1)
        near = max(SAME, ALIKE * float(np.ptp(u[links], axis=1).max()))
        for positions, order in product((u[links], mirrored), permutations(every)):
            changed = u.copy()
            changed[links] = positions[:, order]
            if not _is_among(changed, [*places, *images], near):
                images.append(changed)
    return images


def distinct(optima: Sequence[Optimum]) -> list[Optimum]:
    """One optimum of each place, the best first."""
    kept: list[Optimum] = []
    for one in sorted(optima, key=lambda x: x.cost):
        if not _is_among(one.u, [x.u for x in kept]):
            kept.append(one)
    return kept


def _is_among(u: np.ndarray, places: Sequence[np.ndarray], near: float = SAME) -> bool:
    return any(np.abs(u - x).max() <= near for x in places)


def descend_all(problem: Problem, first: Sequence[np.ndarray], iterations: int) -> list[Optimum]:
    """Optima that starting points lead to, without those that leave where the model works."""
    optima = []
    for u in first:
        with suppress(StudyError, np.linalg.LinAlgError, ValueError):
            optima.append(descend(problem, u, iterations))
    return optima


def descend(problem: Problem, u: np.ndarray, iterations: int) -> Optimum:
    """The optimum that a starting point leads to.

    Args:
        problem: the residuals.
        u: starting point, (p,).
        iterations: evaluations.

    Raises:
        StudyError: the model fails at the starting point.
    """
    done = follow(problem, u, np.arange(len(u)), iterations, 1e-10)
    return Optimum(done.x, done.cost, done.status > 0)


def follow(
    problem: Problem, u: np.ndarray, moving: np.ndarray, iterations: int, tolerance: float
) -> scipy.optimize.OptimizeResult:
    """Move some of the numbers to where the residuals are least.

    Steps to where the model fails are taken back.

    Args:
        problem: the residuals.
        u: starting point, (p,).
        moving: which numbers move, (k,).
        iterations: evaluations.
        tolerance: of the cost, the step and the slope.

    Returns:
        SciPy's result; its `x` are the moving numbers.

    Raises:
        StudyError: the model fails at the starting point.
    """

    def whole(x: np.ndarray) -> np.ndarray:
        changed = u.copy()
        changed[moving] = x
        return changed

    start = np.clip(u[moving], 1e-12, 1 - 1e-12)
    failed = np.full_like(problem.residual(whole(start)), np.inf)

    def residual(x: np.ndarray) -> np.ndarray:
        with suppress(StudyError, np.linalg.LinAlgError):
            return problem.residual(whole(x))
        return failed

    return scipy.optimize.least_squares(
        residual,
        start,
        lambda x: problem.jacobian(whole(x))[:, moving],
        bounds=(0.0, 1.0),
        x_scale="jac",
        max_nfev=iterations,
        xtol=tolerance,
        ftol=tolerance / 100,
        gtol=tolerance,
    )
