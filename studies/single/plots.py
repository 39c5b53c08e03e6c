"""Figures of one run over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.engine.run_data import chord_deflection
from studies.engine.runs import Run
from studies.show import figures

#: Of the residual window and of markers.
GREY = "#888888"
#: Coordinates of the platform.
POSE = ("x [µm]", "y [µm]", "φ [µrad]")


def pose_error(run: Run) -> Figure:
    """Pose of the platform minus the reference trajectory."""
    assert run.result.record is not None
    error = 1e6 * run.result.record.pose_error.T[..., None]
    return _over_time(run, dict(zip(POSE, error, strict=False)), [])


def voltage(run: Run) -> Figure:
    """Voltages of the actuators of each link."""
    assert run.result.record is not None
    volts = run.result.record.actuator_voltage
    rows = {f"link {i + 1} [V]": volts[:, i] for i in range(run.study.n_links)}
    return _over_time(run, rows, [f"pair {k + 1}" for k in range(volts.shape[2])])


def _over_time(run: Run, rows: dict[str, np.ndarray], names: list[str]) -> Figure:
    """A panel of each quantity, (T, n) by its label; names: of the n curves, [] for one."""
    assert run.result.record is not None
    figure, axes = figures.new_figure(len(rows), 1, 1.3)
    for ax, (label, values) in zip(axes[:, 0], rows.items(), strict=True):
        figures.traces(1e3 * run.result.record.time, values, names, label, ax)
        ax.axvline(1e3 * float(run.result.command_end), color=GREY, linewidth=0.8, linestyle=":")
    axes[-1, 0].set_xlabel("time [ms]")
    if names:
        figures.legend_above(figure, axes[0, 0])
    return figure


def deflection(run: Run, twin: Run | None) -> Figure:
    """Deflection of each link: the run, and beside it what the reference trajectory leaves."""
    assert run.result.record is not None
    time, end = 1e3 * run.result.record.time, 1e3 * float(run.result.command_end)
    windows = run.case.windows
    start = end + 1e3 * float(windows.residual_delay)
    window = (start, start + 1e3 * float(windows.residual_length))
    bent = [1e6 * chord_deflection(x) for x in (twin, run) if x is not None]
    is_fed_back = run.study.control.feedback != "none"
    styles = [figures.WITHOUT, figures.CONTROLLED if is_fed_back else figures.WITHOUT][-len(bent) :]
    has_rest = time[-1] > end
    figure, axes = figures.new_figure(run.study.n_links, 1 + has_rest, 1.4)
    for link, row in enumerate(axes):
        for ax in row:
            for values, style in zip(bent, styles, strict=True):
                ax.plot(time, values[:, link], **style)
            ax.margins(x=0.01)
        row[0].axvline(end, color=GREY, linewidth=0.8, linestyle=":")
        row[0].set_ylabel(f"link {link + 1} [µm]")
        if has_rest:
            is_shown = (time >= window[0]) & (time <= window[1])
            _zoom(row[1], [x[is_shown, link] for x in bent], (end, time[-1]), window)
    for ax in axes[-1]:
        ax.set_xlabel("time [ms]")
    if twin is not None:
        figures.legend_above(figure, axes[0, 0])
    return figure


def _zoom(
    ax: Axes, curves: list[np.ndarray], span: tuple[float, float], window: tuple[float, float]
) -> None:
    """Limit a panel to a span of time and to the size of what is seen in the residual window."""
    ax.axvspan(*window, color=GREY, alpha=0.12, linewidth=0)
    ax.set_xlim(span)
    size = max((np.abs(x).max() for x in curves if len(x) and np.isfinite(x).all()), default=0)
    if size > 0:
        ax.set_ylim(-1.2 * size, 1.2 * size)
