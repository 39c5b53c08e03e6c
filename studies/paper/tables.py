"""Rows of the tables in the paper's report: our numbers next to the paper's.

Our numbers come from the runs; the paper's are constants in this file.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.paper.cases import ALL, OFF, PAPER_RATIOS
from studies.paper.context import PLACES, Context, change, move_text, residual, settings
from studies.paper.measures import middle_station
from studies.study.labels import describe
from studies.study.printed import TABLE_1

#: (27), experiment, two modes.
EXPERIMENT_RATIOS = ((1.0, 0.312), (1.0, 0.412), (1.0, 0.355))


#: Change of the PSD of mode 2 with three links controlled [%].
MODE_2 = (-48.33, -49.62, -52.21)


def ratio_rows(context: Context) -> list[list[str]]:
    """Gain ratios of efficient modal control, per link."""
    rows: list[tuple[str, Any]] = [
        ("paper (26), simulation", PAPER_RATIOS),
        ("paper (27), experiment", EXPERIMENT_RATIOS),
        *(
            (f"ours, {move_text(row.move, row.shaper)}, {row.basis}", row.ratio)
            for row in context.runs.energy_ratio
        ),
    ]
    return [
        [name, *(" : ".join(f"{x:.3g}" for x in link) for link in ratio)] for name, ratio in rows
    ]


def table_1_rows(context: Context) -> list[list[str]]:
    """Spectral peaks of mode 1: without control, with `PLACES`, and the late residual."""
    rows = [
        [f"paper, link {i + 1} (no unit)", f"{values[0]:.2f}"]
        + [f"{v:.2f} ({100 * (v / values[0] - 1):+.2f} %)" for v in values[1:]]
        + ["not given"]
        for i, values in enumerate(TABLE_1)
    ]
    for move, shaper in settings():
        off = context.find(move, shaper, 2, OFF)
        for i in range(3):
            reference = context.measures.spectral_peak[off, i, 0]
            row = [f"ours, {move_text(move, shaper)}: link {i + 1}", f"{reference:.3g}"]
            for links, _ in PLACES:
                on = context.measures.spectral_peak[context.find(move, shaper, 2, links), i, 0]
                row.append(f"{on:.3g} ({change(on, reference)})")
            rows.append([*row, residual(context, off, i)])
    return rows


def mode_2_rows(context: Context) -> list[list[str]]:
    """Spectral peaks of mode 2, per link."""
    rows = [["paper, three links", *(f"{value:+.2f} %" for value in MODE_2)]]
    for move, shaper in settings():
        off, on = (
            context.measures.spectral_peak[context.find(move, shaper, 2, links), :, 1]
            for links in (OFF, ALL)
        )
        cells = [f"{a:.3g} → {b:.3g} m²/Hz ({change(b, a)})" for a, b in zip(off, on, strict=True)]
        rows.append([f"ours, {move_text(move, shaper)}", *cells])
    return rows


def settling_rows(context: Context) -> list[list[str]]:
    """Settling times and residual vibration of each pair, with and without control."""

    def cells(k: int) -> list[str]:
        metrics = context.runs.result.metrics
        rms = metrics.residual_rms[k][:, middle_station(context.runs)]
        return [
            ", ".join(f"{1e3 * t:.0f}" for t in metrics.settling_time[k]),
            ", ".join(f"{1e3 * t:.0f}" for t in context.measures.settling[k]),
            ", ".join(f"{1e6 * r:.3g}" for r in rms),
            ", ".join(residual(context, k, i) for i in range(3)),
        ]

    return [
        [f"{text}: {control}", *cells(k)]
        for off, on, text in context.pairs()
        for k, control in ((off, "no control"), (on, "three links"))
    ]


def platform_rows(context: Context) -> list[list[str]]:
    """Platform errors of the late window, then of the whole one."""
    runs, measures = context.runs, context.measures
    error = np.hstack([measures.late_pose_error, runs.result.metrics.pose_error_rms])
    rows = []
    for move, shaper in settings():
        off = context.find(move, shaper, 3, OFF)
        is_hidden = np.all(measures.late_deflection[off] < runs.frame.adc_step)
        rows.append(
            [f"{move_text(move, shaper)}: no control", *(f"{1e9 * x:.3g}" for x in error[off])]
        )
        for links, text in PLACES:
            on = context.find(move, shaper, 3, links)
            pairs = zip(error[on], error[off], strict=True)
            cells = [f"{1e9 * x:.3g} ({change(x, y)})" for x, y in pairs]
            if is_hidden:
                cells[:3] = [f"{cell} †" for cell in cells[:3]]
            rows.append([f"{move_text(move, shaper)}: {text}", *cells])
    return rows


def design_rows(context: Context) -> list[list[str]]:
    """Controlled cases outside the grid, and those whose loop was judged."""
    runs, rows = context.runs, []
    for k, case in enumerate(runs.cases):
        if not case.is_controlled or not (case.is_extra or case.name in runs.loops):
            continue
        loop = runs.loops.get(case.name)
        margin, zeta = "not judged", "not judged"
        if loop is not None:
            margin = f"{loop.gain_margin:.3g}, {loop.spectral_radius:.5f}"
            zeta = ", ".join(f"{z:.3f}" for z in loop.damping_ratio.min(axis=1))
        rows.append(
            [
                f"`{case.name}`",
                case.feedback,
                case.estimator,
                f"{case.gain_factor:g}",
                case.ratio_from,
                describe(int(runs.status[k])),
                margin,
                zeta,
                context.drop(k, mode=1),
                f"{1e6 * context.measures.late_deflection[k].max():.3g}",
                f"{runs.result.metrics.peak_voltage[k].max():.3g}",
            ]
        )
    return rows
