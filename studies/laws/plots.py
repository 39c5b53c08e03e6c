"""Figures of a comparison: residual vibration and how sure the order is; laws against drives."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from studies.laws.findings import LawFindings
from studies.laws.judging import FIGURES
from studies.laws.ranking import geometric_mean
from studies.show import figures
from studies.show.units import readable

#: Rows of a figure at most; the table has them all.
MOST = 12
#: Of the moves, the fastest first.
SHADES = ("#08306B", "#2171B5", "#6BAED6")


def comparison(findings: LawFindings) -> Figure:
    """The best controllers.

    Left: residual vibration on every machine and in every move (darker: faster), the geometric mean
    marked. Right: ratio to the best controller by each figure, with the interval that other
    machines of the same spread could have shown.

    Args:
        findings: of the comparison.
    """
    ranking, rows = findings.ranking, findings.competing
    order = [k for k in ranking.order if np.isfinite(ranking.ratio[k])][:MOST][::-1]  # best on top
    figure, axes = figures.new_figure(1, 2, max(1.6, 0.3 * len(order) + 0.6), False)
    left, right = axes[0]
    names = [findings.name(k) for k in order]
    factor, unit = readable("m")
    values = factor * findings.judged.metrics["residual_rms"]
    for y, k in enumerate(order):
        for cloud, shade in zip(values[rows[k]].T, SHADES, strict=True):
            left.plot(cloud, np.full(cloud.size, y), "o", markersize=2.5, alpha=0.6, color=shade)
        left.plot(
            geometric_mean(values[rows[k]]),
            y,
            "|",
            markersize=12,
            markeredgewidth=2,
            color="#000000",
        )
    figures.log_scale(left, "x")
    left.set_yticks(range(len(order)), names)
    left.set_xlabel(f"residual rms [{unit}]; darker: faster move")
    for place, (metric, color) in enumerate(zip(FIGURES, figures.SERIES, strict=False)):
        one = findings.rankings[metric]
        at = np.arange(len(order)) - 0.16 * (place - (len(FIGURES) - 1) / 2)
        middle, low, high = (x[order] for x in (one.ratio, one.low, one.high))
        right.errorbar(
            middle,
            at,
            xerr=np.maximum([middle - low, high - middle], 0.0),
            fmt="o",
            markersize=3,
            color=color,
            elinewidth=1,
            label=FIGURES[metric],
        )
    right.axvline(1.0, color="#666666", linewidth=0.8)
    figures.log_scale(right, "x")
    right.set_yticks(range(len(order)), [])
    right.set_xlabel("ratio to the best by each figure [1]")
    for ax in (left, right):
        ax.set_ylim(-0.6, len(order) - 0.4)
    figures.legend_above(figure, right)
    return figure


def grid(findings: LawFindings) -> Figure:
    """Every tuned law (rows) with every tuned drive (columns).

    Geometric means over all machines and moves. A dash: it does not keep the budget.

    Args:
        findings: of the comparison.
    """
    entries = findings.controllers
    laws = list(dict.fromkeys(entry.law for entry in entries if entry.law))
    drives = list(dict.fromkeys(entry.drive for entry in entries if entry.drive))
    figure, axes = figures.new_figure(1, 2, max(1.6, 0.3 * len(laws) + 0.8), False)
    factor, unit = readable("m")
    titles = {"residual_rms": "mean residual rms", "pose_error_peak": "mean platform error"}
    for ax, (metric, title) in zip(axes[0], titles.items(), strict=True):
        values = np.full((len(laws), len(drives)), np.nan)
        for k, controller in enumerate(findings.controllers):
            if controller.law and not controller.reason:
                place = laws.index(controller.law), drives.index(controller.drive)
                values[place] = factor * geometric_mean(findings.judged.metrics[metric][k])
        if np.isfinite(values).any():
            ax.imshow(values, norm=LogNorm(), cmap="Blues", alpha=0.5, aspect="auto")
        for i, row in enumerate(values):
            for j, value in enumerate(row):
                text = f"{value:.3g}" if np.isfinite(value) else "-"
                ax.text(j, i, text, ha="center", va="center", fontsize=figures.SMALL)
        ax.set_xticks(range(len(drives)), drives, rotation=25, ha="right")
        ax.set_yticks(range(len(laws)), laws if metric == "residual_rms" else [])
        ax.set_title(f"{title} [{unit}]")
        ax.grid(False)
    return figure
