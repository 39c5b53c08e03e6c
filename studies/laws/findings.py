"""What a comparison found: figures of each controller, who is best, and whether that is certain."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from studies.engine.controller import fixed_controller
from studies.engine.preflight import check_run
from studies.engine.stability import LoopFigures, loop_report
from studies.export.cost import products_of
from studies.laws.judging import FIGURES, Judged
from studies.laws.ranking import Ranking, rank
from studies.laws.tuning import Budget, Tuned
from studies.study.spec import Study

GIVEN, WITHOUT = "the design as given", "without control"


class Controller(NamedTuple):
    """One controller of the comparison."""

    name: str
    study: Study
    reason: str  # why it is out of the competition, "" if it is not
    n_free: int  # numbers it was tuned by
    loop: LoopFigures | None  # of its own machine; None without control
    products: int | None  # multiplications a sample; None without control


class LawFindings(NamedTuple):
    """Everything that a comparison found."""

    study: Study  # the design
    budget: Budget
    controllers: list[Controller]  # those that ran, in the order of `judged`
    failed: list[Tuned]  # those of which no design came
    judged: Judged
    rankings: dict[str, Ranking]  # by metric of FIGURES, of the controllers in the competition

    @property
    def competing(self) -> list[int]:
        """Controllers that keep the budget."""
        return [k for k, one in enumerate(self.controllers) if not one.reason]

    @property
    def ranking(self) -> Ranking:
        """By the figure that decides."""
        return next(iter(self.rankings.values()))

    def name(self, place: int) -> str:
        """Name of a controller of the competition."""
        return self.controllers[self.competing[place]].name


def find(
    study: Study, budget: Budget, tuned: list[Tuned], judged: Judged, figures: list[Controller]
) -> LawFindings:
    """Rank what was judged.

    Args:
        study: the design.
        budget: of every candidate.
        tuned: all candidates.
        judged: of the controllers, in their order.
        figures: the controllers.
    """
    findings = LawFindings(
        study, budget, figures, [x for x in tuned if x.study is None], judged, {}
    )
    rows = findings.competing
    rankings = {
        name: rank(_complete(judged, judged.metrics[name])[rows], budget.seed) for name in FIGURES
    }
    return findings._replace(rankings=rankings)


def _complete(judged: Judged, figure: np.ndarray) -> np.ndarray:
    """A figure, NaN where a run did not finish."""
    return np.where(np.isin(judged.status, status.FINISHED), figure, np.nan)


def examine(name: str, study: Study, tuned: Tuned | None = None) -> Controller:
    """A controller's loop on its own machine, and what a sample of it costs.

    Args:
        name: in tables.
        study: with this controller.
        tuned: how it came about; None: it was given.
    """
    reason = tuned.reason if tuned is not None else "not tuned"
    count = tuned.n_free if tuned is not None else 0
    if not study.is_controlled:
        return Controller(name, study, reason, count, None, None)
    structure, case = check_run(study)
    pose = np.array(study.motion.waypoints[0], float)
    loop = loop_report(structure, case, pose, structure.n_controlled)
    products = products_of(fixed_controller(study).channels)
    return Controller(name, study, reason, count, loop, products)


def verdict(findings: LawFindings) -> list[str]:
    """Which controller to take, and how certain that is, in sentences."""
    ranking = findings.ranking
    if ranking.best < 0:
        return ["No controller keeps the budget and finishes all runs."]
    best = findings.name(ranking.best)
    share = 100 * ranking.share[ranking.best]
    tied = [
        findings.name(k)
        for k in ranking.order
        if k != ranking.best and np.isfinite(ranking.ratio[k]) and ranking.is_tied[k]
    ]
    lines = [
        f"{best} leaves the least residual vibration; other machines of the same spread would "
        f"put it first with {share:.0f} % certainty."
    ]
    if tied:
        lines.append(f"Not to be told from it on these machines: {', '.join(tied)}.")
    others = [_other(findings, name) for name in list(FIGURES)[1:]]
    return [*lines, *filter(None, others)]


def _other(findings: LawFindings, metric: str) -> str:
    """Whether the verdict survives another figure."""
    ranking = findings.rankings[metric]
    if ranking.best < 0:
        return ""
    chosen, words = findings.ranking.best, FIGURES[metric]
    if ranking.best == chosen or ranking.is_tied[chosen]:
        return f"By {words} the verdict stands."
    return (
        f"By {words} it does not: {findings.name(ranking.best)} is better there, "
        f"{findings.name(chosen)} has {ranking.ratio[chosen]:.2f} times as much "
        f"({ranking.low[chosen]:.2f} to {ranking.high[chosen]:.2f})."
    )
