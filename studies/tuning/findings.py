"""What a tuning found: its designs, which one to recommend, which limits none of them keeps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from studies.result import Result
from studies.tuning.audit import Disagreement
from studies.tuning.check import JudgedDesign, RandomSearch
from studies.tuning.optimise import KEPT, Progress, excess
from studies.tuning.references import References
from studies.tuning.spec import LOOP_LIMITS, Family, TuneSpec

NO_REFERENCES = References(None, None, None, None)


@dataclass(frozen=True, eq=False)
class TuneFindings(Result):
    """Everything that a tuning found."""

    FILES = "; tuned studies in the same folder"

    spec: TuneSpec
    at: Progress
    baseline: JudgedDesign  # the baseline
    judged: list[JudgedDesign]  # the best design of every family, in the order of `spec.families`
    audited: list[Disagreement]  # at the best design of the family with most parameters
    linear: np.ndarray  # linear residual vibration of each start's best design [m], (B,)
    residual: np.ndarray  # of its own run on the first scenario [m], (B,); nan if not judged by it
    searched: RandomSearch | None
    run_time: float  # of a differentiated run [s]
    runs: int  # how many there were
    references: References = NO_REFERENCES  # what designs have to beat


def best_family(spec: TuneSpec, findings: TuneFindings) -> int:
    """Index of the family to recommend: limits kept first, then the least objective."""

    def rank(k: int) -> tuple[bool, bool, float]:
        is_moving = k < len(spec.moving)
        beyond = findings.at.beyond(findings.at.winner(k)) if is_moving else 0.0
        value = findings.judged[k].objective.mean()
        return beyond > 0, not np.isfinite(value), value

    return min(range(len(spec.moving)), key=rank)


def is_kept(spec: TuneSpec, search: RandomSearch) -> np.ndarray:
    """Which random designs finish and keep all limits, (n,)."""
    loop = search.beyond_loop if spec.loop_limits else np.full(len(search.objective), -np.inf)
    return np.isfinite(search.objective) & (excess(search.limits) == 0) & (loop <= KEPT)


def violated_limits(spec: TuneSpec, at: Progress) -> list[str]:
    """Limits that no start of a family keeps, one line per family; empty if all are kept."""
    lines = []
    for k, family in enumerate(spec.moving):
        if at.beyond(at.winner(k)) == 0:
            continue
        lines.append(f"{family.name}: {_contradiction(spec, family, at.least[k])}")
    return lines


def _contradiction(spec: TuneSpec, family: Family, values: np.ndarray) -> str:
    least = dict(zip(spec.limit_names, values, strict=True))
    never = [name for name, value in least.items() if value > KEPT]
    if never:
        return ", ".join(
            f"{name} = {family.limits[name]} is satisfied by no design"
            + ("" if name in LOOP_LIMITS else f" (nearest {100 * least[name]:+.1f} %)")
            for name in never
        )
    return " and ".join(f"{name} = {family.limits[name]}" for name in spec.limit_names) + (
        " are satisfied by some design each, but by none together"
    )
