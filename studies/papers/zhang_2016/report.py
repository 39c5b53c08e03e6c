"""The report of the paper's study: its numbers next to those of two machines, and why they differ.

The text is in `report.html`; the rows of its tables come from `tables`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxmodel.prepare import SPECTRUM_SPAN
from studies.papers.card import PaperCard, Verdict
from studies.papers.zhang_2016.cases import (
    ALL,
    EXPERIMENT_RATIOS,
    HIGH_DAMPING,
    MOVES,
    OFF,
    PAPER_RATIOS,
    TWO,
)
from studies.papers.zhang_2016.context import Context, Machines, change
from studies.papers.zhang_2016.figures import PAPER_FIGURES, PLATFORM_DELAY, VIEW_LENGTH
from studies.papers.zhang_2016.measures import SETTLED
from studies.papers.zhang_2016.tables import (
    COLUMNS,
    amplitude_change,
    design_rows,
    energy_ratio,
    frequency_rows,
    machine_rows,
    motion_rows,
    platform_rows,
    printed_changes,
    ratio_rows,
    settling_rows,
    table_1_rows,
)
from studies.show.pages import old_page as page
from studies.show.sketch import CAPTION
from studies.study.window import residual_delay


def report(
    card: PaperCard, verdicts: list[Verdict], machines: Machines, images: Path | None = None
) -> str:
    """The page of the paper's study.

    Args:
        card: of the paper.
        verdicts: on its claims.
        machines: both.
        images: folder with its figures, PAPER_FIGURES; None: a page without.
    """
    fitted, nominal = machines
    runs, study = nominal.runs, nominal.runs.study
    cases = {case.name: k for k, case in enumerate(runs.cases)}
    return page(
        "papers/zhang_2016/report.html",
        images,
        study,
        card=card,
        verdicts=verdicts,
        fitted=fitted.runs.study,
        study=study,
        machines=machine_rows(machines),
        cases=cases,
        moves=MOVES,
        bad=[
            f"{case.name} ({context.name})"
            for context in machines
            for case, code in zip(context.runs.cases, context.runs.status, strict=True)
            if code
        ],
        # of the nominal machine: without control the paper's move with its shaper and without, the
        # fast one; then with control
        smooth=nominal.find("paper", "ei", 3, OFF),
        slow=nominal.find("paper", "none", 3, OFF),
        free=nominal.compared(3, OFF),
        held=nominal.compared(3, ALL),
        residual=1e6 * nominal.measures.residual,
        bent=1e6 * runs.result.metrics.structural_peak.max(axis=2),
        damping=np.atleast_1d(fitted.runs.study.link.damping_ratio).tolist(),
        view=(PLATFORM_DELAY, VIEW_LENGTH),
        adc_step=1e6 * runs.frame.adc_step,
        fitted_step=1e6 * fitted.runs.frame.adc_step,
        delays=sorted({1e3 * residual_delay(x.runs.study) for x in (fitted, nominal)}),
        peak_span=SPECTRUM_SPAN,
        band=f"{1e6 * study.metrics.settling_band:g}",
        settled=f"{100 * SETTLED:g}",
        high_damping=HIGH_DAMPING,
        columns=COLUMNS,
        weak=study.control.velocity_gain[0] * study.control.gain_factor,
        paper_second=np.array([row[1] for row in (*PAPER_RATIOS, *EXPERIMENT_RATIOS)]),
        frequencies=frequency_rows(machines),
        ratios=ratio_rows(machines),
        table_1=table_1_rows(machines),
        settling_rows=settling_rows(machines),
        platform=platform_rows(machines),
        motions=motion_rows(nominal),
        designs=design_rows(nominal),
        agreement=_agreement(fitted),
        nominal=_agreement(nominal),
        halved=[(context.name, _halved_directions(context)) for context in machines],
        is_halved=any(len(_halved_directions(context)) == 3 for context in machines),
        shaped=_shaper_factors(nominal),
        difference=_difference(nominal, cases),
        ideal_factor=_ideal_factor(nominal, cases),
        peak_change=lambda name, mode: nominal.peak_change(cases[name], mode),
        sketch_caption=CAPTION,
        drawn=list(PAPER_FIGURES),
    )


def _agreement(context: Context) -> dict[str, Any]:
    """How far a machine has the paper's numbers."""
    measures = context.measures
    settling = [1e3 * measures.settling[context.compared(2, links)] for links in (OFF, ALL)]
    changes = {
        is_controlled: [
            float(change)
            for _, links, mode, _ in printed_changes()
            for change, is_on in zip(amplitude_change(context, links, mode), links, strict=True)
            if is_on == is_controlled
        ]
        for is_controlled in (True, False)
    }
    apart = {
        mode: max(
            float(np.abs(amplitude_change(context, links, mode) - printed).max())
            for _, links, of, printed in printed_changes()
            if of == mode
        )
        for mode in (1, 2)
    }
    return {
        "frequency": context.runs.link_hz.T,
        "apart": apart,
        "controlled": changes[True],
        "uncontrolled": changes[False],
        "free": settling[0],
        "held": settling[1],
        "second": energy_ratio(context)[:, 1],
        "residual": [
            1e6 * measures.residual[context.compared(3, links)].max() for links in (OFF, ALL)
        ],
    }


def _halved_directions(context: Context) -> list[str]:
    """Directions in which two controlled links more than halve the residual error."""
    off, two = (
        context.runs.result.metrics.pose_error_rms[context.compared(3, links)]
        for links in (OFF, TWO)
    )
    return [f"{n} ({change(x, y)})" for n, x, y in zip("xyφ", two, off, strict=True) if x < 0.5 * y]


def _shaper_factors(context: Context) -> list[float]:
    """Factor by which the EI shaper reduces the residual vibration, per move."""
    left = context.measures.residual.max(axis=1)
    unshaped, shaped = (
        np.array([left[context.find(move, shaper, 3, OFF)] for move in MOVES])
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


def _ideal_factor(context: Context, cases: dict[str, int]) -> float | None:
    """Residual of the sampled loop over that of ideal feedback, None if either is missing."""
    if not {"ideal", "paper-preset"} <= cases.keys():
        return None
    sampled, ideal = (
        context.measures.residual[cases[name]].max() for name in ("paper-preset", "ideal")
    )
    return float(sampled / ideal)
