"""Profile likelihoods: how much worse the fit becomes as one number is held elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from studies.errors import StudyError
from studies.fitting.problem import Problem
from studies.fitting.solve import follow
from studies.fitting.statistics import WIDE

#: Profiles go on by this many standard deviations, at most so many times, until so large a rise.
STRIDE, STEPS, ENOUGH = 0.7, 14, 6.0
#: Places closer than this are one [1].
NEXT = 1e-9


class Likelihood(NamedTuple):
    """Least misfit for fixed values of one free number."""

    number: int
    values: np.ndarray  # ascending, (n,)
    rise: np.ndarray  # of chi square above its least, (n,)

    def smooth(self) -> tuple[np.ndarray, np.ndarray]:
        """Values and rises between those that were tried, for figures."""
        if len(self.values) < 3:
            return self.values, self.rise
        way = np.sign(self.values - self.values[int(np.argmin(self.rise))])
        signed = way * np.sqrt(np.maximum(self.rise, 0.0))  # a straight line for a parabola
        x = np.linspace(self.values[0], self.values[-1], 201)
        return x, PchipInterpolator(self.values, signed)(x) ** 2

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


def profile(problem: Problem, u: np.ndarray, number: int, sigma: float) -> Likelihood:
    """Profile the likelihood of one free number, to 95 % or the bounds.

    Args:
        problem: what was fitted.
        u: the optimum, (p,).
        number: which free number.
        sigma: its standard deviation between the bounds [1].
    """
    others = np.delete(np.arange(len(u)), number)
    least = float(np.sum(problem.residual(u) ** 2))
    found = [(float(u[number]), 0.0)]
    for way in (1, -1):
        at = u.copy()
        for k in range(1, STEPS + 1):
            at = at.copy()
            at[number] = np.clip(u[number] + way * k * STRIDE * sigma, 0.0, 1.0)
            if min(abs(at[number] - x) for x, _ in found) < NEXT:  # at the bound already
                break
            try:
                if len(others):
                    at[others] = follow(problem, at, others, 15, 1e-6).x
                rise = float(np.sum(problem.residual(at) ** 2)) - least
            except (StudyError, np.linalg.LinAlgError, ValueError):
                break  # out of where the model works
            found.append((float(at[number]), rise))
            if rise > ENOUGH or not 0 < at[number] < 1:
                break
    # bounds may be closer than the values' digits tell apart
    by_value = {
        float(problem.free.values(_with(u, number, x))[number]): rise
        for x, rise in sorted(found, key=lambda one: -abs(one[1]))
    }
    values = np.array(sorted(by_value))
    return Likelihood(number, values, np.array([by_value[x] for x in values]))


def _with(u: np.ndarray, number: int, x: float) -> np.ndarray:
    changed = u.copy()
    changed[number] = x
    return changed
