"""`studies atlas`: sweeps, `atlas.h5`, figures, animation, report.

`runs/` is the sweep of the choices of links, `runs_modes/` that of all subsets of modes, made only
where modes 2 and up matter.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from jaxmodel import status
from studies import config
from studies.atlas.attribution import interaction, shapley
from studies.atlas.figures import FIGURES, MODE_FIGURES, write_animation
from studies.atlas.findings import AtlasFindings, adc_step, evaluate_atlas
from studies.atlas.platform import LINK_LABELS
from studies.atlas.platform import SETTINGS as RUNS
from studies.atlas.report import report
from studies.atlas.subsets import (
    CHOICES,
    MATTERS,
    TARGETS,
    Subsets,
    atlas_sweep,
    beyond_first,
    in_order,
    link_label,
    player_labels,
    read_subsets,
    setting_label,
    subset_label,
)
from studies.atlas.workspace import PAIRS
from studies.engine.columns import axis_variables
from studies.engine.folder import ATLASES, locked_folder, refuse_existing
from studies.engine.progress import Phases
from studies.engine.run_data import run_attributes
from studies.errors import StudyError
from studies.publish import REPORT, publish
from studies.show.figures import draw
from studies.show.sketch import sketch
from studies.space.spec import SweepSpec
from studies.store import Variable, axis_sizes, write_store
from studies.study.spec import Study
from studies.sweeps.run import run_sweep, sweep_phases
from studies.threads import serial_blas

DATA, RUNS_FOLDER, MODES_FOLDER = "atlas.h5", ATLASES.mark, "runs_modes"
#: Phases after those of the sweep.
LATER = ("analyse", "draw")


def run_atlas(
    study: Study,
    out: str | Path,
    is_resumed: bool = False,
    console: Console | None = None,
    is_quiet: bool = False,
    has_pdf: bool = False,
) -> bool:
    """Run all subsets of a design, analyse its workspace and platform, and write the report.

    Args:
        study: the design.
        out: folder.
        is_resumed: continue with existing runs; everything else is computed anew.
        console: where progress goes; default: standard output.
        is_quiet: hide progress.
        has_pdf: also write the figures as PDF.

    Returns:
        Whether it finished; if not, Ctrl-C ended it, and finished runs are kept.

    Raises:
        StudyError: a fault of the design or the folder; no setting in which all cases finish.
    """
    config.require_configured()
    out, console = Path(out), console or Console(highlight=False, markup=False)
    spec = atlas_sweep(study)
    with locked_folder(out, "atlas"):
        refuse_existing(out, ATLASES, is_resumed)
        with Phases(console, (*sweep_phases(spec), *LATER), is_quiet) as phases:
            try:
                _run(study, spec, out, is_resumed, phases, has_pdf)
            except KeyboardInterrupt:
                return False
    return True


def _run(
    study: Study, spec: SweepSpec, out: Path, is_resumed: bool, phases: Phases, has_pdf: bool
) -> None:
    """All of the atlas in an open folder; arguments as in `run_atlas`, and the sweep of links.

    Raises:
        KeyboardInterrupt: also where a sweep was interrupted.
        StudyError: as `run_atlas`.
    """
    if run_sweep(spec, out / RUNS_FOLDER, is_resumed, phases=phases).is_interrupted:
        raise KeyboardInterrupt
    choices, dropped = sound_settings(read_subsets(out / RUNS_FOLDER))
    if not choices.setting:
        raise StudyError(f"atlas: no setting in which all cases run; {' '.join(dropped)}")
    changes = beyond_first(choices, adc_step(study))
    matter = tuple(choices.setting[k] for k in np.flatnonzero(changes > MATTERS))
    phases.say(
        f"modes 2 and up change the residual by {100 * changes.max():.2g} % of its mean square at "
        f"most: all subsets of modes in {len(matter)} of {len(changes)} settings"
    )
    subsets = None
    if matter:
        every = atlas_sweep(study, settings=matter, has_every_mode=True)
        if run_sweep(every, out / MODES_FOLDER, is_resumed, phases=phases).is_interrupted:
            raise KeyboardInterrupt
        subsets, more = sound_settings(read_subsets(out / MODES_FOLDER, has_every_mode=True))
        dropped += more
        subsets = subsets if subsets.setting else None
    _finish(study, (choices, subsets), dropped, out, phases, has_pdf)


def _finish(
    study: Study,
    found: tuple[Subsets, Subsets | None],
    dropped: list[str],
    out: Path,
    phases: Phases,
    has_pdf: bool,
) -> None:
    """Everything after the sweeps; found: choices of links, subsets of modes."""

    def on_progress(text: str, share: float) -> None:
        if share == 0:  # the beginning of a step; its end needs no message
            phases.say(text)

    phases.begin("analyse")
    with serial_blas():
        findings = evaluate_atlas(study, *found, on_progress)
    phases.begin("draw")
    drawn = FIGURES if findings.subsets is None else FIGURES | MODE_FIGURES
    with publish(out, [f"{x}.{kind}" for x in MODE_FIGURES for kind in ("png", "pdf")]) as staging:
        write_store(staging / DATA, variables(findings), run_attributes(study))
        draw(staging, {name: partial(plot, findings) for name, plot in drawn.items()}, has_pdf)
        draw(staging, {"machine": partial(sketch, study)})
        write_animation(findings, staging)
        (staging / REPORT).write_text(report(findings, dropped, staging), encoding="utf-8")


def sound_settings(subsets: Subsets) -> tuple[Subsets, list[str]]:
    """Settings in which every case finished, and, in words, what is wrong with the others."""
    is_sound = [bool(np.isin(x, (status.OK, status.SATURATED)).all()) for x in subsets.status]
    dropped = []
    for setting, codes, fine in zip(subsets.setting, subsets.status, is_sound, strict=True):
        if not fine:
            bad = [status.REASONS[int(k)] for k in np.unique(codes) if k != status.OK]
            dropped.append(f"{setting_label(setting)}: runs with {', '.join(bad)}.")
    kept = tuple(s for s, fine in zip(subsets.setting, is_sound, strict=True) if fine)
    return subsets.each(lambda values: values[is_sound])._replace(setting=kept), dropped


def variables(findings: AtlasFindings) -> dict[str, Variable]:
    """All variables of `atlas.h5`."""
    found = {
        **_choice_variables(findings),
        **(_mode_variables(findings.subsets) if findings.subsets is not None else {}),
        **_map_variables(findings),
        **_run_variables(findings),
    }
    return found | axis_variables(findings.study, axis_sizes(found))


def _names(values: list[str], axis: str, text: str) -> Variable:
    return Variable(np.array(values), (axis,), "1", text)


def _choice_variables(findings: AtlasFindings) -> dict[str, Variable]:
    """Of the choices of links, and the game whose players are whole links."""
    choices = findings.choices
    axes = ("setting", "first_modes", "links")
    return {
        "setting": _names([setting_label(s) for s in choices.setting], "setting", "move, shaper"),
        "first_modes": Variable(
            np.arange(1, choices.modes + 1),
            ("first_modes",),
            "1",
            "how many modes of each controlled link are controlled, from the first on",
        ),
        "links": _names([link_label(k) for k in CHOICES], "links", "controlled"),
        "target": _names(list(TARGETS), "target", "whose residual"),
        "beyond_first": Variable(
            findings.beyond_first,
            ("setting",),
            "1",
            "largest change that modes 2 and up make, share of the uncontrolled mean square",
        ),
        **_residual_variables(choices.each(lambda values: values[:, :, CHOICES]), axes, ""),
        **_game_variables(choices.whole_links(), "setting", "links", "link", ""),
    }


def _mode_variables(subsets: Subsets) -> dict[str, Variable]:
    """Of all subsets of modes, and the game whose players are modes."""
    order, axes = in_order(3 * subsets.modes), ("mode_setting", "mode_subset")
    labels = [setting_label(s) for s in subsets.setting]
    names = [subset_label(k, subsets.modes) for k in order]
    return {
        "mode_setting": _names(labels, "mode_setting", "move, shaper"),
        "mode_subset": _names(names, "mode_subset", "controlled, link.mode"),
        "player": _names(player_labels(subsets.modes), "player", "link.mode"),
        **_residual_variables(subsets.each(lambda values: values[:, order]), axes, "mode_"),
        **_game_variables(subsets, *axes, "player", "mode_"),
    }


def _residual_variables(
    subsets: Subsets, axes: tuple[str, ...], prefix: str
) -> dict[str, Variable]:
    """Residuals by the axes of `subsets`; prefix: of the names."""
    per_link = (*axes, "link")
    parts = {
        "residual_rms": Variable(
            subsets.station, (*per_link, "station"), "m", "rms chord deflection in the window"
        ),
        "pose_error_rms": Variable(
            subsets.pose, (*axes, "pose_axis"), "m; m; rad", "rms error in the window"
        ),
        "spectral_peak": Variable(
            subsets.peak,
            (*per_link, "controlled_mode"),
            "m2/Hz",
            "largest spectral density near each mode of the controller",
        ),
        "settling_time": Variable(
            subsets.settling, per_link, "s", "after the reference trajectory"
        ),
        "peak_voltage": Variable(subsets.voltage, per_link, "V", "peak actuator voltage"),
    }
    return {prefix + name: variable for name, variable in parts.items()}


def _game_variables(
    subsets: Subsets, setting: str, subset: str, player: str, prefix: str
) -> dict[str, Variable]:
    """What subsets remove, and how players share in it; axes: their names."""
    game = subsets.removed()
    order = in_order(int(np.log2(game.shape[-1])))
    parts = {
        "removed": Variable(
            game[..., order],
            (setting, "target", subset),
            "1",
            "share of the uncontrolled mean square that control takes away",
        ),
        "shapley_share": Variable(
            shapley(game), (setting, "target", player), "1", "Shapley share of it"
        ),
        "interaction": Variable(
            interaction(game),
            (setting, "target", player, f"other_{player}"),
            "1",
            "Shapley interaction index of pairs",
        ),
    }
    return {prefix + name: variable for name, variable in parts.items()}


def _map_variables(findings: AtlasFindings) -> dict[str, Variable]:
    chart = findings.map
    grid = ("map_phi", "map_y", "map_x")
    pairs = [f"{i + 1}-{k + 1}" for i, k in PAIRS]
    return {
        "map_x": Variable(chart.x, ("map_x",), "m", "platform x"),
        "map_y": Variable(chart.y, ("map_y",), "m", "platform y"),
        "map_phi": Variable(chart.phi, ("map_phi",), "rad", "platform turn"),
        "lift": Variable(
            chart.lift, (*grid, "link"), "1", "sines of the link angles, above 1 out of reach"
        ),
        "map_status": Variable(chart.status, grid, "1", "pose", status.REASONS),
        "gamma": Variable(chart.gamma, (*grid, "link"), "rad", "link angles"),
        "natural_frequency": Variable(
            chart.frequency, (*grid, "natural_mode"), "Hz", "of the machine on its drive"
        ),
        "bending_frequency": Variable(
            chart.bending, (*grid, "bending_mode"), "Hz", "the first three bending modes"
        ),
        "strain_share": Variable(
            chart.share, (*grid, "bending_mode", "part"), "1", "strain energy in links and drive"
        ),
        "pair": _names(pairs, "pair", "two links"),
        "inertial_coupling": Variable(
            chart.coupling, (*grid, "pair"), "1", "of the links' first modes, pose condensed out"
        ),
        "pose_of_modes": Variable(findings.poses, ("mode_pose", "pose_axis"), "m; m; rad", "pose"),
        "mode_frequency": Variable(
            findings.modes.frequency, ("mode_pose", "natural_mode"), "Hz", "at these poses"
        ),
        "mode_shape": Variable(
            findings.modes.shape,
            ("mode_pose", "coordinate", "natural_mode"),
            "m; m; rad; m ...",
            "pose and modal coordinates, largest entry 1",
        ),
    }


def _run_variables(findings: AtlasFindings) -> dict[str, Variable]:
    runs, answers = findings.platform, findings.responses
    series = ("run", "run_links", "time", "pose_axis")
    return {
        "run": _names([setting_label(s) for s in RUNS], "run", "move, shaper"),
        "run_links": _names(list(LINK_LABELS), "run_links", "controlled links"),
        "time": Variable(runs.time, ("time",), "s", "time"),
        "command_end": Variable(
            runs.command_end, ("run",), "s", "end of the shaped reference trajectory"
        ),
        "drive_error": Variable(
            runs.drive, ("run", "time", "pose_axis"), "m; m; rad", "pose error with rigid links"
        ),
        "vibration_error": Variable(
            runs.vibration, series, "m; m; rad", "pose error beyond that of rigid links"
        ),
        "response_frequency": Variable(
            answers.frequency, ("response_frequency",), "Hz", "of the responses"
        ),
        "response_size": Variable(
            np.abs(answers.value),
            ("run_links", "response_frequency", "output", "source"),
            "m/N and alike",
            "magnitude of the response of the sampled loop",
        ),
        "response_phase": Variable(
            np.angle(answers.value),
            ("run_links", "response_frequency", "output", "source"),
            "rad",
            "its phase",
        ),
    }
