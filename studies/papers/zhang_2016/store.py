"""What the file of a machine's runs holds."""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.engine.columns import axis_variables
from studies.engine.run_data import metric_variables
from studies.papers.zhang_2016.cases import MOVES, PaperRuns
from studies.papers.zhang_2016.measures import Measures, middle_station
from studies.store import Variable, axis_sizes
from studies.study.labels import STATUS_LABEL, describe


def paper_variables(runs: PaperRuns, measures: Measures) -> dict[str, Variable]:
    """All variables of a machine's file; the first axis is `case`.

    Args:
        runs: from `run_cases`.
        measures: of these runs.

    Returns:
        Variables for `write_store`; controlled modes that a case does not separate are NaN.
    """
    metrics = {
        name: Variable(v.data, ("case", *v.dims), v.units, v.long_name)
        for name, v in metric_variables(runs.result).items()
        if name != "spectral_density"  # the periodograms below cover more
    }
    result, per_case = runs.result, ("case",)
    variables = {
        **_axes(runs, measures),
        **_case_labels(runs),
        "status": Variable(runs.status, per_case, *STATUS_LABEL),
        "status_text": Variable(
            np.array([describe(int(k)) for k in runs.status]), per_case, "1", "status in words"
        ),
        "bad_time": Variable(result.bad_time, per_case, "s", "when the status appeared, 0 if ok"),
        "command_end": Variable(
            result.command_end, per_case, "s", "end of the shaped reference trajectory"
        ),
        **metrics,
        **_measure_variables(runs, measures),
        **_trajectories(runs),
        **_loops(runs),
    }
    return variables | axis_variables(runs.study, axis_sizes(variables))


def _axes(runs: PaperRuns, measures: Measures) -> dict[str, Variable]:
    count = runs.frame.modal_omega.shape[1]
    names = np.array([case.name for case in runs.cases])
    return {
        "case": Variable(names, ("case",), "1", "name of the case"),
        "time": Variable(runs.record.time[0], ("time",), "s", "time"),
        "patch": Variable(np.arange(1, 4), ("patch",), "1", "patch pair, from the slider on"),
        "controlled_mode": Variable(
            np.arange(1, count + 1), ("controlled_mode",), "1", "mode of the controller"
        ),
        "frequency": Variable(measures.frequency, ("frequency",), "Hz", "frequency"),
    }


def _case_labels(runs: PaperRuns) -> dict[str, Variable]:
    cases = runs.cases

    def label(values: list[Any], unit: str, text: str) -> Variable:
        return Variable(np.array(values), ("case",), unit, text)

    return {
        "move": label([c.move for c in cases], "1", "the paper's move or the faster one"),
        "move_time": label([MOVES[c.move] for c in cases], "s", "duration of each of the moves"),
        "shaper": label([c.shaper for c in cases], "1", "input shaper"),
        "controlled_links": label([c.links_text for c in cases], "1", "links under control"),
        "controlled_modes": label([c.modes for c in cases], "1", "modes separated by the filter"),
        "ratio_from": label([c.ratio_from for c in cases], "1", "where the gain ratios come from"),
        "gain_factor": label([c.gain_factor for c in cases], "1", "factor on the machine's gains"),
        "feedback": label([c.feedback for c in cases], "1", "sampled or ideal feedback"),
        "estimator": label([c.estimator for c in cases], "1", "velocity estimate"),
        "damping_ratio": label(
            [c.damping_ratio or runs.study.link.first_damping for c in cases],
            "1",
            "structural damping of mode 1",
        ),
    }


def _measure_variables(runs: PaperRuns, measures: Measures) -> dict[str, Variable]:
    modal = ("case", "link", "controlled_mode")
    return {
        "gain_ratio": Variable(
            runs.ratio, modal, "1", "gain of a mode over that of mode 1 (24); 0 without control"
        ),
        "spectral_density": Variable(
            _without_merged_modes(runs, measures.spectral_density),
            (*modal, "frequency"),
            "m2/Hz",
            "one-sided power spectral density of the controller's modes, Hann periodogram of the "
            "run",
        ),
        "spectral_peak": Variable(
            _without_merged_modes(runs, measures.spectral_peak),
            modal,
            "m2/Hz",
            "largest spectral density near the mode's frequency",
        ),
        "relative_settling_time": Variable(
            measures.settling,
            modal[:2],
            "s",
            "of mid-span from the end of the reference trajectory to 5 % of its peak without "
            "control",
        ),
    }


def _without_merged_modes(runs: PaperRuns, values: np.ndarray) -> np.ndarray:
    """Copy of (n, 3, C, ...) with the modes that a case does not separate as NaN."""
    values = np.array(values)
    for k, case in enumerate(runs.cases):
        values[k, :, case.modes :] = np.nan
    return values


def _trajectories(runs: PaperRuns) -> dict[str, Variable]:
    record = runs.record
    deflection = record.chord_deflection_stations
    series = ("case", "time")
    modal = np.moveaxis(
        _without_merged_modes(runs, np.moveaxis(record.controlled_coordinate, 1, -1)), -1, 1
    )
    return {
        "chord_deflection": Variable(
            deflection[..., middle_station(runs)],
            (*series, "link"),
            "m",
            "deflection of mid-span from the chord B-C",
        ),
        "chord_deflection_stations": Variable(
            deflection,
            (*series, "link", "station"),
            "m",
            "deflection relative to the chord B-C at the stations",
        ),
        "pose_error": Variable(
            record.pose_error, (*series, "pose_axis"), "m; m; rad", "pose minus shaped reference"
        ),
        "controlled_coordinate": Variable(
            modal,
            (*series, "link", "controlled_mode"),
            "m",
            "controller's modes seen by an ideal modal filter",
        ),
        "sensor_voltage": Variable(
            record.sensor_voltage, (*series, "link", "patch"), "V", "raw sensor voltage"
        ),
        "actuator_voltage": Variable(
            record.actuator_voltage, (*series, "link", "patch"), "V", "actuator voltage"
        ),
    }


def _loops(runs: PaperRuns) -> dict[str, Variable]:
    """Judgement of the linearised sampled loops, NaN if not judged."""
    values = np.full((2, len(runs.cases)), np.nan)
    for k, case in enumerate(runs.cases):
        if case.name in runs.loops:
            report = runs.loops[case.name]
            values[:, k] = report.spectral_radius, report.gain_margin
    return {
        "loop_spectral_radius": Variable(
            values[0], ("case",), "1", "of the linearised sampled loop; NaN: not judged"
        ),
        "gain_margin": Variable(
            values[1], ("case",), "1", "common gain factor before instability; NaN: not judged"
        ),
    }
