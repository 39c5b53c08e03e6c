"""What a comparison found: figures of each controller, who is best, and whether that is certain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxmodel import status
from jaxmodel.laws import LAWS
from studies.engine.controller import fixed_controller
from studies.engine.frame import frame_of
from studies.engine.preflight import check_run
from studies.errors import StudyError
from studies.export.cost import products_of
from studies.laws.candidates import AS_GIVEN
from studies.laws.judging import FIGURES, MOVES, Judged, changes
from studies.laws.ranking import RESAMPLES, Ranking, geometric_mean, rank
from studies.laws.tuning import Budget, Tuned
from studies.result import Result
from studies.results.labelled import Labelled, told, unwritten
from studies.study.entries import controlled_links
from studies.study.margin import ENOUGH, margin_text
from studies.study.paths import set_values
from studies.study.resolution import least_step, resolution_text
from studies.study.spec import Study, parse_study

#: Ratio of residual vibration up to which controllers are as good as each other.
CLOSE = 1.1
#: Factor up to which a budget counts as kept on fresh machines.
TOLERANCE = 1.01
GIVEN, WITHOUT = "the design as given", "without control"


class Combination(Labelled):
    """A controller to compare."""

    name: str = told("in tables")
    law: str = told("name of its candidate, empty for what was given")
    drive: str = told("the same")
    study: Study = unwritten()
    reason: str = told("why it is not ranked, empty if it is")
    n_free: int = told("numbers it was tuned by")


@dataclass(frozen=True, eq=False)
class LawFindings(Result):
    """Everything that a comparison found."""

    study: Study  # the design
    budget: Budget
    controllers: list[Combination]  # those that ran, in the order of `judged`
    products: list[int | None]  # multiplications a sample of each; None without control
    tuned: list[Tuned]  # all candidates
    judged: Judged
    rankings: dict[str, Ranking]  # by metric of FIGURES, of the controllers in the competition

    @property
    def competing(self) -> list[int]:
        """Controllers that keep the budget."""
        return [k for k, one in enumerate(self.controllers) if not one.reason]

    @property
    def failed(self) -> list[Tuned]:
        """Candidates of which no controller came."""
        return [x for x in self.tuned if x.study is None]

    @property
    def ranking(self) -> Ranking:
        """By the figure that decides."""
        return next(iter(self.rankings.values()))

    def name(self, place: int) -> str:
        """Name of a controller of the competition."""
        return self.controllers[self.competing[place]].name


def find(
    study: Study,
    budget: Budget,
    tuned: list[Tuned],
    judged: Judged,
    entries: list[Combination],
) -> LawFindings:
    """Rank what was judged.

    Args:
        study: the design.
        budget: of every candidate.
        tuned: all candidates.
        judged: of the controllers, in their order.
        entries: the controllers.
    """
    products: dict[str, int | None] = {}
    for entry in entries:
        if _controller(entry) not in products:
            products[_controller(entry)] = _products(entry.study)
    findings = LawFindings(
        study=study,
        budget=budget,
        controllers=[
            _with_stability(entry, margin)
            for entry, margin in zip(entries, judged.margins["gain_margin"], strict=True)
        ],
        products=[products[_controller(entry)] for entry in entries],
        tuned=tuned,
        judged=judged,
        rankings={},
    )
    rows = findings.competing
    rankings = {
        name: rank(_complete(judged, judged.metrics[name])[rows], budget.seed) for name in FIGURES
    }
    return replace(findings, rankings=rankings)


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
        name=f"{law.candidate.name} + {drive.candidate.name}",
        law=law.candidate.name,
        drive=drive.candidate.name,
        study=both,
        reason="; ".join(filter(None, (law.reason, drive.reason))),
        n_free=law.n_free + drive.n_free,
    )


def _controller(entry: Combination) -> str:
    """What combinations with the same law share; what was given has its own."""
    return entry.law or entry.name


def _products(study: Study) -> int | None:
    """Multiplications a sample of a controller, None without control."""
    return products_of(fixed_controller(study).channels) if study.is_controlled else None


def _with_stability(entry: Combination, margin: np.ndarray) -> Combination:
    """A controller, out of the competition if any machine's gain margin (M,) is below 1."""
    count = int(np.sum(margin < 1))
    if not count:
        return entry
    text = f"unstable on {count} of {len(margin)} machines"
    return entry.replace(reason="; ".join(filter(None, (entry.reason, text))))


def verdict(findings: LawFindings) -> list[str]:
    """Which controller to take, and how certain that is, in sentences."""
    ranking = findings.ranking
    if ranking.best < 0:
        return ["No controller keeps the budget and finishes all runs."]
    best, share = findings.name(ranking.best), ranking.share[ranking.best]
    row = findings.competing[ranking.best]
    often = "all" if share == 1 else f"{100 * share:.0f} % of"
    lines = [
        f"{best} leaves the least residual vibration; it is first in {often} {RESAMPLES} "
        "resamplings of the machines."
    ]
    others = [_other(findings, name) for name in list(FIGURES)[1:]]
    beyond = beyond_budget(findings, row), _low_gain_margin(findings, row), _keeping(findings)
    every = [*_equals(findings), _own_law(findings), *others, *beyond]
    return [*filter(None, [_resolution(findings)]), *lines, *filter(None, every)]


def _equals(findings: LawFindings) -> list[str]:
    """Controllers that are as good as the best for practical purposes, and which to take then."""
    ranking, rows = findings.ranking, findings.competing
    with np.errstate(invalid="ignore"):
        is_close = (ranking.ratio <= CLOSE) | ranking.is_tied
    close = [int(k) for k in ranking.order if is_close[k] and np.isfinite(ranking.ratio[k])]
    if len(close) < 2:
        return []
    judged, products = findings.judged, [findings.products[rows[k]] or 0 for k in close]
    energy = [float(np.mean(judged.metrics["control_energy"][rows[k]])) for k in close]
    margin = [float(np.min(judged.margins["disk_margin"][rows[k]])) for k in close]
    frugal, small, robust = (
        findings.name(close[int(np.argmin(x))]) for x in (energy, products, [-x for x in margin])
    )
    names = ", ".join(findings.name(k) for k in close[1:])
    return [
        f"Within {100 * (CLOSE - 1):.0f} % of it, or not to be told from it on these machines: "
        f"{names}. Among all these, {frugal} needs the least control energy ({min(energy):.3g} "
        f"V² s), {small} the fewest multiplications per sample ({min(products)}), and {robust} has "
        f"the largest disk margin ({max(margin):.3g})."
    ]


def beyond_budget(findings: LawFindings, k: int) -> str:
    """Where a controller of the competition exceeds the budget on the machines it was judged on."""
    judged, budget = findings.judged, findings.budget
    if k not in findings.competing:
        return ""
    volts = np.nanmax(judged.metrics["peak_voltage"][k], axis=0, initial=0.0)  # of each move
    margins = judged.margins["disk_margin"][k]
    is_below = margins * TOLERANCE < budget.margin
    peaks = [
        f"{peak:.3g} V{'' if share == 1 else f' at {share:g} of the move time'}"
        for share, peak in zip(MOVES, volts, strict=True)
        if peak > TOLERANCE * budget.voltage
    ]
    parts = [f"up to {', '.join(peaks)} (tuned to {budget.voltage:.3g} V)"] if peaks else []
    if is_below.any():
        where = f"on {is_below.sum()} of {len(margins)} machines"
        parts.append(
            f"a disk margin below {budget.margin:.3g} {where}, down to {np.nanmin(margins):.3g}"
        )
    return f"On machines and moves that it was not tuned on: {', '.join(parts)}." if parts else ""


def _low_gain_margin(findings: LawFindings, k: int) -> str:
    """Warning of a gain margin that is low on any machine."""
    least = float(np.nanmin(findings.judged.margins["gain_margin"][k], initial=np.inf))
    if least >= ENOUGH:
        return ""
    return (
        f"Its gain margin is {margin_text(least, 3)} on the worst machine: below {ENOUGH:g}, loops "
        "may go unstable on the real one."
    )


def _keeping(findings: LawFindings) -> str:
    """The best controller that keeps the disk margin on every machine, if the best one does not."""
    ranking, rows = findings.ranking, findings.competing
    margin = np.nan_to_num(findings.judged.margins["disk_margin"][rows]).min(axis=1)
    keeps = np.isfinite(ranking.ratio) & (TOLERANCE * margin >= findings.budget.margin)
    if keeps[ranking.best]:
        return ""
    k = next((int(k) for k in ranking.order if keeps[k]), None)
    if k is None:
        return "No controller keeps the disk margin on every machine."
    return (
        f"Of those that keep the disk margin on every machine, {findings.name(k)} leaves the least "
        f"residual vibration, {ranking.ratio[k]:.2f} times as much ({ranking.low[k]:.2f} to "
        f"{ranking.high[k]:.2f}), with a disk margin of {margin[k]:.3g} or more."
    )


def _resolution(findings: LawFindings) -> str:
    """Warning about residual vibration that the controller cannot measure."""
    study, judged = findings.study, findings.judged
    adc_step = frame_of(*check_run(study)).adc_step
    step = least_step("residual_rms", adc_step, controlled_links([study]))
    means = [geometric_mean(judged.metrics["residual_rms"][k]) for k in findings.competing]
    return resolution_text("Mean residual vibrations", np.array(means), step, "controller")


def _own_law(findings: LawFindings) -> str:
    """How far the design's own law is behind the best, with ratios as given and on any drive."""
    ranking, entries = findings.ranking, findings.controllers
    own = LAWS[findings.study.control.law].text
    behind = []
    for name in (f"{own}, {AS_GIVEN}", own):
        places = [k for k, row in enumerate(findings.competing) if entries[row].law == name]
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
    more = findings.ranking.ratio[ranking.best]
    return (
        f"By {words} it does not: {findings.name(ranking.best)} is better there, with {more:.3g} "
        f"times the residual vibration; {findings.name(chosen)} has {ranking.ratio[chosen]:.2f} "
        f"times as much ({ranking.low[chosen]:.2f} to {ranking.high[chosen]:.2f})."
    )
