"""Contents of a sweep's files: names, axes, units and descriptions of their variables."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any

import numpy as np

from jaxmodel.loop_figures import HIGHEST, MARGIN_MODES, MARGINS, MOST_DELAY
from jaxmodel.metrics import METRICS
from jaxmodel.prepare import SPECTRUM_SPAN
from studies.results.labelled import Variable, Variables
from studies.space.table import CaseTable, as_numbers
from studies.study.labels import DISTANCE_TEXT, POSE_UNITS, STATION_TEXT, STATUS_LABEL
from studies.study.paths import field_unit, parse_entry
from studies.study.spec import Study

#: Status of a case that has not run.
NOT_RUN = -1


#: Names of the axes of fields that are lists, outermost first.
_LIST_AXES = {
    "patches.centers": ("link", "patch"),
    "control.links": ("link",),
    # lists of their own lengths
    "control.mode_mask": ("link", "mode_mask_entry"),
    "control.ratios": ("link", "ratios_entry"),
    "control.velocity_gain": ("link",),
    "control.position_gain": ("link",),
    "control.frequencies_hz": ("link", "frequencies_hz_entry"),
    "link.damping_ratio": ("link", "damping_ratio_entry"),
    "drive.pulse_force": ("slider_axis",),
    "load.wrench": ("pose_axis",),
    "load.pulse": ("pose_axis",),
    "metrics.stations": ("station",),
}


#: Variables of every case, finished or not: axes after `case`, unit, long name and any flags.
PER_CASE: dict[str, tuple[Any, ...]] = {
    "status": (
        (),
        *STATUS_LABEL[:2],
        {NOT_RUN: "not run", **STATUS_LABEL[2]},
    ),
    "bad_time": ((), "s", "when the status appeared, 0 if ok"),
    "command_end": ((), "s", "end of the shaped reference trajectory"),
    "substeps": ((), "1", "plant steps per sample"),
    "sensor_condition": (("link",), "1", "condition number of the modal filter"),
    "actuator_condition": (("link",), "1", "condition number of the synthesizer"),
    "singularity_distance": ((), "rad", DISTANCE_TEXT),
    "gain_margin": (
        (),
        "1",
        "largest factor on all gains with every smaller one stable, at the first "
        f"way-point with {MARGIN_MODES} plant modes or more; {HIGHEST:g}: that or more",
    ),
    "breaking_frequency": ((), "Hz", "of what goes unstable at the gain margin, NaN: nothing"),
    "breaking_mode": (
        (),
        "1",
        "order of the link mode nearest to that frequency, 0: a mode of the platform on its "
        "drive, NaN: nothing; the report of a replay names what moves",
    ),
    "damping_ratio": (
        ("controlled_mode",),
        "1",
        "least damping ratio of the modes of each order, among the most damped "
        "ones, one per controlled link",
    ),
}


#: Figures of a loop that are computed where `sweep.robustness` names them: unit and text.
ON_DEMAND: dict[str, tuple[str, str]] = {
    "disk_margin": (
        "1",
        "disk margin: every actuator may err at once by this size, gain and phase, 0: unstable",
    ),
    "phase_margin": (
        "deg",
        "largest phase of all actuators at once, either way, with every smaller one stable, 180: "
        "any",
    ),
    "delay_margin": (
        "1",
        "largest further delay of all actuators, in samples, with every smaller one stable, "
        f"{MOST_DELAY:g}: that or more",
    ),
    "sensitivity_peak": ("1", "largest singular value of the commands' sensitivity"),
    "control_effort_peak": (
        "1",
        "largest singular value from disturbed sensor voltages to commands, V/V",
    ),
    "disturbance_deflection_peak": (
        "m/N",
        "largest singular value from drive forces to chord deflections, with control",
    ),
}
PER_CASE |= {name: ((), *label) for name, label in ON_DEMAND.items()}


POSE = np.array(["x", "y", "phi"])
#: For these, the smallest entry is the worst.
LEAST = ("damping_ratio",)
#: For these, the largest value is the best.
LARGEST_FIRST = ("gain_margin", *MARGINS, "damping_ratio", "singularity_distance")


def mask_unused(data: np.ndarray, axis: int, count: np.ndarray) -> None:
    """NaN beyond the first `count` entries of an axis (after the one of cases)."""
    shape = [1] * data.ndim
    shape[axis + 1] = -1
    order = np.arange(data.shape[axis + 1]).reshape(shape)
    limit = count.reshape((-1,) + (1,) * (data.ndim - 1))
    data[np.broadcast_to(order >= limit, data.shape)] = np.nan


def case_variables(table: CaseTable) -> dict[str, Variable]:
    """What distinguishes the cases: number, id, seed, repeat and every column."""
    found = Variables()
    found.put("case", np.arange(len(table)), "1", "number of the case", "case")
    found.put("case_id", table.case_id.astype(str), "1", "hash of the case's parameters", "case")
    found.put("seed", table.seed, "1", "seed of noise and ripple", "case")
    found.put("repeat", table.repeat, "1", "number of the repeat", "case")
    for name, column in table.columns.items():
        array = as_numbers(column, table.study.n_links)
        entry = parse_entry(name)
        field = entry.field if entry else name
        dims = _LIST_AXES.get(field, ())[-(array.ndim - 1) :] if array.ndim > 1 else ()
        if len(dims) != array.ndim - 1:
            dims = tuple(f"{name}_{k}" for k in range(1, array.ndim))
        found.put(name, array, field_unit(field), name, "case", *dims)
    return found


def axis_variables(
    study: Study, sizes: Mapping[str, int], swept: Container[str] = ()
) -> dict[str, Variable]:
    """Coordinates of the metrics' axes, the same in all files of results.

    Args:
        study: of the runs.
        sizes: length of each axis of the file.
        swept: fields that differ between its cases.
    """
    axes = Variables()
    axes.put("link", np.arange(1, study.n_links + 1), "1", "link number", "link")
    if "pose_axis" in sizes:
        axes.put("pose_axis", POSE[: study.n_pose], "1", "pose component", "pose_axis")
    if "station" in sizes and "metrics.stations" not in swept:
        axes.put("station", np.array(study.metrics.stations), "1", STATION_TEXT, "station")
    if "spectrum_point" in sizes:
        ratio = np.linspace(1 - SPECTRUM_SPAN, 1 + SPECTRUM_SPAN, sizes["spectrum_point"])
        text = "frequency over the modal frequency"
        axes.put("spectrum_point", ratio, "1", text, "spectrum_point")
    return axes


#: Trajectories of a run: axes, unit and text.
RECORD: dict[str, tuple[Any, ...]] = {
    "time": (("time",), "s", "time"),
    "pose": (("time", "pose_axis"), POSE_UNITS, "platform pose (x, y, phi)"),
    "pose_error": (("time", "pose_axis"), POSE_UNITS, "pose minus shaped reference"),
    "slider": (("time", "slider_axis"), "m", "actuated coordinate rho"),
    "modal_coordinate": (("time", "link", "mode"), "m", "modal coordinates q of the plant"),
    "controlled_coordinate": (
        ("time", "link", "controlled_mode"),
        "m",
        "controller's modes seen by an ideal modal filter",
    ),
    "chord_deflection": (("time", "link"), "m", "mid-span relative to the chord B-C"),
    "chord_deflection_stations": (
        ("time", "link", "station"),
        "m",
        "deflection relative to the chord B-C at the stations",
    ),
    "sensor_voltage": (("time", "link", "patch"), "V", "raw sensor voltage"),
    "actuator_voltage": (("time", "link", "patch"), "V", "actuator voltage"),
    "slider_force": (("time", "slider_axis"), "N", "motor force"),
}


def label_of(name: str) -> tuple[Any, ...]:
    """Axes, unit, long name and any flags of a number or trajectory of a run."""
    own = PER_CASE | RECORD
    if name in own:
        return own[name]
    metric = METRICS[name]
    return metric.dims, metric.unit, metric.text


def named(name: str, data: Any, *axes: str) -> Variable:
    """A number or trajectory of runs, with its labels; axes: of the runs, before its own."""
    dims, *label = label_of(name)
    return Variable(data, (*axes, *dims), *label)
