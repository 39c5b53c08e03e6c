"""What a comparison found: figures of each controller, who is best, and whether that is certain."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.laws import LAWS
from studies.engine.controller import fixed_controller
from studies.engine.preflight import check_run
from studies.engine.stability import LoopFigures, loop_report
from studies.errors import StudyError
from studies.export.cost import products_of
from studies.laws.candidates import AS_GIVEN
from studies.laws.judging import FIGURES, Judged, changes
from studies.laws.ranking import RESAMPLES, Ranking, rank
from studies.laws.tuning import Budget, Tuned
from studies.publish import shown
from studies.study.paths import set_values
from studies.study.spec import Study, parse_study

GIVEN, WITHOUT = "the design as given", "without control"


class Combination(NamedTuple):
    """A controller to compare."""

    name: str  # in tables
    law: str  # name of its candidate, "" for what was given
    drive: str  # the same
    study: Study
    reason: str  # why it is out of the competition, "" if it is not
    n_free: int  # numbers it was tuned by


class ExaminedController(NamedTuple):
    """One controller of the comparison."""

    entry: Combination
    reason: str  # why it is out of the competition, "" if it is not
    loop: LoopFigures | None  # of its own machine; None without control
    products: int | None  # multiplications a sample; None without control


class LawFindings(NamedTuple):
    """Everything that a comparison found."""

    study: Study  # the design
    budget: Budget
    controllers: list[ExaminedController]  # those that ran, in the order of `judged`
    failed: list[Tuned]  # those of which no design came
    judged: Judged
    rankings: dict[str, Ranking]  # by metric of FIGURES, of the controllers in the competition

    def _repr_html_(self) -> str:
        return shown(self)

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
        return self.controllers[self.competing[place]].entry.name


def find(
    study: Study,
    budget: Budget,
    tuned: list[Tuned],
    judged: Judged,
    figures: list[ExaminedController],
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
        study=study,
        budget=budget,
        controllers=figures,
        failed=[x for x in tuned if x.study is None],
        judged=judged,
        rankings={},
    )
    rows = findings.competing
    rankings = {
        name: rank(_complete(judged, judged.metrics[name])[rows], budget.seed) for name in FIGURES
    }
    return findings._replace(rankings=rankings)


def _complete(judged: Judged, figure: np.ndarray) -> np.ndarray:
    """A figure, NaN where a run did not finish."""
    return np.where(np.isin(judged.status, status.FINISHED), figure, np.nan)


def as_given(name: str, study: Study) -> Combination:
    """What stands beside the competition: a study as it is."""
    return Combination(name=name, law="", drive="", study=study, reason="not tuned", n_free=0)


def combinations(study: Study, tuned: list[Tuned]) -> list[Combination]:
    """Every tuned law with every tuned drive.

    Laws are tuned on the design's drive and drives with the design's law: the links see the drive
    as what holds their sliders, and no combination is tuned by itself.

    Args:
        study: the design.
        tuned: all candidates.

    Raises:
        StudyError: no law, or no drive, can be tuned.
    """
    whole = [x for x in tuned if x.study is not None]
    for is_drive in (False, True):
        if not any(x.candidate.is_drive == is_drive for x in whole):
            failed = next(x for x in tuned if x.candidate.is_drive == is_drive)
            kind = "drive" if is_drive else "law"
            raise StudyError(f"laws: no {kind} can be tuned; {failed.reason}")
    laws, drives = ([x for x in whole if x.candidate.is_drive == kind] for kind in (False, True))
    return [_combined(study, law, drive) for law in laws for drive in drives]


def _combined(study: Study, law: Tuned, drive: Tuned) -> Combination:
    assert law.study is not None and drive.study is not None
    both = parse_study(set_values(law.study, changes(study, drive.study)))
    return Combination(
        name=f"{law.candidate.name}; {drive.candidate.name}",
        law=law.candidate.name,
        drive=drive.candidate.name,
        study=both,
        reason="; ".join(filter(None, (law.reason, drive.reason))),
        n_free=law.n_free + drive.n_free,
    )


def examine(entry: Combination) -> ExaminedController:
    """A controller's loop on its own machine, and what a sample of it costs."""
    study = entry.study
    if not study.is_controlled:
        return ExaminedController(entry, entry.reason, None, None)
    structure, case = check_run(study)
    pose = np.array(study.motion.waypoints[0], float)
    loop = loop_report(structure, case, pose, structure.n_controlled)
    reason = entry.reason
    if not loop.is_stable:
        reason = "; ".join(filter(None, (reason, "unstable")))
    return ExaminedController(entry, reason, loop, products_of(fixed_controller(study).channels))


def verdict(findings: LawFindings) -> list[str]:
    """Which controller to take, and how certain that is, in sentences."""
    ranking = findings.ranking
    if ranking.best < 0:
        return ["No controller keeps the budget and finishes all runs."]
    best, share = findings.name(ranking.best), ranking.share[ranking.best]
    tied = [
        findings.name(k)
        for k in ranking.order
        if k != ranking.best and np.isfinite(ranking.ratio[k]) and ranking.is_tied[k]
    ]
    often = "all" if share == 1 else f"{100 * share:.0f} % of"
    lines = [
        f"{best} leaves the least residual vibration; it is first in {often} {RESAMPLES} "
        "resamplings of the machines."
    ]
    if tied:
        lines.append(f"Not to be told from it on these machines: {', '.join(tied)}.")
    others = [_other(findings, name) for name in list(FIGURES)[1:]]
    return [*lines, _own_law(findings), *filter(None, others)]


def _own_law(findings: LawFindings) -> str:
    """How far the design's own law is behind the best, with ratios as given and on any drive."""
    ranking, entries = findings.ranking, findings.controllers
    own = LAWS[findings.study.control.law].text
    behind = []
    for name in (f"{own}, {AS_GIVEN}", own):
        places = [k for k, row in enumerate(findings.competing) if entries[row].entry.law == name]
        places = [k for k in places if np.isfinite(ranking.ratio[k])]
        if places:
            k = min(places, key=lambda k: ranking.ratio[k])
            what = f"{findings.name(k)} has {ranking.ratio[k]:.2f} times as much"
            behind.append(f"{what} ({ranking.low[k]:.2f} to {ranking.high[k]:.2f})")
    if not behind:
        return f"The design's own law, {own}, does not keep the budget."
    return f"Of the design's own law, at its best: {'; '.join(behind)}."


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
