"""`studies atlas`: sweeps, `atlas.h5`, figures, animation, report.

`runs/` is the sweep of the choices of links, `runs_modes/` that of all subsets of modes, made only
where modes 2 and up matter.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxmodel import status
from studies.atlas.attribution import interaction, shapley
from studies.atlas.figures import write_animation
from studies.atlas.findings import AtlasFindings, adc_step, evaluate_atlas
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
from studies.engine.run_data import run_attributes
from studies.errors import StudyError
from studies.job import Job
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.labelled import Variable, Variables, variables
from studies.show.pages import write_report
from studies.store import axis_sizes, write_store
from studies.study.spec import Study
from studies.sweeps.run import swept_into
from studies.threads import serial_blas

DATA, RUNS_FOLDER, MODES_FOLDER = "atlas.h5", "runs", "runs_modes"
#: Figures of subsets of modes.
OF_MODES = "mode_shares", "interactions"
#: Modules that determine the numbers, with everything they import.
DECISIVE = ("studies.atlas.findings", "studies.atlas.subsets", "studies.engine.plan")


#: What is done, with what it takes on two cores [s].
PHASES = {"compile": 60.0, "run": 60.0, "join": 5.0, "analyse": 60.0, "draw": 30.0}


def mapped(study: Study, job: Job, has_pdf: bool = False) -> AtlasFindings:
    """Run all subsets of a design, analyse its workspace and platform, and write the report.

    Args:
        study: the design.
        job: with `PHASES`.
        has_pdf: also write the figures as PDF.

    Raises:
        StudyError: a fault of the design; no setting in which all cases finish.
    """
    choices, dropped = _swept(study, job, RUNS_FOLDER)
    if not choices.setting:
        raise StudyError(f"atlas: no setting in which all cases run; {' '.join(dropped)}")
    changes = beyond_first(choices, adc_step(study))
    matter = tuple(choices.setting[k] for k in np.flatnonzero(changes > MATTERS))
    job.say(
        f"modes 2 and up change the residual by {100 * changes.max():.2g} % of its mean square at "
        f"most: all subsets of modes in {len(matter)} of {len(changes)} settings"
    )
    subsets = None
    if matter:
        every, more = _swept(study, job, MODES_FOLDER, settings=matter, has_every_mode=True)
        subsets, dropped = every if every.setting else None, dropped + more
    job.begin("analyse")
    with serial_blas():
        found = evaluate_atlas(study, choices, subsets, dropped, job)
    job.begin("draw")
    of_modes = [f"{x}.{kind}" for x in OF_MODES for kind in ("png", "pdf")]
    with publish(job.place, of_modes) as staging:
        write_store(staging / DATA, atlas_variables(found), run_attributes(study))
        write_animation(found, staging)
        write_report(found.report(), staging, has_pdf)
    return in_folder(found, job.place, job.place / REPORT)


def _swept(study: Study, job: Job, name: str, **which: Any) -> tuple[Subsets, list[str]]:
    """Subsets of a design in all settings in which every case finished; what is wrong elsewhere."""
    with job.inside(name) as runs:
        swept_into(atlas_sweep(study, **which), runs)
        return sound_settings(read_subsets(runs.place, which.get("has_every_mode", False)))


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
