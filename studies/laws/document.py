"""What each controller of a comparison came to, and the document (`laws.json`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from studies.laws.findings import Combination, LawFindings, verdict
from studies.laws.judging import longer
from studies.laws.ranking import geometric_mean
from studies.laws.tuning import Budget, Quality
from studies.results.labelled import Labelled, labelled, told
from studies.study.consistency import patch_centers
from studies.study.spec import Study

#: Margins that are told of each controller.
MARGINS = ("disk_margin", "gain_margin", "phase_margin", "delay_margin")


class ControllerFigures(Labelled):
    """A controller over all machines and moves."""

    controller: Combination = told("which one")
    products: int | None = told("multiplications a sample, null without control")
    margins: dict[str, float] = told(
        "least over machines: disk, gain [1], phase [deg], delay [samples]"
    )
    rms_voltage: float = labelled("V", "of an actuator of the controlled links, in the mean run")
    breaking: str = told("what goes unstable first, on the machine with the least gain margin")
    runs_lost: int = told("that did not finish")
    residual_rms: float = labelled("m", "geometric mean")
    settling_time: float = labelled("s", "median")
    pose_error_peak: float = labelled("m", "geometric mean, in the plane, while moving")
    peak_voltage: float = labelled("V", "largest")
    control_energy: float = labelled("V2 s", "mean")
    ratio: dict[str, list[float]] | None = told(
        "by figure: over the best one's, and its 95 % interval; null: not ranked"
    )


class CandidateTuning(Labelled):
    """How far the tuning of a candidate came."""

    name: str = told("of the candidate")
    numbers_tuned: int = told("by it")
    quality: Quality = told("whether it found the best numbers")


class LawsDocument(Labelled, command="compare", version=2):
    """`laws.json`, written by `studies compare`: every controller of the comparison, best first."""

    title: str = told("of the study")
    budget: Budget = told("of every candidate")
    verdict: list[str] = told("which controller to take, and how certain that is")
    controllers: list[ControllerFigures] = told("best first")
    tunings: list[CandidateTuning] = told("of candidates of which a run finished")
    failed: dict[str, str] = told("candidates of which no controller came, and why")
    study: Study = told("the design, as its file")


def laws_document(findings: LawFindings) -> LawsDocument:
    """The document of a comparison."""
    return LawsDocument(
        title=findings.study.title,
        budget=findings.budget,
        verdict=verdict(findings),
        controllers=[figures_of(findings, k) for k in order(findings)],
        tunings=[
            CandidateTuning(x.candidate.name, x.n_free, x.quality)
            for x in findings.tuned
            if x.quality
        ],
        failed={x.candidate.name: x.reason for x in findings.failed},
        study=findings.study,
    )


def order(findings: LawFindings) -> list[int]:
    """Controllers as tables have them: the competition, best first, then the others."""
    rows = findings.competing
    ranked = [rows[k] for k in findings.ranking.order]
    return ranked + [k for k in range(len(findings.controllers)) if k not in ranked]


def figures_of(findings: LawFindings, k: int) -> ControllerFigures:
    """What a controller, the k-th that ran, came to."""
    judged, ratio = findings.judged, None
    if k in findings.competing:
        place = findings.competing.index(k)
        ratio = {
            metric: [float(x[place]) for x in (ranking.ratio, ranking.low, ranking.high)]
            for metric, ranking in findings.rankings.items()
        }

    def mean(metric: str, over: Callable[[np.ndarray], object]) -> float:
        return _over(judged.metrics[metric][k], over)

    return ControllerFigures(
        controller=findings.controllers[k],
        products=findings.products[k],
        margins={name: _over(judged.margins[name][k], np.min) for name in MARGINS},
        rms_voltage=_rms_voltage(findings, k),
        breaking=judged.breaking[k],
        runs_lost=int(judged.n_lost[k]),
        residual_rms=mean("residual_rms", geometric_mean),
        settling_time=mean("settling_time", np.median),
        pose_error_peak=mean("pose_error_peak", geometric_mean),
        peak_voltage=mean("peak_voltage", np.max),
        control_energy=mean("control_energy", np.mean),
        ratio=ratio,
    )


def _rms_voltage(findings: LawFindings, k: int) -> float:
    """Of an actuator of the controlled links in the mean run [V]."""
    study = findings.controllers[k].study
    count = sum(findings.study.control.links) * patch_centers(study).shape[1]
    energy = _over(findings.judged.metrics["control_energy"][k], np.mean)
    return float(np.sqrt(energy / (count * longer(study).run.duration)))


def _over(values: np.ndarray, over: Callable[[np.ndarray], object]) -> float:
    finite = values[np.isfinite(values)]
    return float(over(finite)) if finite.size else float("nan")  # type: ignore[arg-type]
