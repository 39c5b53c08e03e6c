"""Many first guesses, rated in one batch; the best are followed by SciPy's trust region method."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import qmc

from studies.errors import StudyError
from studies.fitting.problem import Problem

#: Optima closer than this in the unit cube are the same [1].
SAME = 1e-3
#: Distance kept from the bounds by first guesses [1].
INSIDE = 1e-3
#: Distance from the bounds at which optima are looked for once more [1].
AWAY = 0.02


class Optimum(NamedTuple):
    """Where one first guess led."""

    u: np.ndarray  # place between the bounds, (p,)
    cost: float  # half the sum of the loss
    is_converged: bool


class Solution(NamedTuple):
    """All optima, the best first."""

    optima: tuple[Optimum, ...]
    rated: int  # first guesses

    @property
    def best(self) -> Optimum:
        """The best one."""
        return self.optima[0]

    @property
    def others(self) -> tuple[Optimum, ...]:
        """Optima elsewhere."""
        return tuple(x for x in self.optima if np.abs(x.u - self.best.u).max() > SAME)


def solve(problem: Problem, starts: int, refine: int, iterations: int, seed: int) -> Solution:
    """Fit.

    Args:
        problem: the residuals.
        starts: first guesses; the first is the study's own.
        refine: how many of them are followed.
        iterations: evaluations of each.
        seed: of the first guesses.

    Raises:
        StudyError: no first guess has residuals.
    """
    own = problem.free.places()
    sobol = qmc.Sobol(len(own), seed=seed)
    drawn = sobol.random_base2(max(int(np.ceil(np.log2(max(starts - 1, 1)))), 0))[: starts - 1]
    first = np.clip(np.vstack([own[None], drawn]), INSIDE, 1 - INSIDE)
    cost = problem.costs(first)
    if not np.isfinite(cost).any():
        raise StudyError("the model fails at every first guess; see the study and the bounds")
    kept = [0] if np.isfinite(cost[0]) else []
    kept += [int(k) for k in np.argsort(cost) if np.isfinite(cost[k]) and k != 0]
    found = []
    for k in kept[:refine]:
        with suppress(StudyError, np.linalg.LinAlgError, ValueError):  # leaves where it works
            found.append(descend(problem, first[k], iterations))
    if not found:
        raise StudyError("no first guess leads to a fit: each leaves where the model works")
    best = min(found, key=lambda x: x.cost)
    for one in problem.measurements:
        one.reweigh(problem.free.values(best.u))
    # away from the bounds, along which the method may have crept
    inner = [np.clip(x.u, AWAY, 1 - AWAY) for x in found]
    followed, found = found, []
    for u in inner:
        with suppress(StudyError, np.linalg.LinAlgError, ValueError):
            found.append(descend(problem, u, iterations))
    found = found or followed
    found.sort(key=lambda x: x.cost)
    return Solution(tuple(found), len(first))


def descend(problem: Problem, u: np.ndarray, iterations: int) -> Optimum:
    """The optimum that a first guess leads to.

    Args:
        problem: the residuals.
        u: first guess, (p,).
        iterations: evaluations.

    Raises:
        StudyError: the model fails at the first guess.
    """
    done = follow(problem, u, np.arange(len(u)), iterations, 1e-10)
    return Optimum(done.x, done.cost, done.status > 0)


def follow(
    problem: Problem, u: np.ndarray, moving: np.ndarray, iterations: int, tolerance: float
) -> OptimizeResult:
    """Move some of the numbers to where the residuals are least.

    Steps to where the model fails are taken back.

    Args:
        problem: the residuals.
        u: first guess, (p,).
        moving: which numbers move, (k,).
        iterations: evaluations.
        tolerance: of the cost, the step and the slope.

    Returns:
        SciPy's result; its `x` are the moving numbers.

    Raises:
        StudyError: the model fails at the first guess.
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

    return least_squares(
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
