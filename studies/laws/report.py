"""The page of a comparison of laws and drives."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxmodel import status
from studies.laws.document import MARGINS, ControllerFigures, figures_of, order
from studies.laws.findings import LawFindings, beyond_budget, verdict
from studies.laws.judging import FIGURES, MOVES
from studies.laws.machines import spread_of
from studies.laws.ranking import CONFIDENCE
from studies.laws.tuning import AGREE, LATE, Tuned
from studies.show.pages import old_page as page
from studies.show.sketch import CAPTION
from studies.show.units import number
from studies.study.margin import delay_text, margin_text

HEADS = (
    "controller",
    "residual rms, geometric mean [µm]",
    "over the best (95 %)",
    "settling, median [ms]",
    "platform error while moving, geometric mean [µm]",
    "largest voltage [V]",
    "rms voltage, mean [V]",
    "control energy, mean [V² s]",
    "note",
)
FIGURE_TEXT = {"gain_margin": lambda x: margin_text(x, 3), "delay_margin": delay_text}
LOOP_HEADS = (
    "controller",
    "disk margin, worst [1]",
    "gain margin, worst [1]",
    "phase margin, worst [deg]",
    "delay margin, worst [samples]",
    "breaks first, on the machine with the least gain margin",
    "multiplications per sample",
    "tuned parameters",
)
TUNING_HEADS = (
    "candidate",
    "tuned parameters",
    "objective over the given design's",
    f"starting points within {100 * AGREE:.0f} % of the best",
    f"gain of the last {LATE} iterations",
    "at a bound",
)


def report(findings: LawFindings, images: Path | None = None) -> str:
    """The page.

    Args:
        findings: of the comparison.
        images: folder with the figures; None: a page without.
    """
    machines, moves = findings.judged.status.shape[1:]
    return page(
        "laws/report.html",
        images,
        findings.study,
        findings=findings,
        study=findings.study,
        budget=findings.budget,
        verdict=verdict(findings),
        heads=HEADS,
        rows=table_rows(findings),
        loop_heads=LOOP_HEADS,
        loop_rows=[_loop_row(figures_of(findings, k)) for k in order(findings)],
        tuning_heads=TUNING_HEADS,
        tuning_rows=[_tuning_row(findings, x) for x in findings.tuned],
        failed=findings.failed,
        machines=machines,
        moves=moves,
        times=MOVES,
        spread=spread_of(findings.study),
        confidence=CONFIDENCE,
        figures=FIGURES,
        sketch_caption=CAPTION,
    )


def table_rows(findings: LawFindings) -> list[list[str]]:
    """Rows under HEADS: the competition, best first, then the others."""
    return [_row(findings, k) for k in order(findings)]


def _row(findings: LawFindings, k: int) -> list[str]:
    one, judged = figures_of(findings, k), findings.judged
    parts = one.controller.reason, _incidents(judged.status[k]), beyond_budget(findings, k)
    note = "; ".join(filter(None, parts))
    is_limited = one.peak_voltage >= findings.study.electronics.voltage_limit
    return [
        one.controller.name,
        number(one.residual_rms, "m"),
        _ratio(findings, k),
        number(one.settling_time, "s"),
        number(one.pose_error_peak, "m"),
        number(one.peak_voltage, "V") + (" (the limit)" if is_limited else ""),
        f"{one.rms_voltage:.3g}",
        f"{one.control_energy:.3g}",
        note or "-",
    ]


def _incidents(codes: np.ndarray) -> str:
    """What happened in how many runs, in words; "" if all are in order."""
    found, counts = np.unique(codes[codes != status.OK], return_counts=True)
    each = zip(found.tolist(), counts.tolist(), strict=True)
    return "; ".join(f"{status.REASONS[code]} in {n} of {codes.size} runs" for code, n in each)


def _loop_row(one: ControllerFigures) -> list[str]:
    texts = [FIGURE_TEXT.get(name, "{:.3g}".format)(x) for name, x in one.margins.items()]
    return [
        one.controller.name,
        *(["-"] * len(MARGINS) if one.products is None else texts),
        one.breaking or "-",
        "-" if one.products is None else str(one.products),
        str(one.controller.n_free),
    ]


def _tuning_row(findings: LawFindings, one: Tuned) -> list[str]:
    """What says how far a candidate's tuning has come."""
    cells = ["-"] * 4
    if one.quality is not None:
        found = one.quality
        cells = [
            f"{found.objective:.3f}",
            f"{found.n_alike} of {findings.budget.starts}",
            "-" if np.isnan(found.late_gain) else f"{100 * found.late_gain:.1f} %",
            ", ".join(found.at_bound) or "-",
        ]
    return [one.candidate.name, str(one.n_free), *cells]


def _ratio(findings: LawFindings, k: int) -> str:
    """Ratio to the best, with its interval, of a controller in the competition."""
    rows, ranking = findings.competing, findings.ranking
    if k not in rows or not np.isfinite(ranking.ratio[rows.index(k)]):
        return "-"
    place = rows.index(k)
    if place == ranking.best:
        return "1"
    return (
        f"{ranking.ratio[place]:.2f} ({ranking.low[place]:.2f} to {ranking.high[place]:.2f})"
        f"{', tied' if ranking.is_tied[place] else ''}"
    )
