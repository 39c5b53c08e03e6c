"""Tuned controllers on machines and moves that none of them was tuned on.

One sweep, whose environments are the machines (see `machines`) and moves a quarter slower and a
fifth faster than the design's. Every controller meets the same machines.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.loop_figures import MARGINS
from studies.engine.results import SweepData, metric_values, read_sweep
from studies.space.spec import SweepSpec, parse_sweep
from studies.study.spec import Study

#: Move times over the design's.
MOVES = (0.8, 1.0, 1.25)
MOVE_TIME = "motion.move_time"
#: Figures of which less is better, by metric, with the words of tables; the first decides.
FIGURES = {
    "residual_rms": "residual vibration",
    "ringing_time": "ringing time",
    "residual_peak": "residual peak",
    "control_energy": "control energy",
}
#: Others that a table shows.
SHOWN = ("peak_voltage", "settling_time", "pose_error_peak", "pose_error_rms", "saturated_fraction")


#: What a sweep says of the instability at the gain margin.
BREAKING = ("breaking_mode", "breaking_frequency")


class Judged(NamedTuple):
    """N controllers on M machines in K moves; NaN where a run did not finish."""

    metrics: dict[str, np.ndarray]  # largest over the controlled links, (N, M, K)
    status: np.ndarray  # code of `jaxmodel.status`, (N, M, K)
    margins: dict[str, np.ndarray]  # of the loop at rest on each machine, by name, (N, M)
    breaking: list[str]  # what goes unstable first, on the machine with the least gain margin

    @property
    def n_lost(self) -> np.ndarray:
        """Runs that did not finish, (N,)."""
        is_lost = ~np.isin(self.status, status.FINISHED)
        return np.asarray(is_lost.sum(axis=(1, 2)))


def judging_sweep(study: Study, designs: list[Study], machines: list[dict[str, Any]]) -> SweepSpec:
    """The sweep of designs over machines and moves.

    Args:
        study: the design that all of them come from.
        designs: they differ from it in any fields of the controller.
        machines: from `machines_of`.
    """
    times = study.motion.move_time
    moves = [
        share * times if isinstance(times, float) else [share * x for x in times] for share in MOVES
    ]
    names = [*machines[0], MOVE_TIME]
    sweep = {
        "blocks": [
            {"method": "list", "cases": [changes(study, design) for design in designs]},
            {"method": "list", "cases": machines},
            {"method": "list", "cases": [{MOVE_TIME: move} for move in moves]},
        ],
        "environments": names,
        "metrics": [*FIGURES, *SHOWN],
        "robustness": list(MARGINS),
    }
    return parse_sweep(longer(study).model_dump() | {"sweep": sweep})


def longer(study: Study) -> Study:
    """The study with a run as much longer as its slowest move of `MOVES`."""
    times = study.motion.move_time
    moves = len(study.motion.waypoints) - 1
    whole = moves * times if isinstance(times, float) else sum(times)
    return study.change(run__duration=study.run.duration + (max(MOVES) - 1) * whole)


def changes(study: Study, design: Study) -> dict[str, Any]:
    """Fields in which a design differs from a study, by their full names."""
    return _apart(study.model_dump(), design.model_dump())


def _apart(before: dict[str, Any], after: dict[str, Any], path: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in after.items():
        if isinstance(value, dict):
            found |= _apart(before.get(name, {}), value, f"{path}{name}.")
        elif value != before.get(name) and path:
            found[f"{path}{name}"] = value
    return found


def read_judged(folder: Path, n_designs: int, n_machines: int) -> Judged:
    """Results of the sweep, by design, machine and move."""
    data = read_sweep(folder)
    shape = n_designs, n_machines, len(MOVES)
    origin = data.table.origin  # rows of the design, duplicates included

    def ordered(values: np.ndarray) -> np.ndarray:
        return np.asarray(values[origin].reshape(shape))

    of_loop = {name: ordered(data[name])[:, :, 0] for name in (*BREAKING, "gain_margin", *MARGINS)}
    mode, frequency = (of_loop.pop(name) for name in BREAKING)
    worst = np.argmin(np.nan_to_num(of_loop["gain_margin"], nan=np.inf), axis=1)[:, None]
    at_worst = (np.take_along_axis(x, worst, axis=1)[:, 0].tolist() for x in (mode, frequency))
    return Judged(
        metrics={name: ordered(_values(data, name)) for name in (*FIGURES, *SHOWN)},
        status=ordered(data["status"]),
        margins=of_loop,
        breaking=[breaking_text(*each) for each in zip(*at_worst, strict=True)],
    )


def breaking_text(mode: float, frequency: float) -> str:
    """What goes unstable first, in words; "" if nothing does.

    Args:
        mode: order of the link mode, 0: of the platform on its drive, NaN: not named.
        frequency: [Hz].
    """
    if np.isnan(frequency):
        return ""
    if frequency == 0:
        return "grows without oscillating"
    if np.isnan(mode):
        return f"{frequency:.3g} Hz"
    what = f"mode {mode:.0f} of the links" if mode else "the platform on its drive"
    return f"{what}, {frequency:.3g} Hz"


def _values(data: SweepData, name: str) -> np.ndarray:
    """A metric of each case; of poses, the distance in the plane."""
    if name.startswith("pose_error"):
        return np.asarray(np.hypot(*(data[name][:, k] for k in range(2))))
    return metric_values(data, name).astype(float)
