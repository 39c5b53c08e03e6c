"""Figures of the card."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from studies.papers.rrr_2016.claims import DECIDING
from studies.papers.rrr_2016.coupling import DEFINITIONS, law
from studies.papers.rrr_2016.findings import LEVELS, Kind
from studies.papers.rrr_2016.machines import OMEGA
from studies.papers.rrr_2016.maps import LINK_MASS, NEAR_MASS, PLATFORM_MASS, DampingMap
from studies.papers.rrr_2016.thresholds import DAMPING, QUANTILES, moving_quantile
from studies.show import figures

DOTS, BAND = "#BBBBBB", figures.SERIES[0]


def coupling(kinds: dict[str, Kind]) -> Figure:
    """Reduction of the others over the coupling ratio, machines, quantiles and law."""
    figure, axes = figures.new_figure(1, len(kinds), 2.8)
    for ax, (name, kind) in zip(axes[0], kinds.items(), strict=True):
        sampled = kind.sampled
        reduction = 100 * sampled.reduction[DECIDING]
        ax.plot(sampled.ratio, reduction, ".", color=DOTS, markersize=1.5, label="machines")
        curves = [moving_quantile(sampled.ratio, reduction, q) for q in QUANTILES]
        (at, top), (_, middle), (_, low) = curves
        ax.fill_between(at, low, top, color=BAND, alpha=0.2, linewidth=0, label="90 % of them")
        ax.plot(at, middle, color=BAND, label="half of them")
        ratio = np.linspace(0, sampled.ratio.max(), 100)
        ax.plot(ratio, 100 * law(ratio), "--", color=figures.SERIES[1], label="1 - 1/√(1 + ρ²)")
        base = kind.baseline
        ax.plot(base.ratio, 100 * base.others, "x", color="#000000", label="baseline, all poses")
        ax.axhline(100 * LEVELS[0], color="#888888", linewidth=0.8, linestyle=":")
        ax.set(xlim=(0, ratio[-1]), ylim=(-5, 50), title=name)
        ax.set_xlabel("coupling ratio [1]")
        ax.set_ylabel("reduction of the others [%]")
    figures.legend_above(figure, axes[0, 0])
    return figure


def maps(kinds: dict[str, Kind]) -> Figure:
    """Damping below which one controlled link calms the others, at the most favourable pose."""
    figure, axes = figures.new_figure(len(kinds), 2, 2.4)
    for row, (name, kind) in zip(axes, kinds.items(), strict=True):
        for ax, (text, chart) in zip(
            row, (("strong control", kind.strong), ("best control", kind.best)), strict=True
        ):
            image = _map(ax, chart)
            ax.set_title(f"{name}, {text}")
            ax.set_ylabel("platform over link mass [1]")
            if name == list(kinds)[-1]:
                ax.set_xlabel("drive over link frequency [1]")
    figure.colorbar(image, ax=axes, label="damping ratio [1]")
    return figure


def _map(ax: Axes, chart: DampingMap) -> Any:
    greatest = np.nanmax(chart.damping, axis=-1).T
    image = ax.pcolormesh(
        chart.drive_ratio,
        chart.mass_ratio,
        np.where(greatest > 0, greatest, np.nan),
        norm=LogNorm(DAMPING[0], 0.03),
        cmap="Blues",
        shading="nearest",
    )
    base = np.sqrt(2e4 / NEAR_MASS) / OMEGA, PLATFORM_MASS / LINK_MASS
    ax.plot(*base, "x", color=figures.SERIES[1])
    for which in "xy":
        figures.log_scale(ax, which)
    return image


def definitions(kinds: dict[str, Kind]) -> Figure:
    """Coupling ratios at which the deciding reduction is reached, by what "calms" means."""
    figure, ax = figures.one_panel(2.6)
    for k, (name, kind) in enumerate(kinds.items()):
        for place, definition in enumerate(DEFINITIONS):
            found = kind.sampled.thresholds[definition][0]
            y, color = place + 0.15 * (2 * k - 1), figures.SERIES[k]
            end = found.high if np.isfinite(found.high) else kind.sampled.ratio.max()
            ax.plot([found.low, end], [y, y], color=color, linewidth=1.2)
            ax.plot(found.middle, y, "o", color=color, label=name if place == 0 else None)
    ax.set_yticks(range(len(DEFINITIONS)), list(DEFINITIONS))
    ax.invert_yaxis()
    ax.set_xlabel(f"coupling ratio at which {100 * LEVELS[0]:g} % are reached [1]")
    figures.legend_above(figure, ax)
    return figure
