"""The figure of a comparison: residual vibration, and how sure the order is."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from studies.laws.findings import LawFindings
from studies.laws.judging import FIGURES
from studies.show import figures
from studies.show.units import readable


def comparison(findings: LawFindings) -> Figure:
    """Residual vibration of each controller on all machines, with the interval of its ratio.

    Left: every machine and move, median marked. Right: the ratio to the best controller with its
    95 % interval, by each figure.

    Args:
        findings: of the comparison.
    """
    ranking, rows = findings.ranking, findings.competing
    order = [k for k in ranking.order if np.isfinite(ranking.ratio[k])][::-1]  # the best on top
    figure, axes = figures.new_figure(1, 2, max(1.6, 0.34 * len(order) + 0.6), False)
    left, right = axes[0]
    names = [findings.name(k) for k in order]
    factor, unit = readable("m")
    values = factor * findings.judged.metrics["residual_rms"]
    for y, k in enumerate(order):
        cloud = np.ravel(values[rows[k]])
        left.plot(cloud, np.full(cloud.size, y), "o", markersize=2.5, alpha=0.5, color="#0072B2")
        left.plot(np.median(cloud), y, "|", markersize=12, markeredgewidth=2, color="#000000")
    left.set_xscale("log")
    left.set_yticks(range(len(order)), names)
    left.set_xlabel(f"residual rms, every machine and move [{unit}]")
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
    right.set_xscale("log")
    right.set_yticks(range(len(order)), [])
    right.set_xlabel("over that of the best controller by this figure [1]")
    figures.legend_above(figure, right)
    return figure
