"""The figure of a twin: ours and theirs side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.show import figures
from studies.twin.compare import BothModels, BothRuns, in_window
from studies.twin.plan import TwinPlan

OURS: dict[str, Any] = {"color": "#E69F00", "linewidth": 2.2, "label": "this model"}
THEIRS: dict[str, Any] = {
    "color": "#0B3C6F",
    "linewidth": 0.9,
    "linestyle": "--",
    "label": "twin in Exudyn",
}
#: How long before the end of the reference trajectory the figure begins [s].
BEFORE = 0.01


def side_by_side(plan: TwinPlan, runs: BothRuns) -> Figure:
    """Both models around the end of the reference trajectory (dotted).

    Mid-span deflection of the links from the chord between their ends, distance of the platform
    from the reference trajectory, difference of the deflections, and the actuator with the largest
    voltages; without control left, with control right.

    Args:
        plan: of the motion.
        runs: without and with control.
    """
    period = plan.electronics.period
    shown = slice(max(in_window(plan).start - round(BEFORE / period), 0), plan.n_samples)
    time = 1e3 * (period * np.arange(plan.n_samples)[shown] - plan.command_end)
    count = plan.rho.shape[1]
    figure, axes = figures.new_figure(count + 2, 2, row_height=1.35)
    for column, (title, both) in enumerate(
        (("without control", runs.free), ("with control", runs.controlled))
    ):
        axes[0, column].set_title(title)
        for i in range(count):
            _both(axes[i, column], time, both, lambda x, i=i: 1e6 * x.deflection[shown, i])
            axes[i, column].set_ylabel(f"link {i + 1} [µm]")
        _both(
            axes[count, column],
            time,
            both,
            lambda x: 1e6 * np.linalg.norm(x.pose_error[shown, :2], axis=1),
        )
        axes[count, column].set_ylabel("platform, error [µm]")
    apart = runs.controlled.theirs.deflection - runs.controlled.ours.deflection
    figures.traces(
        time,
        1e9 * apart[shown],
        [f"link {i + 1}" for i in range(count)],
        "difference [nm]",
        axes[-1, 0],
    )
    axes[-1, 0].legend(loc="upper right")
    axes[-1, 0].set_title("twin minus this model, with control")
    voltage = runs.controlled.theirs.voltage[shown]
    link, patch = np.unravel_index(np.argmax(np.sum(voltage**2, axis=0)), voltage.shape[1:])
    _both(axes[-1, 1], time, runs.controlled, lambda x: x.voltage[shown, link, patch])
    axes[-1, 1].set_ylabel("voltage [V]")
    axes[-1, 1].set_title(f"actuator {link + 1}.{patch + 1}")
    for ax in axes[-1]:
        ax.set_xlabel("time after the reference trajectory [ms]")
    for ax in axes.ravel():
        ax.axvline(0.0, color="#888888", linewidth=0.8, linestyle=":")
    figures.legend_above(figure, axes[0, 0])
    return figure


def _both(ax: Axes, time: np.ndarray, both: BothModels, quantity: Any) -> None:
    ax.plot(time, quantity(both.ours), **OURS)
    ax.plot(time, quantity(both.theirs), **THEIRS)
    ax.margins(x=0.01)
