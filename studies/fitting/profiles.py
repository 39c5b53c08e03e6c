"""Profile likelihoods: how much worse the fit becomes as one parameter is held elsewhere.

They also confirm what is identifiable: where two frequencies coincide, chi square has a kink, and
its derivatives say nothing about what splits them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from studies.errors import StudyError
from studies.fitting.problem import Problem
from studies.fitting.solve import follow
from studies.fitting.statistics import UNKNOWN, WIDE, Answer, describe_fit

#: Profiles go on by this many standard deviations, at most so many times, until so large a rise.
STRIDE, STEPS, ENOUGH = 0.7, 30, 6.0
#: A step that rises by more is taken back and shortened.
FAR = 2 * ENOUGH
#: Profiles correct derivatives that promise this many times the standard deviation, or more [1].
WRONG = 1.5
#: Places closer than this are one [1].
NEXT = 1e-9


class Likelihood(NamedTuple):
    """Least misfit for fixed values of one parameter."""

    number: int
    values: np.ndarray  # ascending, (n,)
    rise: np.ndarray  # of chi square above its least, (n,)

    @property
    def ends(self) -> int:
        """Sides on which the data end it, 0 to 2."""
        return int(self.rise[0] >= WIDE**2) + int(self.rise[-1] >= WIDE**2)

    def smooth(self) -> tuple[np.ndarray, np.ndarray]:
        """Values and rises between those that were tried, for figures."""
        if len(self.values) < 3:
            return self.values, self.rise
        way = np.sign(self.values - self.values[int(np.argmin(self.rise))])
        signed = way * np.sqrt(np.maximum(self.rise, 0.0))  # a straight line for a parabola
        x = np.linspace(self.values[0], self.values[-1], 201)
        return x, scipy.interpolate.PchipInterpolator(self.values, signed)(x) ** 2

    def interval(self) -> tuple[float, float]:
        """Where the rise is that of 95 %, or the last values that were tried."""
        middle, ends = int(np.flatnonzero(self.rise == 0.0)[0]), []
        for part in (slice(middle, None, -1), slice(middle, None)):
            value, size = self.values[part], np.sqrt(np.maximum(self.rise[part], 0.0))
            beyond = np.flatnonzero(size > WIDE)
            if not beyond.size:
                ends.append(float(value[-1]))
                continue
            k = int(beyond[0])
            ends.append(float(np.interp(WIDE, size[k - 1 : k + 1], value[k - 1 : k + 1])))
        return ends[0], ends[1]


def describe_confirmed(
    problem: Problem, u: np.ndarray, has_all: bool
) -> tuple[Answer, tuple[Likelihood, ...]]:
    """Statistics at an optimum that agree with profiles on what is identifiable.

    Args:
        problem: what was fitted.
        u: the optimum, (p,).
        has_all: profile all parameters; otherwise those of directions without information.
    """
    answer = describe_fit(problem, u)
    replaced: dict[int, float] = {}
    profiles: dict[int, Likelihood] = {}
    for _ in range(len(u)):
        sigma = np.sqrt(np.diag(answer.covariance))
        named = {k for x in answer.undetermined for k in x.named()}
        for k in (set(range(len(u))) if has_all else named) - profiles.keys():
            profiles[k] = profile(problem, u, k, float(sigma[k]))
        sigmas = {k: _implied_sigma(x, problem, u) for k, x in profiles.items()}
        confirmed = {
            k
            for x in answer.undetermined
            if any(sigmas[i] > UNKNOWN for i in x.named())
            for k in x.named()
        }
        corrected = {
            k: x
            for k, x in sigmas.items()
            if k not in confirmed and k not in replaced and (np.isinf(x) or x * WRONG < sigma[k])
        }
        if not corrected:
            break
        replaced |= corrected
        answer = describe_fit(problem, u, replaced)
    interval = answer.interval.copy()
    for k, one in profiles.items():
        if len(one.values) > 2:
            interval[k] = one.interval()
    return answer._replace(interval=interval), tuple(profiles[k] for k in sorted(profiles))


def _implied_sigma(one: Likelihood, problem: Problem, u: np.ndarray) -> float:
    """Standard deviation between the bounds that a profile says [1]; inf if it has no end."""
    if not one.ends:
        return np.inf
    low, high = one.interval()
    return (high - low) / (one.ends * WIDE * abs(float(problem.free.slopes(u)[one.number])))


def profile(problem: Problem, u: np.ndarray, number: int, sigma: float) -> Likelihood:
    """Profile the likelihood of one parameter, to 95 % or the bounds.

    Args:
        problem: what was fitted.
        u: the optimum, (p,).
        number: which parameter.
        sigma: its standard deviation between the bounds [1], the scale of the first step.
    """
    others = np.delete(np.arange(len(u)), number)
    least = float(np.sum(problem.residual(u) ** 2))
    points = [(float(u[number]), 0.0)]
    for way in (1, -1):
        at, stride, last = u, way * STRIDE * sigma, 0.0
        for _ in range(STEPS):
            trial = _replace_entry(at, number, float(np.clip(at[number] + stride, 0.0, 1.0)))
            if abs(trial[number] - at[number]) < NEXT:  # at the bound already
                break
            try:
                if len(others):
                    trial[others] = follow(problem, trial, others, 15, 1e-6).x
                rise = float(np.sum(problem.residual(trial) ** 2)) - least
            except (StudyError, np.linalg.LinAlgError, ValueError):
                break  # out of where the model works
            if rise > FAR:
                stride = (trial[number] - at[number]) * np.clip(np.sqrt(2 / rise), 0.02, 0.5)
                continue
            if np.sqrt(max(rise, 0.0)) - last < STRIDE / 2:
                stride *= 2
            at, last = trial, np.sqrt(max(rise, 0.0))
            points.append((float(at[number]), rise))
            if rise > ENOUGH or not 0 < at[number] < 1:
                break
    # bounds may be closer than the values' digits tell apart
    by_value = {
        float(problem.free.values(_replace_entry(u, number, x))[number]): rise
        for x, rise in sorted(points, key=lambda one: -abs(one[1]))
    }
    values = np.array(sorted(by_value))
    return Likelihood(number, values, np.array([by_value[x] for x in values]))


def _replace_entry(u: np.ndarray, number: int, x: float) -> np.ndarray:
    changed = u.copy()
    changed[number] = x
    return changed
