"""Figures of a spillover certificate."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from studies.show import figures
from studies.spillover.certificate import Certificate

#: Spillover above this has its own colour [1].
FLOOR = 0.01
#: Smaller margins are drawn as this [1].
LEAST = 0.01


def _plain_ticks(axis: Axis) -> None:
    """Plain numbers on a logarithmic axis, few enough to read."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _has_departures(certificate: Certificate) -> bool:
    """Whether plants of the same basis and size differ."""
    return certificate.variants.shape[1] > 1


def margins(certificate: Certificate, ax: Axes | None = None) -> Axes:
    """Gain margin of every plant: filled of the largest ones, hollow of the smallest.

    Args:
        certificate: from `certify`.
        ax: where to draw; default: a new figure.
    """
    ax = figures.axes_or_new(ax)
    sizes = certificate.plant_modes
    shown = np.flatnonzero(certificate.exists.any(axis=(0, 2)))[::-1]  # the first one on top
    values = np.maximum(certificate.gain_margin, LEAST)
    for b, color, marker in zip(range(len(values)), figures.SERIES, "osD", strict=False):
        if not certificate.exists[b].any():
            continue
        at = np.arange(len(shown)) + 0.2 * (b - (len(values) - 1) / 2)
        style: dict[str, Any] = {"color": color, "marker": marker, "linestyle": "none"}
        basis = str(certificate.basis[b])
        ax.plot(values[b, shown, -1], at, markersize=4, label=basis, **style)
        if len(sizes) > 1:
            ax.plot(values[b, shown, 0], at, markersize=7, markerfacecolor="none", **style)
    for place, text in ((certificate.required_margin, "required"), (1.0, "unstable")):
        ax.axvline(place, color="black", linewidth=0.9, linestyle="--" if place > 1 else "-")
        ax.annotate(
            text,
            (place, 1),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=figures.SMALL,
        )
    ax.set_yticks(np.arange(len(shown)), certificate.mismatch[shown])
    ax.set(xlabel="gain margin [1]", xscale="log", ylim=(-0.6, len(shown) - 0.4))
    ax.tick_params(axis="y", labelsize=figures.SMALL)
    _plain_ticks(ax.xaxis)
    hollow = f"\nhollow: {sizes[0]}" if len(sizes) > 1 else ""
    figures.legend_beside(ax, title=f"{sizes[-1]} plant modes{hollow}")
    return ax


def mode_damping(certificate: Certificate, ax: Axes | None = None) -> Axes:
    """Damping ratio over frequency of every link mode at the design's gains, largest plants.

    Args:
        certificate: from `certify`.
        ax: where to draw; default: a new figure.
    """
    ax = figures.axes_or_new(ax)
    frequency, zeta = certificate.frequency[:, :, -1], certificate.damping_ratio[:, :, -1]
    for b, color, marker in zip(range(len(frequency)), figures.SERIES, "osD^v", strict=False):
        if np.all(np.isnan(zeta[b])):
            continue
        ax.plot(
            frequency[b].ravel(),
            zeta[b].ravel(),
            marker,
            color=color,
            markersize=3,
            alpha=0.6,
            markeredgewidth=0,
            label=certificate.basis[b],
        )
    ax.plot(
        frequency.ravel(),
        certificate.free_damping_ratio[:, :, -1].ravel(),
        "_",
        color="black",
        markersize=4,
        label="without control",
    )
    ax.set_xscale("log")
    ax.set_yscale("symlog", linthresh=0.02, linscale=1.5)
    ax.set_ylim(1.3 * min(np.nanmin(zeta), -0.001), 1.3 * np.nanmax(zeta))
    if np.nanmin(zeta) < 0:
        ax.axhline(0, color="black", linewidth=0.9)
        ax.annotate("unstable", (0.02, 0.02), xycoords="axes fraction", fontsize=figures.SMALL)
        ax.axhspan(ax.get_ylim()[0], 0, color=figures.SERIES[1], alpha=0.1, linewidth=0)
    low, high = ax.get_ylim()
    sizes = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    ticks = [*(-tick for tick in sizes), 0.0, *sizes]
    ax.set_yticks([tick for tick in ticks if low <= tick <= high])
    ax.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    _plain_ticks(ax.xaxis)
    size = int(certificate.plant_modes[-1])
    which = ", all mismatches" if _has_departures(certificate) else ""
    ax.set(
        xlabel=f"frequency [Hz], plants of {size} modes a link{which}",
        ylabel="damping ratio [1]",
    )
    figures.legend_beside(ax)
    return ax


def leakage_map(
    factor: np.ndarray, n_controlled: int, title: str = "", ax: Axes | None = None
) -> Axes:
    """What each plant mode adds to each estimated mode.

    Args:
        factor: size of the leakage [1], (C, R).
        n_controlled: how many modes, the first ones, are meant to be seen.
        title: of the panel.
        ax: where to draw; default: a new figure.
    """
    ax = figures.axes_or_new(ax)
    channels, modes = factor.shape
    shown = np.where(factor >= FLOOR, factor, np.nan)
    edges = [np.arange(n + 1) + 0.5 for n in (modes, channels)]
    ax.pcolormesh(*edges, shown, cmap="YlOrBr", norm=LogNorm(FLOOR, 100.0), rasterized=True)
    for (j, r), value in np.ndenumerate(factor):
        text = f"{value:.2g}" if value >= FLOOR else "·"
        color = "white" if value > 10 else "black"
        ax.text(r + 1, j + 1, text, ha="center", va="center", fontsize=figures.SMALL, color=color)
    ax.axvline(n_controlled + 0.5, color="black", linewidth=1.2)
    ax.grid(False)
    ax.invert_yaxis()
    ax.set_xticks(range(1, modes + 1))
    ax.set_yticks(range(1, channels + 1), [str(j + 1) for j in range(channels)])
    ax.set_ylabel("estimate")
    ax.set_xlabel("plant mode [1]")
    ax.set_title(title, loc="left")
    return ax


def leakage(certificate: Certificate) -> Figure:
    """Observation spillover: what plant modes add to the estimates, at most."""
    size = np.abs(certificate.observation)
    bases = [b for b in range(len(size)) if not np.all(np.isnan(size[b]))]
    with figures.styled():
        figure, axes = figures.new_figure(len(bases), 1, 0.55 + 0.28 * size.shape[3])
        for b, ax in zip(bases, axes[:, 0], strict=True):
            name = certificate.basis[b]
            leakage_map(np.nanmax(size[b], axis=(0, 1)), certificate.n_controlled, name, ax)
        for ax in axes[:-1, 0]:
            ax.set_xlabel("")
    return figure
