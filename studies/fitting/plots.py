"""Figures of a fit: data beside the model with residuals, correlations, profiles, samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from studies.fitting.decays import Diagram
from studies.fitting.kinds.contract import Line, Numbers
from studies.fitting.spec import named_unit, shown_unit
from studies.fitting.statistics import WIDE
from studies.show.figures import SMALL, WIDTH, legend_above, new_figure
from studies.show.report import Drawing
from studies.show.units import count_text

if TYPE_CHECKING:
    from studies.fitting.estimate import Fitted

#: All figures there can be.
NAMES = ("machine", "stabilisation", "fit", "numbers", "correlations", "profiles", "samples")
#: Measurements in one figure, single numbers, and numbers whose samples are drawn.
MOST, MOST_NUMBERS, MOST_SAMPLED = 8, 40, 6
#: Captions.
CURVES = (
    "Data and model; below each, model minus measurement in standard deviations of the noise; of "
    "complex responses real and imaginary part; band: two of them to each side"
)
PROFILES = (
    "Least misfit for fixed values of one parameter, the others fitted anew; dashed: what sigma "
    "says; the interval of 95 % lies between the crossings of the grey line"
)
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#999999"


def drawings(fitted: Fitted) -> dict[str, Drawing]:
    """Figures of data, model and parameters, by their names."""
    lines = [(_plain(x.title), x.part) for x in fitted.comparisons if isinstance(x.part, Line)]
    single = [(_plain(x.title), x.part) for x in fitted.comparisons if isinstance(x.part, Numbers)]
    diagrams = [(name, x.diagram) for name, x in single if x.diagram is not None][:MOST]
    has_several, further = len(fitted.names) > 1, max(len(lines) - MOST, 0)
    left = f"; {count_text(further, 'further measurement')}: in fit.h5" if further else ""
    every: list[tuple[object, str, str, Callable[[], Figure]]] = [
        (lines, "fit", f"{CURVES}{left}", partial(curves, lines[:MOST])),
        (single, "numbers", "Single values: model minus measured", partial(numbers, single)),
        (diagrams, "stabilisation", "Stabilisation diagram", partial(stabilisation, diagrams)),
        (has_several, "correlations", "Correlations", partial(correlations, fitted)),
        (fitted.profiles, "profiles", PROFILES, partial(profiles, fitted)),
        (has_several and fitted.posterior, "samples", "Samples", partial(samples, fitted)),
    ]
    return {name: Drawing(name, text, draw) for is_there, name, text, draw in every if is_there}


def _plain(text: str) -> str:
    """A user's text, which is no formula."""
    return "".join(x for x in text.replace("$", r"\$") if x.isprintable())


def stabilisation(shown: Sequence[tuple[str, Diagram]]) -> Figure:
    """Poles of all orders over frequency, with the spectra of what was recorded."""
    figure, axes = new_figure(len(shown), 1, 2.6, has_shared_abscissa=False)
    for ax, (title, one) in zip(axes[:, 0], shown, strict=True):
        spectrum = ax.twinx()
        spectrum.semilogy(*one.spectrum, color=GREY, lw=0.8, label="spectrum")
        spectrum.set_ylabel("power over its peak [1]", fontsize=SMALL)
        spectrum.grid(visible=False)
        ax.set_zorder(spectrum.get_zorder() + 1)
        ax.patch.set_visible(False)
        for which, label, style in (
            (~one.is_stable, "pole", {"color": GREY, "marker": "."}),
            (one.is_stable, "stable pole", {"color": BLUE, "marker": "o"}),
        ):
            ax.plot(one.frequency[which], one.order[which], ls="", ms=3, label=label, **style)
        for k, frequency in enumerate(one.chosen):
            ax.axvline(frequency, color=ORANGE, lw=0.8, label="mode" if k == 0 else None)
        ax.plot([], [], color=GREY, lw=0.8, label="spectrum")
        ax.set(xlabel="frequency [Hz]", ylabel="order")
        ax.set_title(title, loc="left", fontsize=9)
    legend_above(figure, axes[0, 0])
    return figure


def curves(shown: Sequence[tuple[str, Line]]) -> Figure:
    """Data and model of measurements with their titles, and below them their residuals."""
    figure = Figure(figsize=(WIDTH, 0.75 + 2.7 * len(shown)), layout="constrained")
    axes = figure.subplots(
        2 * len(shown), 1, squeeze=False, gridspec_kw={"height_ratios": [3, 1.2] * len(shown)}
    )[:, 0]
    for ax, below, (title, curve) in zip(axes[::2], axes[1::2], shown, strict=True):
        ax.sharex(below)
        ax.tick_params(labelbottom=False)
        ax.plot(curve.x, curve.measured, ".", ms=2, color=GREY, label="measured")
        ax.plot(curve.x, curve.model, color=BLUE, lw=1, label="model")
        if curve.is_log:
            ax.set_yscale("log")
        ax.set_ylabel(curve.ordinate, fontsize=SMALL)
        ax.set_title(title, loc="left", fontsize=9)
        for part in np.split(curve.away, len(curve.away) // len(curve.x)):
            below.plot(curve.x, part, ".", ms=2, color=BLUE)
        below.axhspan(-2, 2, color=GREY, alpha=0.2, lw=0)
        below.set_xlabel(curve.abscissa)
        below.set_ylabel("residual [sigma]", fontsize=SMALL)
    figure.align_ylabels()
    legend_above(figure, axes[0])
    return figure


def numbers(shown: Sequence[tuple[str, Numbers]]) -> Figure:
    """How far the model is from single measured numbers, in their standard deviations."""
    labels: list[str] = []
    rows: list[int] = []
    away: list[float] = []
    for name, part in shown:
        if len(labels) + len(part.labels) >= MOST_NUMBERS and rows:
            break
        rows += list(range(len(labels) + 1, len(labels) + 1 + len(part.labels)))
        labels += [f"{name}:", *part.labels]
        away += list(part.away)
    figure, axes = new_figure(1, 1, 0.2 * len(labels))
    ax = axes[0, 0]
    ax.barh(rows, away, 0.6, color=BLUE)
    ax.axvline(0, color="black", lw=0.6)
    ax.axvspan(-2, 2, color=GREY, alpha=0.2, lw=0, label="2 standard deviations")
    far = max(3.0, 1.1 * float(np.abs(away).max()))
    ax.set(xlim=(-far, far), ylim=(len(labels) - 0.3, -0.7))
    ax.set_yticks(range(len(labels)), labels, fontsize=SMALL)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("model minus measured [standard deviations]")
    legend_above(figure, ax)
    return figure


def correlations(fitted: Fitted) -> Figure:
    """Correlation of the parameters."""
    n = len(fitted.names)
    figure, axes = new_figure(1, 1, min(1.2 + 0.28 * n, 7.0))
    ax = axes[0, 0]
    ax.grid(False)
    image = ax.imshow(fitted.answer.correlation, vmin=-1, vmax=1, cmap="RdBu_r", aspect="auto")
    ax.set_xticks(range(n), fitted.names, rotation=90, fontsize=SMALL)
    ax.set_yticks(range(n), fitted.names, fontsize=SMALL)
    figure.colorbar(image, ax=ax, label="correlation [1]")
    return figure


def profiles(fitted: Fitted) -> Figure:
    """Least misfit over each parameter, and what its standard deviation promises."""
    count = len(fitted.profiles)
    figure, axes = new_figure((count + 1) // 2, min(count, 2), 1.9, has_shared_abscissa=False)
    for ax, one in zip(axes.ravel(), fitted.profiles, strict=False):
        k = one.number
        factor, unit = shown_unit(fitted.names[k])
        value, sigma = fitted.answer.values[k], fitted.answer.sigma[k]
        x, rise = one.smooth()
        ax.plot(factor * x, rise, color=BLUE, label="profile")
        ax.plot(factor * one.values, one.rise, "o", ms=3, color=BLUE)
        if sigma > 0:
            x = np.linspace(one.values.min(), one.values.max(), 101)
            ax.plot(
                factor * x, ((x - value) / sigma) ** 2, "--", color=ORANGE, lw=1, label="from sigma"
            )
        ax.axhline(WIDE**2, color=GREY, lw=0.8, label="95 %")
        ax.set_ylim(0, 1.6 * WIDE**2)
        ax.set(xlabel=f"[{unit or '1'}]", ylabel="rise of chi square")
        ax.locator_params(axis="x", nbins=5)
        ax.set_title(fitted.names[k], loc="left", fontsize=9)
    legend_above(figure, axes[0, 0])
    for ax in axes.ravel()[count:]:
        ax.set_visible(False)
    return figure


def samples(fitted: Fitted) -> Figure:
    """Histograms of sampled parameters, and pairs of them."""
    assert fitted.posterior is not None
    values = fitted.posterior.values * [shown_unit(name)[0] for name in fitted.names]
    names = [named_unit(name) for name in fitted.names]
    n = min(len(names), MOST_SAMPLED)
    figure, axes = new_figure(n, n, 7.0 / n, has_shared_abscissa=True)
    for row in range(n):
        for column in range(n):
            ax = axes[row, column]
            if column > row:
                ax.set_visible(False)
                continue
            if column == row:
                ax.hist(values[:, row], "auto", color=BLUE)
                ax.set_yticks([])
            else:
                ax.plot(values[:, column], values[:, row], ".", ms=1, color=BLUE, alpha=0.3)
            ax.tick_params(labelleft=column == 0 and row > 0, labelsize=SMALL)
            ax.locator_params(axis="x", nbins=4)
            ax.xaxis.get_offset_text().set_fontsize(SMALL)
            if row == n - 1:
                ax.set_xlabel(names[column], fontsize=SMALL)
            if column == 0 and row > 0:
                ax.set_ylabel(names[row], fontsize=SMALL)
    return figure
