"""Figures of designs of which some are kept: how the metric is distributed, by axes as well."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from jaxmodel.metrics import METRICS
from studies.engine.results import SweepData
from studies.results.labelled import Variable
from studies.screen.run import ScreenOutcome, chosen
from studies.screen.shards import ScreenRequest
from studies.screen.tally import BUCKETS, GROWTH, LEAST, quantile
from studies.show import figures
from studies.show.units import headed, readable
from studies.study.paths import field_unit
from studies.sweeps.show import unit_of_metric

#: Panels side by side.
ACROSS = 3
#: Shares of the designs in an interval, counted from the best: the curves.
CURVES = ((0.5, "median"), (0.1, "best 10 %"), (0.001, "best 0.1 %"))
#: Values of an axis that are all marked.
FEW = 6
#: Ratio of the ends from which on an axis is drawn on a log scale.
WIDE = 20


def described(screen: ScreenRequest) -> SweepData:
    """What a screen ranks by, as a sweep without values tells of it."""
    metric = METRICS[screen.metric]
    variable = Variable(np.empty(0), ("case", *metric.dims), metric.unit, metric.text)
    return SweepData({screen.metric: variable}, {}, screen.spec)


def entry_unit(screen: ScreenRequest) -> str:
    """Unit of what the designs are ranked by."""
    return unit_of_metric(described(screen), screen.entry)


def values(done: ScreenOutcome, uncontrolled: float | None) -> Figure:
    """Designs that ended well by value, unstable ones included.

    Line: the last one that was kept; dashed: the baseline without control, if it was run.

    Args:
        done: how the screen ended.
        uncontrolled: what the designs are ranked by without control; None: not known.
    """
    counts = done.tally.sketch[0]
    unit = entry_unit(done.screen)
    factor = readable(unit)[0]
    seen = np.flatnonzero(counts)
    edges = factor * LEAST * GROWTH ** np.arange(BUCKETS + 1)
    figure, axes = figures.one_panel(2.6)
    part = slice(seen[0], seen[-1] + 1)
    axes.stairs(
        counts[part], edges[seen[0] : seen[-1] + 2], fill=True, color=figures.SERIES[0], alpha=0.6
    )
    for value, color, style in (
        (chosen(done).kept_value[-1], figures.SERIES[1], "-"),
        (uncontrolled, figures.SERIES[4], "--"),
    ):
        if value is not None:
            at = factor * np.clip(value, LEAST, LEAST * GROWTH**BUCKETS)
            axes.axvline(at, color=color, linestyle=style, lw=1.2)
    axes.set(xlabel=headed(done.screen.entry, unit), ylabel="designs")
    figures.log_scale(axes, "x")
    if counts[part].max() > 100:
        axes.set_yscale("log")
    return figure


def axis_head(name: str) -> str:
    """An axis with its unit."""
    unit = field_unit(name.partition("[")[0])
    return name if unit == "1" else f"{name} [{unit}]"


def influence(done: ScreenOutcome) -> Figure:
    """Values of the designs that ended well by interval of every axis, unstable ones included.

    The median and, of enough designs, the best 10 % and the best 0.1 %. Where few end well, they
    differ in more than this axis.
    """
    screen = done.screen
    unit = entry_unit(screen)
    factor = readable(unit)[0]
    is_largest = screen.ranking[1]
    count = len(screen.axes.names)
    figure, axes = figures.new_figure(-(-count // ACROSS), min(count, ACROSS), 1.9, False)
    panels = list(axes.flat)
    most = max(len(centers) for centers in screen.axes.centers)
    total = done.tally.sketch[0].sum()
    # a share of less than one design an interval is the best one there, whatever its name
    curves = [curve for curve in CURVES if curve[0] * total >= most] or CURVES[:1]
    for ax in panels[len(screen.axes.names) :]:
        ax.set_visible(False)
    for k, (ax, name) in enumerate(zip(panels, screen.axes.names, strict=False)):
        part = done.tally.sketch[screen.axes.part(k)]
        centers, labels = screen.axes.centers[k], screen.axes.labels[k]
        style = "o" if len(labels) else "-"
        for (share, text), color in zip(curves, figures.SERIES, strict=False):
            at = 1 - share if is_largest else share
            curve = [
                factor * quantile(counts, at, is_smooth=True)
                if share * counts.sum() >= 1
                else np.nan
                for counts in part
            ]
            ax.plot(centers, curve, style, color=color, lw=1.2, label=text)
        ax.set_xlabel(axis_head(name).replace(" [", "\n[", 1))
        if len(labels):
            ax.set_xticks(centers, labels)
            ax.margins(x=0.2)
        elif centers[0] > 0 and centers[-1] > WIDE * centers[0]:
            figures.log_scale(ax, "x")
        elif len(centers) <= FEW:
            ax.set_xticks(centers)
        figures.log_scale(ax, "y")
    panels[0].set_ylabel(headed(screen.entry.replace("[", "\n[", 1), unit))
    figures.legend_above(figure, panels[0])
    return figure
