"""Check derivatives of objective and limits against central differences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from studies.result import Result
from studies.show.listing import Rows
from studies.show.report import Report
from studies.tuning.evaluate import Evaluation, Evaluator
from studies.tuning.linear_fidelity import LinearFidelity
from studies.tuning.optimise import start_families
from studies.tuning.spec import TuneSpec

#: Steps of fourth-order differences, as shares of the bounds. Rounding spoils the short step, and
#: the long one can cross a corner: an impulse of the shaper passes a sampling instant, another
#: sample or link gets the largest voltage, another motion becomes the slowest. If a corner is even
#: closer, second-order one-sided differences are right. The closest of the four counts.
STEPS = (1e-3, 1e-4)
#: Designs beside one whose derivative by a number is checked.
MOVED = 4 * len(STEPS)
#: Distance of the first design from the study, as a share of the way to another point. At the study
#: itself, every limit "own" is reached in all scenarios at once: a corner by construction.
BESIDE = 1 / 16
#: Largest allowed disagreement.
ALLOWED = 1e-4
#: Smaller derivatives than this share of the largest one count as if they had its size: what a
#: difference can resolve.
SMALLEST = 1e-3
#: And where even that is smaller, they count as if they changed a figure, which is a share of the
#: baseline's, by this much from bound to bound: derivatives near zero are judged absolutely.
NEAR_ZERO = 1e-3
#: Number of designs to check by default.
DESIGNS = 3
#: Explanation of a disagreement for the reader.
MEANING = (
    "Derivatives along the way from bound to bound. Differences are relative to the larger of the "
    f"two values, or, where both are small, to {100 * SMALLEST:g} % of the figure's largest "
    f"derivative and at least to {NEAR_ZERO:g}."
)
HEADS = ["parameter", "family", "worst for", "at", "derivative", "difference", "disagreement"]


class Disagreement(NamedTuple):
    """The worst disagreement of the derivatives by one free parameter."""

    name: str
    family: str
    place: int  # index of the design
    figure: str  # "objective", or the limit
    derivative: float  # as a share of the bounds
    difference: float
    share: float  # disagreement as a share of the larger one


@dataclass(frozen=True, eq=False)
class Audit(Result):
    """Derivatives beside finite differences."""

    checks: list[Disagreement]

    @property
    def worst(self) -> float:
        """Largest disagreement [1]."""
        return max(check.share for check in self.checks)

    @property
    def is_good(self) -> bool:
        return self.worst <= ALLOWED

    def report(self) -> Report:
        rows = [
            [
                *(x.name, x.family, x.figure, f"{x.place + 1}"),
                *(f"{x.derivative:.6g}", f"{x.difference:.6g}", f"{x.share:.1e}"),
            ]
            for x in self.checks
        ]
        beside = "below" if self.is_good else "above"
        return Report(
            title="Derivatives beside finite differences",
            result=[f"worst: {self.worst:.1e}, {beside} {ALLOWED:g}"],
            question="",
            next_steps="",
            top=[Rows(HEADS, rows), f"Design 1 is close to the baseline. {MEANING}"],
            chapters=[],
            files={},
        )


def audited(spec: TuneSpec) -> Audit:
    """The audit of a tuning at designs of `audit_places`."""
    return Audit(audit(spec))


def audit(
    spec: TuneSpec, places: np.ndarray | None = None, most: int | None = None
) -> list[Disagreement]:
    """Compare derivatives with finite differences; one entry per free parameter.

    Each number is checked in the family with the most free parameters among those that move it.

    Args:
        spec: of the tuning.
        places: designs to check, as shares of the bounds, (n, p); None: `audit_places`.
        most: designs that may be evaluated: so many numbers, drawn at random, are checked, one at
            least; None: all.
    """
    worst: dict[int, Disagreement] = {}
    places = audit_places(spec) if places is None else places
    for position, numbers in _sampled(spec, len(places), most).items():
        # as many designs as the tuning has starts, to share its program
        evaluator = Evaluator(spec, [spec.moving[position]] * len(start_families(spec)))
        slopes_by_place, exact = [], []
        for place in np.clip(places, 3 * STEPS[0], 1 - 3 * STEPS[0]):
            slopes, differences = _compare(spec, evaluator, position, numbers, place)
            slopes_by_place.append(slopes)
            exact.append(differences)
        a, b = np.array(slopes_by_place), np.array(exact)  # (places, figures, numbers)
        typical = SMALLEST * np.abs(b).max(axis=(0, 2), keepdims=True)
        size = np.maximum(np.maximum(np.abs(a), np.abs(b)), np.maximum(typical, NEAR_ZERO))
        share = np.where(np.isfinite(a - b), np.abs(a - b) / size, np.inf)
        for k, number in enumerate(numbers):
            n, m = np.unravel_index(np.argmax(share[..., k]), share.shape[:2])
            worst[number] = Disagreement(
                spec.free.names[number],
                spec.moving[position].name,
                int(n),
                ("objective", *spec.limit_names)[m],
                *(float(x[n, m, k]) for x in (a, b, share)),
            )
    return [worst[number] for number in sorted(worst)]


def _cover_numbers(spec: TuneSpec) -> dict[int, list[int]]:
    """Families by position, with the numbers to check in each, so that all are covered."""
    left = np.any([family.is_free for family in spec.moving], axis=0)
    checks: dict[int, list[int]] = {}
    while left.any():
        counts = [int((family.is_free & left).sum()) for family in spec.moving]
        best = int(np.argmax(counts))
        checks[best] = [int(k) for k in np.flatnonzero(spec.moving[best].is_free & left)]
        left = left & ~spec.moving[best].is_free
    return checks


def _sampled(spec: TuneSpec, n_places: int, most: int | None) -> dict[int, list[int]]:
    """Of `_cover_numbers`, what so many evaluations allow."""
    checks = _cover_numbers(spec)
    if most is None:
        return checks
    random, left = np.random.default_rng(spec.tune.seed), most // n_places
    drawn: dict[int, list[int]] = {}
    for position, numbers in checks.items():
        count = min(len(numbers), max((left - 1) // MOVED, 0 if drawn else 1))
        if count:
            drawn[position] = sorted(random.permutation(numbers)[:count].tolist())
            left -= 1 + MOVED * count
    return drawn


def _compare(
    spec: TuneSpec, evaluator: Evaluator, position: int, numbers: list[int], place: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(derivatives by places, differences) of all figures by some numbers, (figures, numbers)."""
    baseline, p = spec.free.places(), len(place)
    place = np.where(spec.moving[position].is_free, place, baseline)
    unit = np.eye(p)[numbers]
    moved = [k * step * unit for step in STEPS for k in (-2, -1, 1, 2)]
    evaluation = _evaluate(spec, evaluator, place + np.concatenate([np.zeros((1, p)), *moved]))
    values = np.concatenate([evaluation.objective[:, None], evaluation.limits], axis=1)
    slopes = np.concatenate([evaluation.slope[:, None], evaluation.limit_slope], axis=1)[0]
    slopes = (slopes * spec.free.slopes(place))[:, numbers]
    differences: list[np.ndarray] = []
    for step, part in zip(STEPS, np.split(values[1:], len(STEPS)), strict=True):
        a, b, c, d = part.reshape(4, len(numbers), -1)
        differences.append(((a - 8 * b + 8 * c - d) / (12 * step)).T)
    center = values[0]
    differences.append(((a - 4 * b + 3 * center) / (2 * step)).T)
    differences.append(((4 * c - d - 3 * center) / (2 * step)).T)
    nearest = np.argmin(np.abs(np.array(differences) - slopes), axis=0)
    return slopes, np.take_along_axis(np.array(differences), nearest[None], axis=0)[0]


def _evaluate(spec: TuneSpec, evaluator: Evaluator, designs: np.ndarray) -> Evaluation:
    """Designs of one family, batch by batch; derivatives only of the first one."""
    batch, parts = len(evaluator.families), []
    for first in range(0, len(designs), batch):
        rows = np.minimum(np.arange(first, first + batch), len(designs) - 1)
        evaluation = evaluator.evaluate(spec.free.values(designs[rows]), rows == 0)
        parts.append(Evaluation(*(x[: len(designs) - first] for x in evaluation)))
    return Evaluation(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def audit_places(spec: TuneSpec, count: int = DESIGNS) -> np.ndarray:
    """A design close to the study, and among points spread over the bounds the most stable ones.

    Args:
        spec: of the tuning.
        count: how many, (count, p).
    """
    baseline, family = spec.free.places(), spec.families[spec.main]
    points = scipy.stats.qmc.Sobol(len(baseline), rng=spec.tune.seed).random(16)
    way = np.where(family.is_free, points - baseline, 0.0)
    points = baseline + way / 2  # where a tuning searches
    values = np.where(family.is_free, spec.free.values(points), np.nan)
    excess, _ = LinearFidelity(spec, [family]).screen(0, values)
    order = np.argsort(np.maximum(excess, 0.0), kind="stable")
    return np.concatenate([baseline + BESIDE * way[order[:1]], points[order[: count - 1]]])
