"""`studies plot`: one figure of a sweep; the axes determine its kind.

No x: parallel coordinates of all axes, or the best placements where patches move. x and hue on a
numeric grid: heat map. x with few values: lines, one per hue. Otherwise points, coloured by hue.
"""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel import status
from jaxmodel.loop_figures import HIGHEST
from studies.engine.front import pareto_front
from studies.engine.results import SweepData, metric_values, swept_names
from studies.errors import StudyError
from studies.show import figures
from studies.show.sketch import ACTUATOR, SENSOR
from studies.space.axes import SHOWN_AS
from studies.space.spec import BlockNode
from studies.study.margin import ENOUGH
from studies.sweeps.records import MARGIN
from studies.sweeps.show import label, left_out_text, recommended, shown_metric, shown_value
from studies.verbs import check_file

#: Endings of files of figures.
FORMATS = (".png", ".pdf", ".svg")
#: More distinct values than this are no grid.
FEW = 60
#: Placements drawn one below the other.
N_PLACEMENTS = 15
MAP = "viridis"
#: The best cases among others.
BEST = "#D00000"
RING: Any = {"color": "black", "markerfacecolor": "none", "markeredgewidth": 1.0, "zorder": 3}
#: From so many values on, the largest 2 % do not set the limits of an axis.
MANY = 50
VOLTAGE = "peak_voltage"
#: Of lines, where the colours begin anew.
MARKERS = ("o", "^", "s")
#: More groups than this have no bands, which would cover one another.
MOST_BANDS = 4
#: Of parallel coordinates, the lines drawn, and different lists with a place on an axis.
MOST_LINES, MOST_LISTS = 3000, 12
#: Characters of a line of notes.
LINE = 120


def plot(data: SweepData, x: str | None, y: str, hue: str | None = None) -> Figure:
    """Cases of status ok: what varies, and what ranks them.

    Args:
        data: of the sweep.
        x: axis or metric along the abscissa; None: all axes at once.
        y: metric or axis.
        hue: axis or metric that sets the colour.

    Raises:
        StudyError: unknown name, or no finished case.
    """
    value = metric_values(data, y)
    if value.dtype.kind not in "fiub":
        raise StudyError(f"--y {y}: a text, not a number")
    chosen = (data["status"] == status.OK) & np.isfinite(value)
    if not chosen.any():
        raise StudyError(f"--y {y}: no case of status ok has it")
    if x is None:
        if hue is not None:
            raise StudyError("--hue: needs --x")
        return _placements(data, y) if _has_placements(data) else _parallel(data, y, chosen)
    for option, name in (("--x", x), ("--hue", hue)):
        there = metric_values(data, name) if name is not None else value
        if there.dtype.kind == "f":
            chosen = chosen & np.isfinite(there)
        if not chosen.any():
            raise StudyError(f"{option} {name}: no case of status ok has it")
    is_run = chosen | (data["status"] >= 0)
    whole, color = _drawn(data, x), None if hue is None else _drawn(data, hue)
    across, group = whole[chosen], None if color is None else color[chosen]
    shown = shown_metric(data, y)[chosen]
    with figures.styled():
        figure, ax = figures.one_panel(4.2)
        _note_left_out(figure, data, chosen)
        ax.set_xlabel(label(data, x))
        if group is not None and _is_grid(across, group):
            _heat_map(figure, ax, across, group, shown, label(data, y))
            ax.set_ylabel(label(data, str(hue)))
            return figure
        ax.set_ylabel(label(data, y))
        if len(np.unique(across)) <= min(FEW, max(len(across) // 2, 12)):
            is_run &= (whole == whole) & (True if color is None else color == color)
            value = np.where(chosen, shown_metric(data, y), np.nan)[is_run]
            _lines(ax, whole[is_run], value, None if color is None else color[is_run], hue)
            if is_log(data, x) or _is_geometric(np.unique(whole[is_run])):
                figures.log_scale(ax, "x")
        else:
            best = np.isin(np.flatnonzero(chosen), recommended(data, y))
            hue_label = "" if hue is None else label(data, hue)
            _points(figure, ax, across, shown, group, hue_label, best)
            if is_log(data, x) or figures.is_wide(across):
                figures.log_scale(ax, "x")
            if x == MARGIN:
                ax.axvline(ENOUGH, color="black", linewidth=0.8, linestyle=":")
    return figure


def has_axes(data: SweepData, y: str) -> bool:
    """Whether `plot` draws a metric, which some case has, over all axes at once."""
    cases = np.flatnonzero((data["status"] == status.OK) & np.isfinite(metric_values(data, y)))
    return _has_placements(data) or bool(_axes(data, cases))


def _has_placements(data: SweepData) -> bool:
    return "patches.centers" in data.variables and data["patches.centers"].ndim == 2


def _axes(data: SweepData, cases: np.ndarray) -> dict[str, np.ndarray]:
    """Values of cases along each axis, of lists as texts; without axes of too many lists."""
    axes = {}
    for name in swept_names(data):
        is_list = data[name].ndim > 1
        lists = [shown_value(data, name, case) for case in cases.tolist() if is_list]
        axes[name] = np.array(lists) if is_list else _drawn(data, name)[cases]
    return {x: v for x, v in axes.items() if data[x].ndim == 1 or len({*v}) <= MOST_LISTS}


def _drawn(data: SweepData, name: str) -> np.ndarray:
    """Values of an axis or metric, of a switch as texts, (n,)."""
    entry = SHOWN_AS.get(name, name).partition("[")[0]
    is_switch = entry in data.table.columns and data.table.columns[entry].dtype == bool
    values = shown_metric(data, name)
    return np.where(values, "on", "off") if is_switch and values.dtype.kind in "bi" else values


def front(data: SweepData, y: str) -> Figure:
    """What ranks the cases over their gain margin, by peak voltage; black: none beats it in both.

    Args:
        data: with cases of status ok that have a gain margin.
        y: the metric.
    """
    chosen = np.flatnonzero((data["status"] == status.OK) & np.isfinite(metric_values(data, y)))
    margin, value = data[MARGIN][chosen], shown_metric(data, y)[chosen]
    with figures.styled():
        figure, ax = figures.one_panel(4.2)
        colors: dict[str, Any] = {"c": figures.SERIES[0]}
        if VOLTAGE in data.variables:
            voltage = metric_values(data, VOLTAGE)[chosen]
            norm = "log" if figures.is_wide(voltage) else None
            colors = {"c": voltage, "cmap": MAP, "norm": norm}
        dots = ax.scatter(margin, value, s=5, linewidths=0, rasterized=True, **colors)
        if VOLTAGE in data.variables:
            figure.colorbar(dots, ax=ax, label=label(data, VOLTAGE))
        # margins are the same if four digits are
        same = np.array([float(f"{x:.4g}") for x in margin])
        best = pareto_front(np.stack([-same, value], axis=1))
        ax.plot(margin[best], value[best], "-o", linewidth=0.8, markersize=6, **RING)
        ax.axvline(ENOUGH, color="black", linewidth=0.8, linestyle=":")
        ends = f" ({HIGHEST:g}: that or more)" if margin.max(initial=0.0) >= HIGHEST else ""
        ax.set(xlabel=f"gain margin{ends}", ylabel=label(data, y))
        _scale_ordinate(ax, value)
        if figures.is_wide(margin):
            figures.log_scale(ax, "x")
    return figure


def is_log(data: SweepData, name: str) -> bool:
    """Whether an axis was sampled on a logarithmic scale."""

    def scales(node: BlockNode) -> dict[str, Any]:
        own = {
            SHOWN_AS.get(axis, axis): written.get("scale")
            for axis, written in node.block.axes.items()
            if isinstance(written, dict)
        }
        for child in node.children:
            own |= scales(child)
        return own

    return scales(data.spec.root).get(SHOWN_AS.get(name, name)) == "log"


def _scale_ordinate(ax: Axes, value: np.ndarray) -> None:
    """Logarithmic for a wide range; limits ignore a few outliers."""
    is_wide = figures.is_wide(value)
    if is_wide:
        figures.log_scale(ax, "y")
    if len(value) < MANY:
        return
    shape = np.log(value) if is_wide else value
    low, high = np.percentile(shape, [0.0, 98.0])
    room = 0.08 * (high - low)
    if np.max(shape) <= high + 4 * room or high <= low:
        return
    bottom, top = (np.exp(x) if is_wide else x for x in (low - room, high + 4 * room))
    ax.set_ylim(bottom, top)
    beyond = int(np.sum(value > top))
    if beyond:
        ax.set_title(f"{beyond} above {top:.3g} not shown", fontsize=figures.SMALL, loc="right")


def _note_left_out(figure: Figure, data: SweepData, chosen: np.ndarray, more: str = "") -> None:
    parts = []
    if not chosen.all():
        why = left_out_text(data, ~chosen)
        parts.append(f"{np.sum(~chosen):,} of {len(chosen):,} cases are left out ({why})")
    if MARGIN in data.variables:
        n_low = int(np.sum(data[MARGIN][chosen] < ENOUGH))
        if n_low:
            shown = int(np.sum(chosen))
            parts.append(f"{n_low:,} of the {shown:,} shown have a gain margin below {ENOUGH:g}")
    if text := "; ".join(filter(None, [*parts, more])):
        figure.suptitle(fill(text, LINE), fontsize=figures.SMALL, x=0.01, ha="left")


def save_plot(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, PDF or SVG, by its file extension.

    Raises:
        StudyError: another extension, or the file cannot be written.
    """
    check_file(path, *FORMATS)
    with figures.styled():
        figures.write_figure(figure, path)


def _is_grid(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two numeric columns take few values each, in nearly all combinations."""
    if a.dtype.kind not in "fi" or b.dtype.kind not in "fi":
        return False
    na, nb = len(np.unique(a)), len(np.unique(b))
    pairs = len(np.unique(np.stack([a, b]).astype(float), axis=1).T)
    return min(na, nb) >= 4 and max(na, nb) <= FEW and pairs > 0.5 * na * nb


def _heat_map(
    figure: Figure, ax: Axes, a: np.ndarray, b: np.ndarray, value: np.ndarray, text: str
) -> None:
    columns, i = np.unique(a, return_inverse=True)
    rows, j = np.unique(b, return_inverse=True)
    middle = np.full((len(rows), len(columns)), np.nan)
    cell = j * len(columns) + i
    order = np.argsort(cell, kind="stable")
    numbers, start = np.unique(cell[order], return_index=True)
    for number, values in zip(numbers, np.split(value[order], start[1:]), strict=True):
        middle.flat[number] = np.median(values)
    scale = "log" if figures.is_wide(value) else "linear"
    mesh = ax.pcolormesh(
        _edges(columns), _edges(rows), middle, cmap=MAP, norm=scale, rasterized=True
    )
    several = "median of " if len(value) > len(numbers) else ""
    figure.colorbar(mesh, ax=ax, label=several + text)
    for which, middles in (("x", columns), ("y", rows)):
        if _is_geometric(middles):
            figures.log_scale(ax, which)
    ax.grid(False)


def _edges(middles: np.ndarray) -> np.ndarray:
    """Borders of cells around sorted numbers, on the axis' scale."""
    if _is_geometric(middles):
        return np.exp(_edges(np.log(middles)))
    inner = (middles[1:] + middles[:-1]) / 2
    ends = 2 * middles[0] - inner[0], 2 * middles[-1] - inner[-1]
    return np.concatenate([ends[:1], inner, ends[1:]])


def _is_geometric(values: np.ndarray) -> bool:
    """Whether sorted numbers grow by a constant factor, over more than a decade."""
    if values.dtype.kind != "f" or len(values) < 4 or values[0] <= 0:
        return False
    ratios = values[1:] / values[:-1]
    return bool(values[-1] > 10 * values[0] and np.ptp(ratios) < 0.1 * ratios.mean())


def _lines(
    ax: Axes, across: np.ndarray, value: np.ndarray, group: np.ndarray | None, hue: str | None
) -> None:
    """Medians of the values that are there; behind them, the share of those that are NaN."""
    is_text, is_there = across.dtype.kind in "UOb", np.isfinite(value)
    places = np.array(_distinct(across))  # texts in the order of the file, on one axis
    share = np.array([np.mean(~is_there[across == x]) for x in places])
    if share.any():  # what is left of such a value may be its lucky cases
        at, height = range(len(places)) if is_text else places, ax.get_xaxis_transform()
        ax.vlines(at, 0, share, color="#888888", alpha=0.3, linewidth=7, transform=height)
        told = f"grey: share left out of the medians, up to {100 * share.max():.0f} %"
        ax.set_title(told, fontsize=figures.SMALL, loc="left")
    groups = [None] if group is None else _distinct(group[is_there])
    if len(groups) > 12:
        groups = [groups[k] for k in np.linspace(0, len(groups) - 1, 12).astype(int)]
    for k, name in enumerate(groups):
        part = is_there if group is None else is_there & (group == name)
        at = np.array([x for x in places if np.any(across[part] == x)])
        inside = [value[part][across[part] == x] for x in at]
        middle = [np.median(v) for v in inside]
        position = np.flatnonzero(np.isin(places, at)) if is_text else at
        style: dict[str, Any] = {
            "color": figures.SERIES[k % len(figures.SERIES)],
            "linestyle": figures.DASHES[(k // len(figures.SERIES)) % len(figures.DASHES)],
            "marker": MARKERS[(k // len(figures.SERIES)) % len(MARKERS)],
        }
        if is_text:
            style["linestyle"] = "none"
        text = None if name is None else f"{hue} = {_short(name)}"
        ax.plot(position, middle, markersize=4, label=text, **style)
        if any(len(v) > 1 for v in inside):
            low, high = [np.min(v) for v in inside], [np.max(v) for v in inside]
            if is_text:
                ax.vlines(position, low, high, color=style["color"], alpha=0.3)
            elif len(groups) <= MOST_BANDS:
                ax.fill_between(position, low, high, color=style["color"], alpha=0.1, linewidth=0)
            span = ", smallest to largest" if is_text or len(groups) <= MOST_BANDS else ""
            sizes = sorted({len(v) for v in inside})
            most = " to ".join(map(str, dict.fromkeys((sizes[0], sizes[-1]))))
            ax.set_title(f"median{span} of {most} cases", fontsize=figures.SMALL, loc="right")
        if is_text:
            ax.set_xticks(range(len(places)), [str(v) for v in places], rotation=30, ha="right")
    if group is not None:
        figures.legend_beside(ax)
    if figures.is_wide(value[is_there]):
        figures.log_scale(ax, "y")


def _distinct(values: np.ndarray) -> list[Any]:
    """Distinct values: numbers sorted, texts in order of first appearance."""
    distinct, first = np.unique(values, return_index=True)
    return list(distinct if values.dtype.kind in "fi" else values[np.sort(first)])


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)


def _points(
    figure: Figure,
    ax: Axes,
    across: np.ndarray,
    value: np.ndarray,
    group: np.ndarray | None,
    hue: str,
    best: np.ndarray,
) -> None:
    size = 9 if len(value) < 2000 else 4
    if group is None:
        ax.scatter(across, value, s=size, color=figures.SERIES[0], linewidths=0)
    elif group.dtype.kind in "fi":
        dots = ax.scatter(across, value, s=size, c=group, cmap=MAP, linewidths=0)
        figure.colorbar(dots, ax=ax, label=hue)
    else:
        for k, name in enumerate(np.unique(group)):
            part = group == name
            color = figures.SERIES[k % len(figures.SERIES)]
            ax.scatter(
                across[part], value[part], s=size, color=color, linewidths=0, label=str(name)
            )
        ax.plot([], [], " ", label=hue)
    text = f"the {best.sum()} best" if best.any() else None
    ax.plot(across[best], value[best], "o", label=text, markersize=5, **RING)
    if ax.get_legend_handles_labels()[1]:
        figures.legend_above(figure, ax)
    _scale_ordinate(ax, value)


def _best_text(data: SweepData, count: int) -> str:
    """Which cases `recommended` returns, in words."""
    has_margin = MARGIN in data.variables and bool(np.any(data[MARGIN] >= ENOUGH))
    return f"{count} smallest" + (f" with a gain margin of {ENOUGH:g} or more" * has_margin)


def _parallel(data: SweepData, y: str, chosen: np.ndarray) -> Figure:
    """Each axis a vertical line, each case a polyline coloured by rank; the best stand out."""
    columns = _axes(data, np.flatnonzero(chosen))
    if not columns:
        raise StudyError("--x: needed here, no axis of this sweep is a single number or text")
    names = list(columns)
    notes = [f"no axis for {x}: too many lists" for x in swept_names(data) if x not in columns]
    value = shown_metric(data, y)[chosen]
    best = np.flatnonzero(np.isin(np.flatnonzero(chosen), recommended(data, y)))
    order = np.argsort(-value)
    rank = np.argsort(np.argsort(value)) / max(len(value) - 1, 1)
    lines = []
    with figures.styled():
        figure, ax = figures.one_panel(4.2)
        for k, name in enumerate([*names, y]):
            column = value if k == len(names) else columns[name]
            if column.dtype.kind in "UO":
                ticks, column = np.unique(column.astype(str), return_inverse=True)
                texts = list(ticks)
                low, high = 0.0, float(max(len(ticks) - 1, 1))
            else:
                column = np.where(np.isfinite(column.astype(float)), column, np.nan)
                low, high = float(np.nanmin(column)), float(np.nanmax(column))
                texts = [f"{v:.3g}" for v in (low, high)]
                if low > 0 and (high > 30 * low or (k < len(names) and is_log(data, name))):
                    column, low, high = np.log(column), np.log(low), np.log(high)
            lines.append((column - low) / max(high - low, 1e-300))
            places = np.linspace(0, 1, len(texts)) if len(texts) > 1 else [0.0]
            for place, text in zip(places, texts, strict=True):
                ax.annotate(
                    text,
                    (k, place),
                    xytext=(4, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=figures.SMALL,
                    bbox={"fc": "white", "ec": "none", "alpha": 0.85, "pad": 1},
                    zorder=5,
                )
        matrix = np.array(lines)
        is_whole = np.isfinite(matrix).all(axis=0)
        gaps = [x for x, line in zip(names, matrix, strict=False) if np.isnan(line).any()]
        if gaps:
            notes.append(f"{np.sum(~is_whole):,} not drawn, without a value of {', '.join(gaps)}")
        if len(order) > MOST_LINES:
            notes.append(f"the {len(order) - MOST_LINES:,} largest are not drawn")
        for case in order[-MOST_LINES:]:
            color = matplotlib.colormaps[MAP](rank[case])
            ax.plot(matrix[:, case], color=color, linewidth=0.5, alpha=0.4)
        for case in best:
            ax.plot(matrix[:, case], color=BEST, linewidth=1.3)
        ax.set_xticks(range(len(names) + 1), [*names, label(data, y)], rotation=30, ha="right")
        ax.set_yticks([])
        ax.set_title(
            f"red: the {_best_text(data, len(best))}; the others: darker is smaller",
            fontsize=figures.SMALL,
            loc="right",
        )
        _note_left_out(figure, data, chosen, "; ".join(notes))
    return figure


def _placements(data: SweepData, y: str) -> Figure:
    """The best placements on the links, one below another, above all cases by each patch.

    Links of different length, or with patches of different length, have a line each.
    """
    centers, value = data["patches.centers"], shown_metric(data, y)
    study = data.spec.study
    sizes = (study.link.length, study.patches.actuator_length, study.patches.sensor_length)
    links = list(dict.fromkeys(zip(*(map(float, study.each_link(x)) for x in sizes), strict=True)))
    chosen = recommended(data, y, N_PLACEMENTS)
    is_ok = (data["status"] == status.OK) & np.isfinite(value)
    others = [name for name in swept_names(data) if name != "patches.centers"]
    unit = 1e3
    with figures.styled():
        figure = Figure(figsize=(figures.WIDTH, 5.6), layout="constrained")
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1.2, 1))
        texts = []
        for row, case in enumerate(chosen):
            for at, link in zip(_lanes(row, len(links)), links, strict=True):
                _draw_placement(top, at, centers[case], link, 0.6 / len(links))
            also = "".join(f", {shown_value(data, name, case)}" for name in others)
            texts.append(f"{case}: {value[case]:.4g}{also}")
        top.set_ylim(len(chosen) - 0.4, -0.6)
        top.set_xlim(0, max(length for length, *_ in links) * unit)
        top.set_ylabel("best placements")
        top.yaxis.tick_right()
        top.set_yticks(range(len(chosen)), texts, fontsize=figures.SMALL)
        top.tick_params(axis="y", length=0)
        top.grid(False)
        top.set_title(
            f"{label(data, y)}, the {_best_text(data, len(chosen))}\n"
            "orange: actuator, green: sensor; right: "
            + ", ".join([f"case: {y.partition('[')[0]}", *others]),
            fontsize=8.5,
            loc="left",
        )
        for k in range(centers.shape[1]):
            color = figures.SERIES[k % len(figures.SERIES)]
            bottom.scatter(
                centers[is_ok, k] * unit,
                value[is_ok],
                s=3,
                color=color,
                linewidths=0,
                label=f"pair {k + 1}",
                alpha=0.5,
                rasterized=True,
            )
            bottom.plot(centers[chosen, k] * unit, value[chosen], "o", markersize=4, **RING)
        _scale_ordinate(bottom, value[is_ok])
        bottom.set_xlabel("centre of the patch pair along the link [mm]")
        bottom.set_ylabel(label(data, y))
        bottom.set_title("rings: those above", fontsize=figures.SMALL, loc="left")
        figures.legend_beside(bottom, markerscale=3)
        _note_left_out(figure, data, is_ok)
    return figure


def _lanes(row: int, count: int) -> np.ndarray:
    """Ordinates of `count` links about that of their placement."""
    return row + 0.8 * ((np.arange(count) + 0.5) / count - 0.5)


def _draw_placement(
    ax: Axes, at: float, centers: np.ndarray, link: tuple[float, ...], height: float
) -> None:
    """A link with its patches to one scale; link: its length, an actuator's, a sensor's [m]."""
    length, actuator, sensor = (1e3 * x for x in link)
    ax.plot([0, length], [at, at], color="#AAAAAA", linewidth=1)
    for center in 1e3 * centers:
        ax.barh(at, actuator, height, center - actuator / 2, color=ACTUATOR, linewidth=0)
        ax.barh(at, sensor, height / 2, center - sensor / 2, color=SENSOR, linewidth=0)
