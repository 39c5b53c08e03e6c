"""Figures of a tuning: the descent, the gain on each move, and the front."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxmodel.metrics import METRICS
from studies.show import figures
from studies.tuning.findings import TuneFindings, is_kept
from studies.tuning.optimise import excess
from studies.tuning.scenarios import move_label
from studies.tuning.spec import TuneSpec

GREY = "#999999"
OBJECTIVE = "objective (baseline: 1)"


def descent(spec: TuneSpec, findings: TuneFindings) -> Figure:
    """Best objective within the limits over iterations, machines of the tuning.

    Thin: each starting point, from the iteration on that first keeps the limits.
    """
    figure, ax = figures.one_panel(3.6)
    best = findings.at.least_so_far()
    iteration = np.arange(1, len(best) + 1)
    for k, family in enumerate(spec.moving):
        members = best[:, findings.at.family == k]
        color = figures.SERIES[k % len(figures.SERIES)]
        dash = figures.DASHES[(k // len(figures.SERIES)) % len(figures.DASHES)]
        ax.plot(iteration, members, color=color, linewidth=0.4, alpha=0.5)
        lowest = np.fmin.reduce(members, axis=1)
        ax.plot(iteration, lowest, color=color, linestyle=dash, linewidth=1.6, label=family.name)
    if not np.isfinite(best).any():
        ax.text(0.5, 0.5, "no design keeps the limits", ha="center", transform=ax.transAxes)
        ax.set_yticks([])
    ax.set(xlabel="iteration", ylabel=OBJECTIVE, xlim=(0.5, len(best) + 0.5))
    figures.log_scale(ax, "y")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside right upper")
    return figure


def gains(spec: TuneSpec, findings: TuneFindings) -> Figure:
    """Objective on each fresh machine, by move; line at 1: the baseline."""
    rows = len(spec.families)
    figure = Figure(figsize=(figures.WIDTH, 1.5 + 0.3 * rows), layout="constrained")
    axes = figure.subplots(1, len(spec.moves), squeeze=False, sharex=True, sharey=True)[0]
    count = spec.tune.scenarios.check
    for k, (ax, move) in enumerate(zip(axes, spec.moves, strict=True)):
        for row, design in enumerate(findings.judged):
            value = design.objective[k * count : (k + 1) * count]
            machine, mean = ("one fresh machine", "their mean") if row == 0 else (None, None)
            ax.plot(value, np.full(len(value), row), "|", color=GREY, markersize=9, label=machine)
            style = {"color": figures.SERIES[0], "markersize": 5, "zorder": 3}
            ax.plot(value.mean(), row, "d", label=mean, **style)
        ax.axvline(1.0, color="black", linewidth=0.8, label="baseline" if k == 0 else None)
        ax.set(xlabel=OBJECTIVE, title=move_label(move), ylim=(rows - 0.4, -0.6))
        figures.log_scale(ax, "x")
    axes[0].set_yticks(range(rows), [family.name for family in spec.families])
    figures.legend_above(figure, axes[0])
    return figure


def front(spec: TuneSpec, findings: TuneFindings, limit: str) -> Figure:
    """Objective over a limited metric: random designs, if there are any, tuned ones, the baseline.

    Args:
        spec: of the tuning.
        findings: what it found.
        limit: metric along the abscissa, one of `spec.metric_limits`.
    """
    figure, ax = figures.one_panel(4.2)
    column = spec.metric_limits.index(limit)
    if findings.searched is not None:
        search, kept = findings.searched, is_kept(spec, findings.searched)
        for chosen, color, label in (
            (np.isfinite(search.objective) & ~kept, "#CCCCCC", "random, a limit violated"),
            (kept, figures.SERIES[0], "random, all limits satisfied"),
        ):
            if chosen.any():
                x, y = search.peaks[chosen, column], search.objective[chosen]
                ax.scatter(x, y, s=5, color=color, linewidths=0, label=label, rasterized=True)
    at = findings.at
    done = np.isfinite(at.best_objective) & (excess(at.best_limits) == 0)
    x, y = at.best_peaks[done, column], at.best_objective[done]
    label = "every starting point, machines of the tuning"
    ax.plot(x, y, "x", color=figures.SERIES[1], markersize=4, label=label)
    points = [(x.metrics[limit].max(), x.objective.mean()) for x in findings.judged]
    line = np.array([p for p, family in zip(points, spec.families, strict=True) if family.front])
    if len(line):
        line = line[np.argsort(line[:, 0])]
        label = "Pareto front, on fresh machines"
        ax.plot(*line.T, "o-", markersize=4, color=figures.SERIES[2], label=label)
    marks = iter("^vD*P<>")
    baseline = findings.baseline.metrics[limit].max(), findings.baseline.objective.mean()
    ax.plot(*baseline, "s", color="black", label="baseline")
    for point, family in zip(points, spec.families, strict=True):
        if not family.front:
            mark, label = next(marks, "h"), f"{family.name}, fresh machines"
            ax.plot(*point, mark, color="black", markerfacecolor="white", zorder=3, label=label)
    limits = {family.limits.get(limit) for family in spec.moving if not family.front}
    for value in sorted(x for x in limits if isinstance(x, float)):
        ax.axvline(value, color="black", linewidth=0.8, linestyle=":", label="limit")
    ax.set(xlabel=_label(limit), ylabel=OBJECTIVE)
    figures.log_scale(ax, "y")
    figure.legend(loc="outside right upper")
    return figure


def _label(metric: str) -> str:
    metric_field = METRICS[metric.partition("[")[0]]
    return f"{metric_field.text} [{metric_field.unit}]"
