"""What the file of a machine's runs holds."""

from __future__ import annotations

import numpy as np

from studies.engine.columns import axis_variables, named
from studies.engine.run_data import metric_variables
from studies.papers.zhang_2016.cases import MOVES, PaperRuns
from studies.papers.zhang_2016.measures import Measures, middle_station
from studies.results.labelled import Variable, Variables
from studies.store import axis_sizes
from studies.study.labels import describe


def paper_variables(runs: PaperRuns, measures: Measures) -> dict[str, Variable]:
    """All variables of a machine's file; the first axis is `case`.

    Args:
        runs: from `run_cases`.
        measures: of these runs.

    Returns:
        Variables for `write_store`; controlled modes that a case does not separate are NaN.
    """
    result, found = runs.result, Variables()
    _put_axes(found, runs, measures)
    _put_case_labels(found, runs)
    ended = {"status": runs.status, "bad_time": result.bad_time, "command_end": result.command_end}
    found |= {name: named(name, data, "case") for name, data in ended.items()}
    texts = [describe(int(k)) for k in runs.status]
    found.put("status_text", texts, "1", "status in words", "case")
    found |= metric_variables(result, "case")  # of which periodograms below cover more
    _put_measures(found, runs, measures)
    found |= _trajectories(runs)
    _put_loops(found, runs)
    return found | axis_variables(runs.study, axis_sizes(found))


def _put_axes(found: Variables, runs: PaperRuns, measures: Measures) -> None:
    count = runs.frame.modal_omega.shape[1]
    found.put("case", [case.name for case in runs.cases], "1", "name of the case", "case")
    found["time"] = named("time", runs.record.time[0])
    found.put("patch", np.arange(1, 4), "1", "patch pair, from the slider on", "patch")
    modes = np.arange(1, count + 1)
    found.put("controlled_mode", modes, "1", "mode of the controller", "controlled_mode")
    found.put("frequency", measures.frequency, "Hz", "frequency", "frequency")


def _put_case_labels(found: Variables, runs: PaperRuns) -> None:
    cases, own = runs.cases, runs.study.link.first_damping
    for name, values, unit, text in (
        ("move", [c.move for c in cases], "1", "the paper's move or the faster one"),
        ("move_time", [MOVES[c.move] for c in cases], "s", "duration of each of the moves"),
        ("shaper", [c.shaper for c in cases], "1", "input shaper"),
        ("controlled_links", [c.links_text for c in cases], "1", "links under control"),
        ("controlled_modes", [c.modes for c in cases], "1", "modes separated by the filter"),
        ("ratio_from", [c.ratio_from for c in cases], "1", "where the gain ratios come from"),
        ("gain_factor", [c.gain_factor for c in cases], "1", "factor on the machine's gains"),
        ("feedback", [c.feedback for c in cases], "1", "sampled or ideal feedback"),
        ("estimator", [c.estimator for c in cases], "1", "velocity estimate"),
        ("damping_ratio", [c.damping_ratio or own for c in cases], "1", "structural, of mode 1"),
    ):
        found.put(name, values, unit, text, "case")


def _put_measures(found: Variables, runs: PaperRuns, measures: Measures) -> None:
    modal = ("case", "link", "controlled_mode")
    text = "gain of a mode over that of mode 1 (24); 0 without control"
    found.put("gain_ratio", runs.ratio, "1", text, *modal)
    text = "one-sided power spectral density of the controller's modes, Hann periodogram of the run"
    density = _without_merged_modes(runs, measures.spectral_density)
    found.put("spectral_density", density, "m2/Hz", text, *modal, "frequency")
    text = "largest spectral density near the mode's frequency"
    peak = _without_merged_modes(runs, measures.spectral_peak)
    found.put("spectral_peak", peak, "m2/Hz", text, *modal)
    text = "of mid-span from the end of the reference trajectory to 5 % of its peak without control"
    found.put("relative_settling_time", measures.settling, "s", text, "case", "link")


def _without_merged_modes(runs: PaperRuns, values: np.ndarray) -> np.ndarray:
    """Copy of (n, 3, C, ...) with the modes that a case does not separate as NaN."""
    values = np.array(values)
    for k, case in enumerate(runs.cases):
        values[k, :, case.modes :] = np.nan
    return values


def _trajectories(runs: PaperRuns) -> dict[str, Variable]:
    record = runs.record
    deflection = record.chord_deflection_stations
    modal = np.moveaxis(record.controlled_coordinate, 1, -1)
    kept = {
        "chord_deflection": deflection[..., middle_station(runs)],
        "chord_deflection_stations": deflection,
        "pose_error": record.pose_error,
        "controlled_coordinate": np.moveaxis(_without_merged_modes(runs, modal), -1, 1),
        "sensor_voltage": record.sensor_voltage,
        "actuator_voltage": record.actuator_voltage,
    }
    return {name: named(name, data, "case") for name, data in kept.items()}


def _put_loops(found: Variables, runs: PaperRuns) -> None:
    """Judgement of the linearised sampled loops, NaN if not judged."""
    values = np.full((2, len(runs.cases)), np.nan)
    for k, case in enumerate(runs.cases):
        if case.name in runs.loops:
            report = runs.loops[case.name]
            values[:, k] = report.spectral_radius, report.gain_margin
    text = "of the linearised sampled loop; NaN: not judged"
    found.put("loop_spectral_radius", values[0], "1", text, "case")
    text = "common gain factor before instability; NaN: not judged"
    found.put("gain_margin", values[1], "1", text, "case")
