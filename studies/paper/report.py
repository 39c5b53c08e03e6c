"""The report of the paper's study: its numbers next to ours, and why they differ.

The text is in `report.md`; the rows of its tables come from `tables`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.engine.frame import EARLY_PART
from studies.paper.cases import (
    ALL,
    HIGH_DAMPING,
    MOVES,
    OFF,
    PAPER_GAINS,
    PAPER_RATIOS,
    TWO,
    PaperRuns,
)
from studies.paper.context import PLACES, Context, change, move_text, settings
from studies.paper.figures import PAPER_FIGURES
from studies.paper.measures import PEAK_SPAN, SETTLED, Measures, middle_station
from studies.paper.tables import (
    EXPERIMENT_RATIOS,
    design_rows,
    mode_2_rows,
    platform_rows,
    ratio_rows,
    settling_rows,
    table_1_rows,
)
from studies.show.markdown import picture
from studies.show.sketch import CAPTION
from studies.show.templates import render
from studies.study.consistency import each_link


def report(runs: PaperRuns, measures: Measures) -> str:
    """Markdown text; its figures are PAPER_FIGURES."""
    context, study = Context(runs, measures), runs.study
    cases = {case.name: k for k, case in enumerate(runs.cases)}
    free, held = (context.find("fast", "none", 3, links) for links in (OFF, ALL))
    settling = 1e3 * measures.settling
    return render(
        "paper/report.md",
        runs=runs,
        study=study,
        cases=cases,
        moves=MOVES,
        bad=[c.name for c, code in zip(runs.cases, runs.status, strict=True) if code],
        # without control: the paper's move with its shaper and without, the fast one; then with it
        smooth=context.find("paper", "ei", 3, OFF),
        slow=context.find("paper", "none", 3, OFF),
        free=free,
        held=held,
        late=1e6 * measures.late_deflection,
        bent=1e6 * runs.result.metrics.structural_peak.max(axis=2),
        settling=settling,
        settling_share=100 * settling[held].max() / max(settling[free].max(), 1e-6),
        modulus=each_link(study.link.youngs_modulus) / 1e9,
        adc_step=1e6 * runs.frame.adc_step,
        early=EARLY_PART * study.metrics.residual_length,
        peak_span=PEAK_SPAN,
        band=f"{1e6 * study.metrics.settling_band:g}",
        settled=f"{100 * SETTLED:g}",
        high_damping=HIGH_DAMPING,
        second=np.array([row.ratio[:, 1] for row in runs.energy_ratio]),
        gains=PAPER_GAINS,
        paper_second=np.array([row[1] for row in (*PAPER_RATIOS, *EXPERIMENT_RATIOS)]),
        ratios=ratio_rows(context),
        table_1=table_1_rows(context),
        mode_2=mode_2_rows(context),
        settling_rows=settling_rows(context),
        platform=platform_rows(context),
        designs=design_rows(context),
        grown=_grown(context),
        halved=_halved(context),
        shaped=_shaped(context),
        difference=_difference(context, cases),
        drop=lambda name, mode: context.drop(cases[name], mode),
        sketch_caption=CAPTION,
        figure=_figure,
        **_peaks(context),
        **_platform(context),
    )


def _figure(name: str, caption: str) -> str:
    return picture(f"{name}.png", f"`{name}`: {caption}") if name in PAPER_FIGURES else ""


def _peaks(context: Context) -> dict[str, Any]:
    """Spectral peaks of the faster unshaped move, which leaves vibration to reduce."""
    peak = context.measures.spectral_peak
    off = context.find("fast", "none", 2, OFF)
    controlled: list[float] = []
    uncontrolled: list[float] = []
    for links, _ in PLACES:
        on = context.find("fast", "none", 2, links)
        for i in range(3):
            changed = 100 * (peak[on, i, 0] / peak[off, i, 0] - 1)
            (controlled if links[i] else uncontrolled).append(changed)
    return {
        "controlled": controlled,
        "uncontrolled": uncontrolled,
        "peak_share": peak[off, :, 1] / peak[off, :, 0],
        "gain_share": context.runs.ratio[context.find("fast", "none", 2, ALL), :, 1],
    }


def _grown(context: Context) -> list[tuple[str, str, str]]:
    """Where control increases the rms of the whole window: case, its change, that of the late."""
    late = context.measures.late_deflection
    whole = context.runs.result.metrics.residual_rms[:, :, middle_station(context.runs)]
    return [
        (
            f"{text}, link {i + 1}",
            change(whole[on, i], whole[off, i]),
            change(late[on, i], late[off, i]),
        )
        for off, on, text in context.pairs()
        for i in range(3)
        if whole[on, i] > whole[off, i]
    ]


def _halved(context: Context) -> list[tuple[str, list[str]]]:
    """Per move, directions in which two controlled links more than halve the late error."""
    found = []
    for move, shaper in settings():
        off, two = (
            context.measures.late_pose_error[context.find(move, shaper, 3, links)]
            for links in (OFF, TWO)
        )
        axes = [n for n, x, y in zip("xyφ", two, off, strict=True) if x < 0.5 * y]
        found.append((move_text(move, shaper), axes))
    return found


def _platform(context: Context) -> dict[str, Any]:
    """Platform errors of the faster unshaped move, without control and with two links."""
    off, two = (context.find("fast", "none", 3, links) for links in (OFF, TWO))
    late, whole = context.measures.late_pose_error, context.runs.result.metrics.pose_error_rms
    return {
        "drive_factor": whole[off, 0] / late[off, 0],
        "drive_change": change(whole[two, 0], whole[off, 0]),
        "grown_errors": [
            f"{n} {change(x, y)}"
            for n, x, y in zip("xyφ", late[two], late[off], strict=True)
            if x > y
        ],
        "largest": 1e9 * late[[off, two]].max(axis=0),
    }


def _shaped(context: Context) -> list[float]:
    """Factor by which the EI shaper reduces the late vibration, per move."""
    late = context.measures.late_deflection.max(axis=1)
    unshaped, shaped = (
        np.array([late[context.find(move, shaper, 3, OFF)] for move in MOVES])
        for shaper in ("none", "ei")
    )
    return (unshaped / shaped).tolist()


def _difference(context: Context, cases: dict[str, int]) -> dict[str, Any] | None:
    """Outcome with the velocity as a difference, None if it was not run and judged."""
    name, runs = "difference", context.runs
    if name not in cases or name not in runs.loops:
        return None
    return {
        "status": int(runs.status[cases[name]]),
        "margin": runs.loops[name].gain_margin,
        "voltage": runs.result.metrics.peak_voltage[cases[name]].max(),
    }
