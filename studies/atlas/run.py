"""`studies atlas`: sweeps, `atlas.h5`, figures, animation, report.

`runs/` is the sweep of the choices of links, `runs_modes/` that of all subsets of modes, made only
where modes 2 and up matter.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

from jaxmodel import status
from studies import config
from studies.atlas.attribution import interaction, shapley
from studies.atlas.figures import write_animation
from studies.atlas.findings import AtlasFindings, adc_step, evaluate_atlas
from studies.atlas.say import say
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
from studies.engine.columns import axis_variables, named
from studies.engine.folder import ATLASES, locked_folder, refuse_existing
from studies.engine.progress import Phases
from studies.engine.run_data import run_attributes
from studies.errors import StudyError
from studies.publish import publish
from studies.results.labelled import Variable, Variables, variables
from studies.show.pages import write_report
from studies.space.spec import SweepSpec
from studies.store import axis_sizes, write_store
from studies.study.spec import Study
from studies.sweeps.run import run_sweep, sweep_phases
from studies.threads import serial_blas

DATA, RUNS_FOLDER, MODES_FOLDER = "atlas.h5", ATLASES.mark, "runs_modes"
#: Figures of subsets of modes.
OF_MODES = "mode_shares", "interactions"
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
    with publish(out, [f"{x}.{kind}" for x in OF_MODES for kind in ("png", "pdf")]) as staging:
        write_store(staging / DATA, atlas_variables(findings), run_attributes(study))
        write_animation(findings, staging)
        write_report(say(findings, dropped), staging, has_pdf)


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


def atlas_variables(findings: AtlasFindings) -> dict[str, Variable]:
    """All variables of `atlas.h5`."""
    found, choices = Variables(), findings.choices
    labels = [setting_label(s) for s in choices.setting]
    found.put("setting", labels, "1", "move, shaper", "setting")
    text = "how many modes of each controlled link are controlled, from the first on"
    found.put("first_modes", np.arange(1, choices.modes + 1), "1", text, "first_modes")
    found.put("links", [link_label(k) for k in CHOICES], "1", "controlled", "links")
    found.put("target", list(TARGETS), "1", "whose residual", "target")
    chosen = choices.each(lambda values: values[:, :, CHOICES])
    found |= _residual_variables(chosen, ("setting", "first_modes", "links"), "")
    _put_game(found, choices.whole_links(), "setting", "links", "link", "")
    if findings.subsets is not None:
        _put_modes(found, findings.subsets)
    found |= variables(findings)
    return found | axis_variables(findings.study, axis_sizes(found))


def _put_modes(found: Variables, subsets: Subsets) -> None:
    """All subsets of modes, and the game whose players are modes."""
    order, axes = in_order(3 * subsets.modes), ("mode_setting", "mode_subset")
    labels = [setting_label(s) for s in subsets.setting]
    found.put("mode_setting", labels, "1", "move, shaper", "mode_setting")
    names = [subset_label(k, subsets.modes) for k in order]
    found.put("mode_subset", names, "1", "controlled, link.mode", "mode_subset")
    found.put("player", player_labels(subsets.modes), "1", "link.mode", "player")
    found |= _residual_variables(subsets.each(lambda values: values[:, order]), axes, "mode_")
    _put_game(found, subsets, *axes, "player", "mode_")


def _residual_variables(
    subsets: Subsets, axes: tuple[str, ...], prefix: str
) -> dict[str, Variable]:
    """Residuals by the axes of `subsets`; prefix: of the names."""
    parts = {
        "residual_rms": subsets.station,
        "pose_error_rms": subsets.pose,
        "settling_time": subsets.settling,
        "peak_voltage": subsets.voltage,
    }
    found = {prefix + name: named(name, data, *axes) for name, data in parts.items()}
    dims, text = (*axes, "link", "controlled_mode"), "largest spectral density near each mode"
    return found | {f"{prefix}spectral_peak": Variable(subsets.peak, dims, "m2/Hz", text)}


def _put_game(
    found: Variables, subsets: Subsets, setting: str, subset: str, player: str, prefix: str
) -> None:
    """What subsets remove, and how players share in it; axes: their names."""
    game, axes = subsets.removed(), (setting, "target")
    order = in_order(int(np.log2(game.shape[-1])))
    text = "share of the uncontrolled mean square that control takes away"
    found.put(f"{prefix}removed", game[..., order], "1", text, *axes, subset)
    found.put(f"{prefix}shapley_share", shapley(game), "1", "Shapley share of it", *axes, player)
    text, pairs = "Shapley interaction index of pairs", (player, f"other_{player}")
    found.put(f"{prefix}interaction", interaction(game), "1", text, *axes, *pairs)
