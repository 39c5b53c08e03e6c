"""Derivatives of objective and limits against central differences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from studies.tuning.evaluate import Evaluator
from studies.tuning.spec import TuneSpec

#: Step between the bounds, 0 to 1, of differences of fourth order.
STEP = 2e-4
#: More disagreement than this fails the audit.
ALLOWED = 1e-4
#: Smaller derivatives than this share of the largest one count as if they had its size: what a
#: difference can resolve.
SMALLEST = 1e-3


class Disagreement(NamedTuple):
    """Of the derivatives by one free number, the worst of all points."""

    name: str
    figure: str  # "objective", or the limit
    derivative: float  # as a share of the bounds
    difference: float
    share: float  # disagreement as a share of the larger one


def audit(spec: TuneSpec, places: np.ndarray) -> list[Disagreement]:
    """Compare derivatives with differences; one entry for each free number.

    Args:
        spec: of the tuning.
        places: designs to look at, between the bounds, (n, p).
    """
    p = places.shape[1]
    steps = STEP * np.concatenate([k * np.eye(p) for k in (-2, -1, 1, 2)])
    evaluator = Evaluator(spec, 1 + 4 * p)
    figures = ("objective", *evaluator.limit_names)
    worst = [Disagreement(name, "objective", 0.0, 0.0, 0.0) for name in spec.free.names]
    for place in np.clip(places, 2 * STEP, 1 - 2 * STEP):
        found = evaluator.evaluate(spec.free.values(np.concatenate([place[None], place + steps])))
        values = np.concatenate([found.objective[:, None], found.limits], axis=1)
        slopes = np.concatenate([found.slope[:, None], found.limit_slope], axis=1)[0]
        own = slopes * spec.free.slopes(place)
        a, b, c, d = values[1:].reshape(4, p, -1)
        difference = ((a - 8 * b + 8 * c - d) / (12 * STEP)).T
        least = SMALLEST * np.abs(difference).max(axis=1, keepdims=True)
        size = np.maximum(np.maximum(np.abs(own), np.abs(difference)), np.maximum(least, 1e-300))
        share = np.abs(own - difference) / size
        share = np.where(np.isfinite(share), share, np.inf)
        for k in range(p):
            m = int(np.argmax(share[:, k]))
            if share[m, k] >= worst[k].share:
                entry = spec.free.names[k], figures[m], own[m, k], difference[m, k], share[m, k]
                worst[k] = Disagreement(entry[0], entry[1], *map(float, entry[2:]))
    return worst


def audit_places(spec: TuneSpec, count: int = 3) -> np.ndarray:
    """The study itself and points spread over the bounds, those with the most stable loops."""
    own = spec.free.places()
    points = qmc.Sobol(len(own), rng=spec.tune.seed).random(16)
    excess = Evaluator(spec, 1).loop_excess(spec.free.values(points))
    order = np.argsort(np.maximum(excess, 0.0), kind="stable")
    # towards the study, so that the points lie where a tuning goes
    return np.concatenate([own[None], (own + points[order[: count - 1]]) / 2])
