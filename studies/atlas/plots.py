"""Figures of the atlas. Each function only draws given data, after converting units."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from scipy.ndimage import distance_transform_edt

from studies.atlas.subsets import CHOICES, link_label
from studies.atlas.workspace import Map
from studies.show.figures import CONTROLLED, SERIES, SMALL, WITHOUT, axes_or_new

#: Changes: blue is less vibration, orange is more.
CHANGES = "PuOr_r"
#: No link, one, two and three of them controlled.
SET_STYLES: tuple[dict[str, Any], ...] = (
    WITHOUT,
    {"color": SERIES[2], "linewidth": 1.2},
    {"color": SERIES[3], "linewidth": 1.2},
    CONTROLLED,
)
BETTER, WORSE = "#4C3F91", "#D9730D"


def length_text(value: float) -> str:
    """A small length [m] in µm."""
    return f"{1e6 * value:.3g} µm"


def _signed(value: float, sign: str = "+") -> str:
    """A whole number with its sign; no sign at zero."""
    text = f"{value:{sign}.0f}"
    return "0" if text in ("+0", "-0") else text


def change_map(
    change: np.ndarray, rows: list[str], columns: list[str], ax: Axes | None = None
) -> Any:
    """Changes as a map of numbers.

    Args:
        change: relative change [1], (rows, columns).
        rows, columns: their names.
        ax: where to draw; default: a new figure.

    Returns:
        The image, for a colour bar.
    """
    ax = axes_or_new(ax)
    norm = TwoSlopeNorm(0, -100, 100)
    image = ax.imshow(100 * change, cmap=CHANGES, norm=norm, aspect="auto")
    for (row, column), value in np.ndenumerate(100 * change):
        is_dark = abs(value) > 50
        ax.text(
            column,
            row,
            _signed(value),
            ha="center",
            va="center",
            fontsize=SMALL,
            color="white" if is_dark else "black",
        )
    ax.set_xticks(range(len(columns)), columns)
    ax.set_yticks(range(len(rows)), rows)
    ax.tick_params(length=0)
    ax.grid(False)
    return image


def lattice(residual: np.ndarray, ax: Axes | None = None) -> Axes:
    """The 8 choices of links, each joined to those with one more link.

    Args:
        residual: of each choice, bit i is link i [m], (8,).
        ax: where to draw; default: a new figure.
    """
    ax = axes_or_new(ax)
    place = {
        0: (0, 1),
        1: (1, 2),
        2: (1, 1),
        4: (1, 0),
        3: (2, 2),
        5: (2, 1),
        6: (2, 0),
        7: (3, 1),
    }
    for a in CHOICES:
        for b in (a | 1 << i for i in range(3) if not a >> i & 1):
            is_better = residual[b] <= residual[a]
            ax.plot(
                *zip(place[a], place[b], strict=True),
                color=BETTER if is_better else WORSE,
                linestyle="-" if is_better else "--",
                linewidth=1.6,
                zorder=0,
            )
    for subset, (x, y) in place.items():
        ax.text(
            x,
            y,
            f"{link_label(subset)}\n{length_text(residual[subset])}",
            ha="center",
            va="center",
            fontsize=SMALL,
            bbox={"boxstyle": "round", "fc": "white", "ec": "#888888"},
        )
    ax.set_xlim(-0.5, 3.5)
    ax.set_ylim(-0.5, 2.5)
    ax.set_xticks(range(4), ["no link", "one", "two", "three"])
    ax.set_yticks([])
    ax.grid(False)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    return ax


def share_map(
    share: np.ndarray, rows: list[str], columns: list[str], ax: Axes | None = None
) -> None:
    """Shapley shares, or interactions, as a map of numbers: blue removes vibration.

    Args:
        share: of the mean square without control [1], (rows, columns).
        rows, columns: their names.
        ax: where to draw; default: a new figure.
    """
    ax = axes_or_new(ax)
    change_map(-share, rows, columns, ax)
    for text, value in zip(ax.texts, 100 * share.ravel(), strict=True):
        text.set_text(_signed(value, "-"))


def interaction_map(
    index: np.ndarray, labels: list[str], limit: float, ax: Axes | None = None
) -> Any:
    """Interaction of pairs of players.

    Args:
        index: share of the mean square without control [1], (n, n), symmetric.
        labels: of the players.
        limit: value of the full colour [1].
        ax: where to draw; default: a new figure.

    Returns:
        The image, for a colour bar.
    """
    ax = axes_or_new(ax)
    norm = TwoSlopeNorm(0, -100 * limit, 100 * limit)
    image = ax.imshow(100 * index, cmap=CHANGES.removesuffix("_r"), norm=norm)
    ax.set_xticks(range(len(labels)), labels, rotation=90, fontsize=SMALL)
    ax.set_yticks(range(len(labels)), labels, fontsize=SMALL)
    ax.grid(False)
    ax.tick_params(length=0)
    return image


def workspace_map(
    chart: Map,
    turn: int,
    value: np.ndarray,
    path: np.ndarray | None = None,
    ax: Axes | None = None,
    limits: tuple[float, float] | None = None,
) -> Any:
    """A quantity over the reachable poses.

    Args:
        chart: from `map_workspace`.
        turn: which of its orientations.
        value: in the unit of the colour bar; NaN out of reach, (y, x).
        path: of the platform [m], (k, 2), or None.
        ax: where to draw; default: a new figure.
        limits: of the colours.

    Returns:
        The image, for a colour bar.
    """
    ax = axes_or_new(ax)
    low, high = limits or (float(np.nanmin(value)), float(np.nanmax(value)))
    x, y, margin = 1e3 * chart.x, 1e3 * chart.y, chart.squared_margin[turn]
    # colours run on over the border, where white covers them: it is smooth, the grid is not
    nearest = distance_transform_edt(np.isnan(value), return_distances=False, return_indices=True)
    colors: dict[str, Any] = {"cmap": "cividis", "vmin": low, "vmax": high}
    image = ax.pcolormesh(x, y, value[tuple(nearest)], shading="gouraud", rasterized=True, **colors)
    # an extra grid line around the map closes the border where poses reach the map's edge
    around = [np.pad(line, 1, mode="reflect", reflect_type="odd") for line in (x, y)]
    whole = np.pad(margin, 1, constant_values=margin.min())
    ax.contourf(*around, whole, [whole.min() - 1, 0.0], colors="white")
    ax.contour(*around, whole, [0.0], colors="#D55E00", linewidths=1.5)
    angles = (10, 20)
    lines = ax.contour(x, y, margin, np.radians(angles) ** 2, colors="white", linewidths=0.7)
    texts = {level: f"{angle}°" for level, angle in zip(lines.levels, angles, strict=True)}
    ax.clabel(lines, fmt=texts, fontsize=SMALL)
    if path is not None:
        ax.plot(*(1e3 * path.T), color="black", linewidth=1.2)
    ax.set_aspect("equal")
    ax.grid(False)
    return image


def response(
    frequency: np.ndarray, curves: dict[str, np.ndarray], label: str, ax: Axes | None = None
) -> Axes:
    """Magnitudes of frequency responses.

    Args:
        frequency: [Hz], (F,).
        curves: magnitudes in the unit of the label by name, (F,) each.
        label: quantity and unit of the ordinate.
        ax: where to draw; default: a new figure.
    """
    ax = axes_or_new(ax)
    for (name, curve), style in zip(curves.items(), SET_STYLES, strict=False):
        ax.semilogy(frequency, curve, **{**style, "label": name})
    ax.set_ylabel(label)
    ax.margins(x=0.01)
    return ax
