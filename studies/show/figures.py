"""Plots of the studies, in one style. Each takes data in SI units and optional axes.

They only convert units. The colours of Okabe and Ito are distinguishable for colour-blind readers;
in greyscale, the two curves of a comparison differ in lightness and width.

A page shows a figure of `WIDTH` 54 rem wide, and on a phone 40 rem wide in a box that
scrolls, where text of `SMALL` has 9.6 pixels: no figure has smaller text or is wider.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from studies.errors import FigureWarning, StudyError
from studies.publish import FAULT, replacing

WITHOUT: dict[str, Any] = {"color": "#E69F00", "linewidth": 1.6, "label": "without control"}
CONTROLLED: dict[str, Any] = {"color": "#0B3C6F", "linewidth": 0.8, "label": "with control"}
#: Width of a figure [inch], and its smallest text [pt].
WIDTH, SMALL = 7.4, 8.0
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000")
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))

STYLE: dict[str, Any] = {
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.labelsize": 8.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": SMALL,
    "lines.solid_joinstyle": "round",
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "path.simplify_threshold": 0.5,
}


def styled() -> Any:
    """Context in which figures of this project are created and saved."""
    return matplotlib.rc_context(STYLE)  # type: ignore[arg-type]


def new_figure(
    rows: int, columns: int, row_height: float = 1.9, has_shared_abscissa: bool = True
) -> tuple[Figure, np.ndarray]:
    """Figure of the printed page's width with its axes, (rows, columns); row_height in inches."""
    figure = Figure(figsize=(WIDTH, 0.75 + row_height * rows), layout="constrained")
    axes = figure.subplots(
        rows, columns, squeeze=False, sharex="col" if has_shared_abscissa else "none"
    )
    return figure, axes


def one_panel(height: float) -> tuple[Figure, Axes]:
    """Figure of the printed page's width with one pair of axes; height in inches."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots()


def legend_above(figure: Figure, *axes: Axes) -> None:
    """One legend for the whole figure, with the entries of these axes."""
    entries = [ax.get_legend_handles_labels() for ax in axes]
    handles = [handle for some, _ in entries for handle in some]
    labels = [label for _, some in entries for label in some]
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def legend_beside(ax: Axes, **style: Any) -> None:
    """The legend of `ax` to the right of it, where it covers nothing."""
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0, **style)


def draw(folder: Path, drawings: Mapping[str, Callable[[], Figure]], has_pdf: bool = False) -> None:
    """Write figures by name; one that cannot be drawn costs no result: its page says why.

    Raises:
        StudyError: a file cannot be written.
    """
    with styled():
        for name, drawing in drawings.items():
            try:
                save(drawing(), folder, name, has_pdf)
            except StudyError:
                raise
            except Exception as error:  # whatever Matplotlib makes of unforeseen numbers
                text = f"The figure {name} could not be drawn: {error or type(error).__name__}."
                warnings.warn(text, FigureWarning, stacklevel=2)
                (folder / f"{name}{FAULT}").write_text(text, encoding="utf-8")


def save(figure: Figure, folder: Path, name: str, has_pdf: bool = False) -> None:
    """Write the figure as PNG, and as PDF if wanted, whole or not at all.

    Raises:
        StudyError: that fails.
    """
    write_figure(figure, folder / f"{name}.png")
    if has_pdf:
        figure.set_layout_engine("none")  # keeps the layout, which takes half a second
        write_figure(figure, folder / f"{name}.pdf")


def write_figure(figure: Figure, path: Path) -> None:
    """Write the figure in the format of its file extension; errors as `save`."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], dpi=STYLE["savefig.dpi"])


def log_scale(ax: Axes, which: str) -> None:
    """Make an axis, "x" or "y", logarithmic, with plain numbers, few enough to read.

    One without positive values stays as it is.
    """
    if not np.isfinite(getattr(ax.dataLim, f"minpos{which}")):
        return
    ax.set(**{f"{which}scale": "log"})
    axis = ax.xaxis if which == "x" else ax.yaxis
    low, high = sorted(axis.get_view_interval())
    decades = np.log10(high / low)
    if decades < 0.6:
        axis.set_major_locator(MaxNLocator(6))
    elif decades < 4:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2.5 else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.3g}"))
    axis.set_minor_formatter(NullFormatter())


def is_wide(values: np.ndarray) -> bool:
    """Whether numbers need a logarithmic scale."""
    known = values[np.isfinite(values)]
    return bool(known.size and np.all(known > 0) and known.max() > 30 * known.min())


def axes_or_new(ax: Axes | None) -> Axes:
    """The axes to draw on: those given, or new ones."""
    return plt.subplots(layout="constrained")[1] if ax is None else ax


def traces(
    time: np.ndarray, values: np.ndarray, names: list[str], label: str, ax: Axes | None = None
) -> Axes:
    """Several quantities of one kind over time.

    Args:
        time: [s], (T,).
        values: in the unit of the label, (T, n).
        names: of the quantities, for a legend; [] for none.
        label: quantity and unit of the ordinate.
        ax: where to draw; default: a new figure.
    """
    ax = axes_or_new(ax)
    for k, curve in enumerate(values.T):
        ax.plot(
            time,
            curve,
            color=SERIES[k % len(SERIES)],
            linestyle=DASHES[k % len(DASHES)],
            linewidth=0.9,
            label=names[k] if names else None,
        )
    ax.set_ylabel(label)
    ax.margins(x=0.01)
    return ax


def comparison(
    time: np.ndarray,
    without: np.ndarray,
    controlled: np.ndarray,
    label: str,
    ax: Axes | None = None,
) -> Axes:
    """Two responses over time.

    Args:
        time: [s], (T,).
        without: response without control, in the unit of the label, (T,).
        controlled: the same with control, (T,).
        label: quantity and unit of the ordinate.
        ax: where to draw; default: a new figure.
    """
    ax = axes_or_new(ax)
    ax.plot(time, without, **WITHOUT)
    ax.plot(time, controlled, **CONTROLLED)
    ax.set_ylabel(label)
    ax.margins(x=0.01)
    return ax


def spectrum(
    frequency: np.ndarray,
    without: np.ndarray,
    controlled: np.ndarray | None,
    mode_hz: float,
    label: str,
    ax: Axes | None = None,
) -> Axes:
    """Power spectral density of a mode.

    Args:
        frequency: [Hz], (F,).
        without: without control [m2/Hz], (F,).
        controlled: with control [m2/Hz], (F,); None to leave it out.
        mode_hz: frequency to mark [Hz].
        label: quantity and unit of the ordinate.
        ax: where to draw; default: a new figure.
    """
    ax = axes_or_new(ax)
    ax.axvline(mode_hz, color="#888888", linewidth=0.8, linestyle=":")
    ax.semilogy(frequency[1:], without[1:], **WITHOUT)
    if controlled is not None:
        ax.semilogy(frequency[1:], controlled[1:], **CONTROLLED | {"linewidth": 1.0})
    ax.set_ylabel(label)
    ax.margins(x=0.01)
    return ax


def sensitivity(
    ratio: np.ndarray, curves: dict[str, np.ndarray], level: float, ax: Axes | None = None
) -> Axes:
    """Residual vibration of input shapers over the error of the frequency they assume.

    Args:
        ratio: actual over assumed frequency [1], (n,).
        curves: residual vibration relative to the unshaped one [1], (n,), by shaper.
        level: tolerated residual vibration, marked [1].
        ax: where to draw; default: a new figure.
    """
    ax = axes_or_new(ax)
    ax.axhline(100 * level, color="#888888", linewidth=0.8, linestyle=":")
    for k, (name, curve) in enumerate(curves.items()):
        ax.plot(ratio, 100 * curve, color=SERIES[k], linestyle=DASHES[k], linewidth=1.3, label=name)
    ax.set_xlabel("actual over assumed frequency [1]")
    ax.set_ylabel("residual vibration [%]")
    legend_beside(ax)
    return ax
