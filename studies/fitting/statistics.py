"""What the data say about the parameters: uncertainty, correlations, and what is not identifiable.

All in the unit cube of the parameters, in which one that may be anywhere between its bounds has the
standard deviation 1/sqrt(12).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy

from studies.fitting.kinds.contract import Measurement, Residual
from studies.fitting.problem import Problem
from studies.fitting.solve import Optimum, Solution
from studies.results.labelled import Labelled, told

#: Standard deviation of a number of which only the bounds are known [1].
UNKNOWN = 1 / np.sqrt(12)
#: Numbers with at least this part in a direction are named [1].
NAMED = 0.25
#: Probability below which residuals are not noise [1].
UNLIKELY = 1e-3
#: Of a normal distribution, 95 % lie within this many standard deviations.
WIDE = 1.959964
#: Probability of the region of all parameters together in which a machine is possible [1].
REGION = 0.99


def region_rise(p: int) -> float:
    """Rise of chi square up to which a machine with p parameters is within the data's region."""
    return float(scipy.stats.chi2.ppf(REGION, p))


class Direction(NamedTuple):
    """A combination of parameters."""

    sigma: float  # standard deviation along it, between the bounds [1]; inf: no information
    parts: np.ndarray  # (p,)

    def named(self) -> list[int]:
        """Numbers with a part worth naming, the largest first."""
        size = np.abs(self.parts)
        return [int(k) for k in np.argsort(-size) if size[k] >= NAMED * size.max()]


#: Share by which uncertainties may be too small before correlated noise is told [1].
SHORT = 0.05
#: Correlation of values that count as independent [1].
INDEPENDENT = 0.1


class Misfit(Labelled):
    """How well one measurement is met."""

    name: str = told("of the measurement")
    size: int = told("residuals")
    square: float = told("their sum of squares")
    autocorrelation: float = told("of neighbours; 0 for noise, null if they have no order")
    is_noise: bool = told("whether the residuals look like the stated noise")
    is_correlated: bool = told("no larger than the stated noise, but neighbours are alike")

    @property
    def thin(self) -> int:
        """Of how many values one is to be kept, so that neighbours are nearly independent."""
        return int(np.ceil(np.log(INDEPENDENT) / np.log(self.autocorrelation)))

    @property
    def understated(self) -> float:
        """Uncertainties over those quoted, as the noise is correlated [1] (first-order process)."""
        return correlated_scale(self.square / self.size, self.autocorrelation)


class Answer(NamedTuple):
    """Values and what is known of them, at an optimum."""

    place: np.ndarray  # between the bounds [1], (p,)
    values: np.ndarray  # in the study's units, (p,)
    sigma: np.ndarray  # standard deviations, (p,); at most that of the bounds
    interval: np.ndarray  # 95 %, within the bounds, (p, 2)
    correlation: np.ndarray  # (p, p)
    covariance: np.ndarray  # between the bounds [1], (p, p)
    information: np.ndarray  # J^T J of the residuals by the places, and of profiles, (p, p)
    gradient: np.ndarray  # J^T r: slope of half chi square, 0 but for numbers at a bound, (p,)
    directions: tuple[Direction, ...]  # the widest first
    misfits: tuple[Misfit, ...]
    chi_square: float
    freedom: int  # residuals minus determined directions
    probability: float  # of a larger chi square, if the model is right

    @property
    def correlated(self) -> tuple[Misfit, ...]:
        """Measurements whose noise is correlated from one value to the next."""
        return tuple(x for x in self.misfits if x.is_correlated)

    @property
    def undetermined(self) -> tuple[Direction, ...]:
        """Directions of which the data say less than the bounds."""
        return tuple(x for x in self.directions if x.sigma > UNKNOWN)

    @property
    def is_too_close(self) -> bool:
        """Whether the data are met more closely than their noise allows."""
        if self.freedom == 0 or self.undetermined or not self.is_explained:
            return False
        return bool(scipy.stats.chi2.cdf(self.chi_square, self.freedom) < UNLIKELY)

    @property
    def is_explained(self) -> bool:
        """Whether the residuals look like the stated noise."""
        return self.probability >= UNLIKELY and all(x.is_noise for x in self.misfits)


def describe_fit(
    problem: Problem, u: np.ndarray, profiled: Mapping[int, float] | None = None
) -> Answer:
    """Statistics at an optimum.

    Args:
        problem: what was fitted.
        u: the optimum, (p,).
        profiled: standard deviations between the bounds of parameters about which profiles say
            more than derivatives, or inf for those that have no end between the bounds.
    """
    profiled = profiled or {}
    values = problem.free.values(u)
    parts = problem.parts(values, True)
    residual, jacobian = problem.stacked(parts), problem.stacked_slopes(parts, u)
    by_profiles = np.array([np.eye(len(u))[k] / x for k, x in profiled.items()]).reshape(-1, len(u))
    augmented = np.vstack([jacobian, by_profiles])
    covariance, directions = spread(augmented)
    directions = (*_unbounded(directions, profiled), *directions)
    sigma_u = np.sqrt(np.diag(covariance))
    for k, x in profiled.items():
        sigma_u[k] = min(x, UNKNOWN)
    slopes = np.abs(problem.free.slopes(u))
    low, high = (problem.free.values(np.clip(u + k * WIDE * sigma_u, 0, 1)) for k in (-1, 1))
    determined = sum(x.sigma <= UNKNOWN for x in directions)
    hidden = sum(x.n_hidden for x in problem.measurements)
    freedom = max(len(residual) - determined - hidden, 0)
    # of the residuals themselves, also where the fit softened them
    sizes = [*(x.mean_square for x in problem.measurements), 1.0]  # the last of what is known
    square = float(sum(np.sum(x.value**2) / size for x, size in zip(parts, sizes, strict=False)))
    return Answer(
        place=u,
        values=values,
        sigma=np.minimum(sigma_u, UNKNOWN) * slopes,
        interval=np.stack([low, high], axis=1),
        correlation=covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance))),
        covariance=covariance,
        information=augmented.T @ augmented,
        gradient=jacobian.T @ residual,
        directions=directions,
        misfits=tuple(
            misfit(x, part) for x, part in zip(problem.measurements, parts, strict=False)
        ),
        chi_square=square,
        freedom=freedom,
        probability=float(scipy.stats.chi2.sf(square, freedom)) if freedom else 1.0,
    )


def rivals(problem: Problem, solution: Solution, answer: Answer) -> tuple[Optimum, ...]:
    """Other optima in the data's region that the intervals of the best one leave out."""
    limit, others = region_rise(len(answer.values)), []
    low, high = answer.interval.T
    for one in solution.others:
        values = problem.free.values(one.u)
        is_elsewhere = np.any((values < low) | (values > high))
        if solution.rise(one) <= limit and is_elsewhere:
            others.append(one)
    return tuple(others)


def _unbounded(
    directions: tuple[Direction, ...], profiled: Mapping[int, float]
) -> tuple[Direction, ...]:
    """Parameters that profiles do not end, unless the derivatives say so already."""
    named = {k for x in directions if x.sigma > UNKNOWN for k in x.named()}
    size = sum(len(x.parts) for x in directions[:1])
    return tuple(
        Direction(np.inf, np.eye(size)[k])
        for k, x in profiled.items()
        if np.isinf(x) and k not in named
    )


def spread(jacobian: np.ndarray) -> tuple[np.ndarray, tuple[Direction, ...]]:
    """Covariance of the places between the bounds, and its directions, the widest first.

    The bounds count as weak knowledge, so that a direction without information has a finite
    covariance.

    Args:
        jacobian: of the normalised residuals by the places, (m, p).
    """
    p = jacobian.shape[1]
    square = np.zeros((max(len(jacobian), p), p))
    square[: len(jacobian)] = jacobian
    _, size, rows = np.linalg.svd(np.linalg.qr(square, mode="r"))
    with np.errstate(divide="ignore"):
        sigma = 1 / np.maximum(size, 1e-300)
    covariance = (rows.T / (size**2 + 1 / (10 * UNKNOWN) ** 2)) @ rows
    order = np.argsort(-sigma)
    return covariance, tuple(Direction(float(sigma[k]), _fix_sign(rows[k])) for k in order)


def _fix_sign(parts: np.ndarray) -> np.ndarray:
    return parts * np.sign(parts[np.argmax(np.abs(parts))])


def misfit(one: Measurement, part: Residual) -> Misfit:
    """How well a measurement is met."""
    r = part.value / np.sqrt(one.mean_square)
    square, n = float(np.sum(r**2)), len(r)
    autocorrelation = np.nan
    if one.is_ordered and n > 10 and square > 0:
        autocorrelation = float(np.sum(r[1:] * r[:-1]) / square)
    is_small = scipy.stats.chi2.sf(square, n) >= UNLIKELY / 10
    is_white = bool(np.isnan(autocorrelation) or abs(autocorrelation) < 4 / np.sqrt(n))
    is_correlated = False
    if not is_white and autocorrelation > 0:
        # as many independent squares as these have the same variance as n correlated ones
        m = n * (1 - autocorrelation**2) / (1 + autocorrelation**2)
        is_met = scipy.stats.chi2.sf(square * m / n, m) >= UNLIKELY / 10
        is_short = correlated_scale(square / n, autocorrelation) > 1 + SHORT
        is_correlated = bool(is_met and is_short)
        is_white = bool(is_met and not is_short)  # overstated noise makes up for it
    elif square < 0.25 * n:
        is_white = True
    return Misfit(
        name=one.name,
        size=n,
        square=square,
        autocorrelation=autocorrelation,
        is_noise=is_white and bool(is_small),
        is_correlated=is_correlated,
    )


def correlated_scale(mean_square: float, autocorrelation: float) -> float:
    """Standard deviation of a mean over that of as many independent values of variance 1.

    Args:
        mean_square: of the values [1].
        autocorrelation: correlation of neighbours [1].
    """
    return float(np.sqrt(mean_square * (1 + autocorrelation) / (1 - autocorrelation)))
