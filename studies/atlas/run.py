"""`studies atlas`: `runs/` (the sweep of all subsets), `atlas.h5`, figures, animation, report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits

from jaxmodel import status
from studies import config
from studies.atlas.attribution import interaction, shapley
from studies.atlas.figures import FIGURES, write_animation
from studies.atlas.findings import AtlasFindings, evaluate_atlas
from studies.atlas.platform import LINK_LABELS
from studies.atlas.platform import SETTINGS as RUNS
from studies.atlas.report import report
from studies.atlas.subsets import (
    TARGETS,
    Subsets,
    atlas_sweep,
    link_label,
    player_labels,
    read_subsets,
    setting_label,
)
from studies.atlas.workspace import PAIRS
from studies.engine.columns import LINK_AXIS
from studies.engine.folder import ATLASES, locked_folder, refuse_existing
from studies.engine.progress import Phases
from studies.engine.run_data import run_attributes
from studies.engine.sweep import run_sweep, sweep_phases
from studies.errors import StudyError
from studies.publish import REPORT, publish
from studies.show.figures import save, styled, write_figure
from studies.show.sketch import sketch
from studies.store import Variable, write_store
from studies.study.spec import Study

DATA, RUNS_FOLDER = "atlas.h5", ATLASES.mark
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
            runs = run_sweep(spec, out / RUNS_FOLDER, is_resumed, phases=phases)
            if runs.is_interrupted:
                return False
            try:
                _finish(study, out, phases, has_pdf)
            except KeyboardInterrupt:
                return False
    return True


def _finish(study: Study, out: Path, phases: Phases, has_pdf: bool) -> None:
    """Everything after the runs of the subsets."""

    def on_progress(text: str, share: float) -> None:
        if share == 0:  # the beginning of a step; its end needs no message
            phases.say(text)

    phases.begin("analyse")
    subsets, dropped = sound_settings(read_subsets(out / RUNS_FOLDER))
    with threadpool_limits(1, "blas"):  # many small matrices: more threads only slow them down
        findings = evaluate_atlas(study, subsets, on_progress)
    phases.begin("draw")
    with publish(out) as staging:
        write_store(staging / DATA, variables(findings), run_attributes(study))
        with styled():
            for name, draw in FIGURES.items():
                save(draw(findings), staging, name, has_pdf)
            write_figure(sketch(study), staging / "machine.png")
        write_animation(findings, staging)
        (staging / REPORT).write_text(report(findings, dropped, staging), encoding="utf-8")


def sound_settings(subsets: Subsets) -> tuple[Subsets, list[str]]:
    """Settings in which every case finished, and, in words, what is wrong with the others.

    Raises:
        StudyError: there is none.
    """
    good = np.isin(subsets.status, (status.OK, status.SATURATED))
    is_sound = [bool(part.all()) for part in good]
    dropped = []
    for setting, codes, fine in zip(subsets.setting, subsets.status, is_sound, strict=True):
        if fine:
            continue
        bad, counts = np.unique(codes[codes != status.OK], return_counts=True)
        texts = [f"{n} {status.REASONS[int(k)]}" for k, n in zip(bad, counts, strict=True)]
        dropped.append(f"{setting_label(setting)}: of {codes.size} runs {', '.join(texts)}.")
    if not any(is_sound):
        raise StudyError(f"atlas: no setting in which all cases run; {' '.join(dropped)}")
    kept = tuple(s for s, fine in zip(subsets.setting, is_sound, strict=True) if fine)
    arrays = {name: getattr(subsets, name)[is_sound] for name in Subsets._fields[2:]}
    return subsets._replace(setting=kept, **arrays), dropped


def variables(findings: AtlasFindings) -> dict[str, Variable]:
    """All variables of `atlas.h5`."""
    return {
        **_subset_variables(findings.subsets),
        **_map_variables(findings),
        **_run_variables(findings),
    }


def _names(values: list[str], axis: str, text: str) -> Variable:
    return Variable(np.array(values), (axis,), "1", text)


def _subset_variables(subsets: Subsets) -> dict[str, Variable]:
    game = subsets.removed()
    axes = ("setting", "subset")
    per_link = (*axes, "link")
    return {
        "setting": _names([setting_label(s) for s in subsets.setting], "setting", "move, shaper"),
        "subset": Variable(
            np.arange(game.shape[-1]),
            ("subset",),
            "1",
            "which players are controlled: bit p for player p",
        ),
        "player": _names(player_labels(subsets.modes), "player", "link.mode"),
        "target": _names(list(TARGETS), "target", "whose residual"),
        "link": LINK_AXIS,
        "links": _names([link_label(k) for k in range(8)], "links", "whole links controlled"),
        "links_subset": Variable(subsets.link_subsets, ("links",), "1", "their subset"),
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
        "removed": Variable(
            game,
            ("setting", "target", "subset"),
            "1",
            "share of the uncontrolled mean square that control takes away",
        ),
        "shapley_share": Variable(
            shapley(game),
            ("setting", "target", "player"),
            "1",
            "Shapley share of it",
        ),
        "interaction": Variable(
            interaction(game),
            ("setting", "target", "player", "other_player"),
            "1",
            "Shapley interaction index of pairs",
        ),
    }


def _map_variables(findings: AtlasFindings) -> dict[str, Variable]:
    chart = findings.map
    grid = ("map_phi", "map_y", "map_x")
    pairs = [f"{i + 1}-{k + 1}" for i, k in PAIRS]
    return {
        "map_x": Variable(chart.x, ("map_x",), "m", "platform x"),
        "map_y": Variable(chart.y, ("map_y",), "m", "platform y"),
        "map_phi": Variable(chart.phi, ("map_phi",), "rad", "platform turn"),
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
