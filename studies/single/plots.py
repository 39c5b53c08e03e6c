"""Figures of one run over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from studies import show  # whose `figures` load Matplotlib when they are needed
from studies.engine.run_data import chord_deflection
from studies.engine.runs import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Of the residual window and of markers.
GREY = "#888888"
#: Coordinates of the platform.
POSE = ("x [µm]", "y [µm]", "φ [µrad]")


def pose_error(run: Run) -> Figure:
    """Platform: pose minus reference trajectory."""
    assert run.result.record is not None
    error = 1e6 * run.result.record.pose_error.T[..., None]
    return _over_time(run, dict(zip(POSE, error, strict=False)), [])


def voltage(run: Run) -> Figure:
    """Actuator voltages, numbered from the actuated joint outwards."""
    assert run.result.record is not None
    volts = run.result.record.actuator_voltage
    rows = {f"link {i + 1} [V]": volts[:, i] for i in range(run.study.n_links)}
    return _over_time(run, rows, [f"pair {k + 1}" for k in range(volts.shape[2])])


def _over_time(run: Run, rows: dict[str, np.ndarray], names: list[str]) -> Figure:
    """A panel of each quantity, (T, n) by its label; names: of the n curves, [] for one."""
    assert run.result.record is not None
    figure, axes = show.figures.new_figure(len(rows), 1, 1.3)
    for ax, (label, values) in zip(axes[:, 0], rows.items(), strict=True):
        show.figures.traces(1e3 * run.result.record.time, values, names, label, ax)
        ax.axvline(1e3 * float(run.result.command_end), color=GREY, linewidth=0.8, linestyle=":")
    axes[-1, 0].set_xlabel("time [ms]")
    if names:
        show.figures.legend_above(figure, axes[0, 0])
    return figure


def deflection(run: Run, twin: Run | None) -> Figure:
    """Mid-span deflection of the links from the chord between their ends.

    Dotted: the end of the reference trajectory; right: from there on, in the scale of the residual;
    grey: residual window.
    """
    assert run.result.record is not None
    time, end = 1e3 * run.result.record.time, 1e3 * float(run.result.command_end)
    start = end + 1e3 * float(run.case.windows.residual_delay)
    window = start, start + 1e3 * float(run.case.windows.residual_length)
    within = (time >= window[0]) & (time <= window[1])
    bent = [1e6 * chord_deflection(x) for x in (twin, run) if x is not None]
    is_fed_back = run.study.control.feedback != "none"
    held = show.figures.CONTROLLED if is_fed_back else show.figures.WITHOUT
    styles = [show.figures.WITHOUT, held][-len(bent) :]
    figure, axes = show.figures.new_figure(run.study.n_links, 1 + bool(time[-1] > end), 1.4)
    for link, (whole, *rest) in enumerate(axes):
        for ax in (whole, *rest):
            for values, style in zip(bent, styles, strict=True):
                ax.plot(time, values[:, link], **style)
            ax.margins(x=0.01)
        whole.axvline(end, color=GREY, linewidth=0.8, linestyle=":")
        whole.set_ylabel(f"link {link + 1} [µm]")
        for ax in rest:
            ax.axvspan(*window, color=GREY, alpha=0.12, linewidth=0)
            ax.set_xlim(end, time[-1])
            sizes = [np.abs(x[within, link]).max(initial=0.0) for x in bent]
            if size := max(x if np.isfinite(x) else 0.0 for x in sizes):
                ax.set_ylim(-1.2 * size, 1.2 * size)
    for ax in axes[-1]:
        ax.set_xlabel("time [ms]")
    if twin is not None:
        show.figures.legend_above(figure, axes[0, 0])
    return figure
