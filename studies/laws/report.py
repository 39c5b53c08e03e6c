"""The page of a comparison of laws and drives, and its document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxmodel import status
from studies.laws.findings import LawFindings, beyond_budget, verdict
from studies.laws.judging import FIGURES, MOVES, longer
from studies.laws.machines import spread_of
from studies.laws.ranking import CONFIDENCE, geometric_mean
from studies.laws.tuning import AGREE, LATE, Tuned
from studies.show.document import json_text
from studies.show.pages import page
from studies.show.sketch import CAPTION
from studies.show.units import number
from studies.study.consistency import patch_centers
from studies.study.margin import delay_text, margin_text

#: Columns of the table: metric, its unit, how runs become one number.
COLUMNS = (
    ("residual_rms", "m", geometric_mean),
    ("settling_time", "s", np.median),
    ("pose_error_peak", "m", geometric_mean),
    ("peak_voltage", "V", np.max),
    ("control_energy", "V2 s", np.mean),
)
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
#: Margins of the second table.
SHOWN_MARGINS = ("disk_margin", "gain_margin", "phase_margin", "delay_margin")
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
        loop_rows=[_loop_row(findings, k) for k in _order(findings)],
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
    return [_row(findings, k) for k in _order(findings)]


def _order(findings: LawFindings) -> list[int]:
    """Controllers as the table has them: the competition, best first, then the others."""
    rows = findings.competing
    ranked = [rows[k] for k in findings.ranking.order]
    return ranked + [k for k in range(len(findings.controllers)) if k not in ranked]


def _row(findings: LawFindings, k: int) -> list[str]:
    controller, judged = findings.controllers[k], findings.judged
    values = {name: _over(judged.metrics[name][k], over) for name, _, over in COLUMNS}
    parts = controller.reason, _incidents(judged.status[k]), beyond_budget(findings, k)
    note = "; ".join(filter(None, parts))
    is_limited = values["peak_voltage"] >= findings.study.electronics.voltage_limit
    return [
        controller.name,
        number(values["residual_rms"], "m"),
        _ratio(findings, k),
        number(values["settling_time"], "s"),
        number(values["pose_error_peak"], "m"),
        number(values["peak_voltage"], "V") + (" (the limit)" if is_limited else ""),
        f"{_rms_voltage(findings, k):.3g}",
        f"{values['control_energy']:.3g}",
        note or "-",
    ]


def _incidents(codes: np.ndarray) -> str:
    """What happened in how many runs, in words; "" if all are in order."""
    found, counts = np.unique(codes[codes != status.OK], return_counts=True)
    each = zip(found.tolist(), counts.tolist(), strict=True)
    return "; ".join(f"{status.REASONS[code]} in {n} of {codes.size} runs" for code, n in each)


def _loop_row(findings: LawFindings, k: int) -> list[str]:
    controller, products = findings.controllers[k], findings.products[k]
    margins = {} if products is None else _worst_margins(findings, k)
    texts = [FIGURE_TEXT.get(name, "{:.3g}".format)(x) for name, x in margins.items()]
    return [
        controller.name,
        *(texts or ["-"] * len(SHOWN_MARGINS)),
        findings.judged.breaking[k] or "-",
        "-" if products is None else str(products),
        str(controller.n_free),
    ]


def _tuning_row(findings: LawFindings, one: Tuned) -> list[str]:
    """What says how far a candidate's tuning has come."""
    cells = ["-"] * 4
    if one.quality is not None:
        objective, n_alike, gain, at_bound = one.quality
        cells = [
            f"{objective:.3f}",
            f"{n_alike} of {findings.budget.starts}",
            "-" if np.isnan(gain) else f"{100 * gain:.1f} %",
            ", ".join(at_bound) or "-",
        ]
    return [one.candidate.name, str(one.n_free), *cells]


def _worst_margins(findings: LawFindings, k: int) -> dict[str, float]:
    """Least margins of a controller on the machines it was judged on."""
    return {name: _over(findings.judged.margins[name][k], np.min) for name in SHOWN_MARGINS}


def _rms_voltage(findings: LawFindings, k: int) -> float:
    """Of an actuator of the controlled links in the mean run [V]."""
    study = findings.controllers[k].study
    count = sum(findings.study.control.links) * patch_centers(study).shape[1]
    energy = _over(findings.judged.metrics["control_energy"][k], np.mean)
    return float(np.sqrt(energy / (count * longer(study).run.duration)))


def _over(values: np.ndarray, over: Any) -> float:
    finite = values[np.isfinite(values)]
    return float(over(finite)) if finite.size else float("nan")


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


def document(findings: LawFindings) -> str:
    """The same as a JSON document, numbers in SI units."""
    whole = {
        "title": findings.study.title,
        "budget": findings.budget._asdict(),
        "verdict": verdict(findings),
        "controllers": [_entry(findings, k) for k in _order(findings)],
        "tunings": [_tuning_entry(x) for x in findings.tuned if x.quality is not None],
        "failed": [{"name": x.candidate.name, "reason": x.reason} for x in findings.failed],
        "study": findings.study.model_dump(mode="json"),
    }
    return json_text("laws", whole)


def _tuning_entry(one: Tuned) -> dict[str, Any]:
    assert one.quality is not None
    return {"name": one.candidate.name, "numbers_tuned": one.n_free, **one.quality._asdict()}


def _entry(findings: LawFindings, k: int) -> dict[str, Any]:
    controller, judged = findings.controllers[k], findings.judged
    rows = findings.competing
    entry: dict[str, Any] = {
        "name": controller.name,
        "law": controller.law,
        "drive": controller.drive,
        "reason": controller.reason,
        "numbers_tuned": controller.n_free,
        "products": findings.products[k],
        "margins": _worst_margins(findings, k),
        "rms_voltage": _rms_voltage(findings, k),
        "breaking": findings.judged.breaking[k],
        "runs_lost": int(judged.n_lost[k]),
    }
    entry |= {name: _over(judged.metrics[name][k], over) for name, _, over in COLUMNS}
    if k in rows:
        place = rows.index(k)
        entry["ratio"] = {
            metric: [x[place] for x in (ranking.ratio, ranking.low, ranking.high)]
            for metric, ranking in findings.rankings.items()
        }
    return entry
