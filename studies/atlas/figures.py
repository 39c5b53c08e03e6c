"""The atlas's figures, assembled from its plots."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from studies.atlas import plots
from studies.atlas.attribution import effects, interaction, shapley
from studies.atlas.drawing import Clip, animate, draw_mode, mode_skeleton
from studies.atlas.findings import AtlasFindings
from studies.atlas.platform import SETTINGS as RUNS
from studies.atlas.subsets import (
    CHOICES,
    TARGETS,
    Subsets,
    link_label,
    player_labels,
    setting_label,
)
from studies.show.figures import SERIES, SMALL, comparison, legend_above, new_figure
from studies.show.skeleton import skeleton

#: The animation: from before the command's end to after it, and its frames [s].
CLIP = (-0.02, 0.07, 1e-3)
#: Largest drawn deflection after the command, as a share of a link's length [1].
CLIP_SIZE = 0.12
ANIMATION = "machine.gif"


#: LINK_SETS in words.
_SETS = ("no link controlled", "link 1", "links 1+2", "links 1+2+3")
#: Components of the platform's error.
_ERRORS = ("x [nm]", "y [nm]", "φ [nrad]")
_COLUMNS = ["link 1", "link 2", "link 3", "platform"]


def subsets(findings: AtlasFindings) -> Figure:
    """Change of the residual of links and platform, by controlled links."""
    figure, axes = _panels(findings, findings.links, 2.2)
    rows = [link_label(k) for k in CHOICES[1:]]
    for ax, change in zip(axes, _link_changes(findings), strict=True):
        image = plots.change_map(change[CHOICES[1:]], rows, _COLUMNS, ax)
    for ax in axes[::2]:
        ax.set_ylabel("controlled links")
    figure.colorbar(
        image, ax=list(axes), shrink=0.5, extend="both", label="change of residual rms [%]"
    )
    return figure


def _link_changes(findings: AtlasFindings) -> np.ndarray:
    """Change of the residual of links 1 to 3 and platform, (settings, 8, 4)."""
    links = findings.links
    residual = np.concatenate([links.link, links.platform[..., None]], axis=-1)
    return residual / residual[:, :1] - 1


def _panels(findings: AtlasFindings, subsets: Subsets, height: float) -> tuple[Figure, np.ndarray]:
    """Two panels per row, one for each setting of the subsets."""
    labels = findings.labels(subsets)
    count = len(labels)
    figure, axes = new_figure(-(-count // 2), min(count, 2), height, False)
    for ax, label in zip(axes.flat, labels, strict=False):
        ax.set_title(label)
    for ax in axes.flat[count:]:
        ax.remove()
    return figure, axes.ravel()[:count]


def lattice(findings: AtlasFindings) -> Figure:
    """Residual of all links, one more controlled link per step; dashed: it increases."""
    figure, axes = _panels(findings, findings.links, 1.9)
    every = np.sqrt(np.mean(findings.links.link**2, axis=-1))
    for ax, residual in zip(axes, every, strict=True):
        plots.lattice(residual, ax)
    return figure


def helps(findings: AtlasFindings) -> Figure:
    """Who helps or hurts whom: one link controlled."""
    figure, axes = _panels(findings, findings.links, 1.5)
    for ax, change in zip(axes, _link_changes(findings), strict=True):
        image = plots.change_map(effects(1 + change), _COLUMNS[:3], _COLUMNS, ax)
    for ax in axes[::2]:
        ax.set_ylabel("controlled alone")
    figure.colorbar(
        image, ax=list(axes), shrink=0.6, extend="both", label="change of residual rms [%]"
    )
    return figure


def shares(findings: AtlasFindings) -> Figure:
    """Links: Shapley shares in what control of all removes [% of the mean square].

    Below, interactions: what two links remove together beyond what each removes.
    """
    game = findings.links.removed()
    pairs = list(combinations(range(3), 2))
    index = interaction(game)
    every = np.concatenate([shapley(game), *(index[..., i, k, None] for i, k in pairs)], axis=-1)
    figure, axes = _panels(findings, findings.links, 1.9)
    rows = [*_COLUMNS[:3], *(f"{i + 1} with {k + 1}" for i, k in pairs)]
    for ax, share in zip(axes, every, strict=True):
        plots.share_map(share.T, rows, list(TARGETS), ax)
        ax.axhline(2.5, color="black", linewidth=0.8)
    return figure


def mode_shares(findings: AtlasFindings) -> Figure:
    """Shapley shares of links and modes in what control removes [% of the mean square]."""
    subsets = _modes_of(findings)
    labels, modes = findings.labels(subsets), [str(j + 1) for j in range(subsets.modes)]
    share = shapley(subsets.removed()).reshape(-1, len(TARGETS), 3, subsets.modes)
    figure, axes = new_figure(len(labels), len(TARGETS), 1.3, False)
    for row, label in enumerate(labels):
        for column, target in enumerate(TARGETS):
            ax = axes[row, column]
            plots.share_map(share[row, column], ["1", "2", "3"], modes, ax)
            if row == 0:
                ax.set_title(target)
            if row == len(labels) - 1:
                ax.set_xlabel("mode")
        axes[row, 0].set_ylabel(f"{label}\nlink", fontsize=SMALL)
    return figure


def interactions(findings: AtlasFindings) -> Figure:
    """Pairs of links and modes that remove more or less together; 2.1: mode 1 of link 2."""
    subsets = _modes_of(findings)
    figure, axes = _panels(findings, subsets, 2.4)
    every = interaction(subsets.removed()[:, TARGETS.index("all links")])
    limit = float(np.max(np.abs(np.nan_to_num(every)), initial=1e-6))
    for ax, index in zip(axes, every, strict=True):
        image = plots.interaction_map(index, player_labels(subsets.modes), limit, ax)
    figure.colorbar(
        image,
        ax=list(axes),
        shrink=0.5,
        label="interaction [% of the mean square],\npositive: more is removed together",
    )
    return figure


def _modes_of(findings: AtlasFindings) -> Subsets:
    """Subsets of modes, without which these figures are not drawn."""
    assert findings.subsets is not None
    return findings.subsets


def workspace(findings: AtlasFindings) -> Figure:
    """Natural modes over the workspace.

    Orange: singular border, white: distance of the nearest link angle from it, black: the path.
    """
    chart = findings.map
    figure, axes = new_figure(3, len(chart.phi), 1.8, False)
    rows = (
        (chart.frequency[..., 0], "lowest frequency [Hz]"),
        (100 * chart.spread, "spread of the first\nbending modes [%]"),
        (100 * chart.coupling.max(axis=-1), "largest coupling of\ntwo links [%]"),
    )
    path = np.array(findings.study.motion.waypoints)
    for row, (value, label) in enumerate(rows):
        limits = (float(np.nanpercentile(value, 1)), float(np.nanpercentile(value, 99)))
        for column, phi in enumerate(chart.phi):
            ax = axes[row, column]
            own_path = path[:, :2] if np.allclose(path[:, 2], phi) else None
            image = plots.workspace_map(chart, column, value[column], own_path, ax, limits)
            if row == 0:
                ax.set_title(f"φ = {np.degrees(phi):.0f}°")
            if row == 2:
                ax.set_xlabel("x [mm]")
        axes[row, 0].set_ylabel("y [mm]")
        figure.colorbar(image, ax=list(axes[row]), label=label, extend="both")
    return figure


def participation(findings: AtlasFindings) -> Figure:
    """Participation of the links in the first three bending modes."""
    chart = findings.map
    middle = len(chart.phi) // 2
    figure, axes = new_figure(3, 3, 1.8, False)
    for row in range(3):
        for link in range(3):
            ax = axes[row, link]
            value = 100 * chart.share[middle, :, :, row, link]
            image = plots.workspace_map(chart, middle, value, None, ax, (0.0, 100.0))
            rows, columns = np.nonzero(np.isfinite(value))
            ax.set_xlim(1e3 * chart.x[columns.min() - 1], 1e3 * chart.x[columns.max() + 1])
            ax.set_ylim(1e3 * chart.y[rows.min() - 1], 1e3 * chart.y[rows.max() + 1])
            if row == 0:
                ax.set_title(f"link {link + 1}")
            if row == 2:
                ax.set_xlabel("x [mm]")
        axes[row, 0].set_ylabel(f"bending mode {row + 1}\ny [mm]")
    figure.colorbar(image, ax=list(axes.flat), label="share of the strain energy [%]", shrink=0.5)
    return figure


def modes(findings: AtlasFindings) -> Figure:
    """Natural modes, deflections exaggerated, and the links' shares of the strain energy."""
    figure, axes = new_figure(3, 3, 2.2, False)
    home, far = findings.poses
    first = np.sort(np.argsort(-findings.modes.order_share[:, :, 0], axis=1)[:, :3], axis=1)
    chosen = [(0, k) for k in range(3)] + [(0, k) for k in first[0]] + [(1, k) for k in first[1]]
    for ax, (place, k) in zip(axes.flat, chosen, strict=True):
        parts = mode_skeleton(findings.study, (home, far)[place], findings.modes.shape[place, :, k])
        draw_mode(parts, ax)
        share = findings.modes.share[place, k]
        names = [f"{100 * s:.0f} %" for s in share[:3]]
        ax.set_title(
            f"{findings.modes.frequency[place, k]:.1f} Hz; "
            + (f"links {', '.join(names)}" if share[3] < 0.5 else f"drive {100 * share[3]:.0f} %"),
            fontsize=SMALL,
        )
        ax.set_xlabel("")
        ax.set_ylabel("")
        ax.set_xticks([])
        ax.set_yticks([])
        ax.grid(False)
        ax.spines[:].set_visible(False)
    place = f"({1e3 * far[0]:.0f}, {1e3 * far[1]:.0f}) mm: bending"
    for row, text in enumerate(("first pose: on the drive", "first pose: bending", place)):
        axes[row, 0].set_ylabel(text)
    return figure


def platform(findings: AtlasFindings) -> Figure:
    """Platform error: due to the drive, and added by the bending of the links."""
    runs = findings.platform
    figure, axes = new_figure(4, len(RUNS), 1.7)
    for column, setting in enumerate(RUNS):
        axes[0, column].set_title(setting_label(setting))
        for k, name in enumerate("xy"):
            axes[0, column].plot(
                runs.time,
                1e6 * runs.drive[column, :, k],
                color=SERIES[k],
                linewidth=1.0,
                linestyle=("-", "--")[k],
                label=f"drive error {name}",
            )
        for k, label in enumerate(_ERRORS):
            ax = axes[k + 1, column]
            error = 1e9 * runs.vibration[column, :, :, k]
            comparison(runs.time, error[0], error[-1], f"vibration error\n{label}", ax)
            ax.axvline(runs.command_end[column], color="#888888", linewidth=0.8, linestyle=":")
        axes[3, column].set_xlabel("time [s]")
    axes[0, 0].set_ylabel("drive error [µm]")
    legend_above(figure, axes[0, 0], axes[1, 0])
    return figure


def vibration(findings: AtlasFindings) -> Figure:
    """Vibration error of the platform after the reference trajectory."""
    runs = findings.platform
    figure, axes = new_figure(3, len(RUNS), 1.9)
    for column, setting in enumerate(RUNS):
        axes[0, column].set_title(setting_label(setting))
        end = runs.command_end[column]
        shown = min(0.15, runs.time[-1] - end)
        part = (runs.time >= end) & (runs.time <= end + shown)
        late = (runs.time >= end + shown * 4 / 15) & part  # the drive has nearly settled
        for k, label in enumerate(_ERRORS):
            ax = axes[k, column]
            error = 1e9 * runs.vibration[column, :, :, k]
            for text, curve, style in zip(_SETS, error, plots.SET_STYLES, strict=True):
                ax.plot(runs.time[part] - end, curve[part], **{**style, "label": text})
            top = 1.5 * np.abs(error[:, late]).max()
            ax.set_ylim(-top, top)
            ax.margins(x=0.01)
            if column == 0:
                ax.set_ylabel(f"vibration error\n{label}")
        axes[2, column].set_xlabel("time after the move [s]")
    legend_above(figure, axes[0, 0])
    return figure


def responses(findings: AtlasFindings) -> Figure:
    """Frequency responses of the sampled loop."""
    size = np.abs(findings.responses.value)
    figure, axes = new_figure(2, 2, 2.3)
    shown = (
        ("slider 1 to mid-span\nof link 1 [m/N]", 0, 0),
        ("slider 1 to mid-span\nof link 2 [m/N]", 1, 0),
        ("platform y to mid-span\nof link 1 [m/N]", 0, 4),
        ("platform y to y\n[m/N]", 4, 4),
    )
    for ax, (label, output, source) in zip(axes.flat, shown, strict=True):
        curves = {text: size[k, :, output, source] for k, text in enumerate(_SETS)}
        plots.response(findings.responses.frequency, curves, label, ax)
    for ax in axes[-1]:
        ax.set_xlabel("frequency [Hz]")
    legend_above(figure, axes[0, 0])
    return figure


def write_animation(findings: AtlasFindings, folder: Path) -> None:
    """The machine after its faster move, without control and with all links controlled."""
    runs, which = findings.platform, len(RUNS) - 1
    end = runs.command_end[which]
    time = end + np.arange(*CLIP)
    index = np.searchsorted(runs.time, time - 1e-9)
    index = index[index < len(runs.time)]
    q = runs.modal[which, :, index]
    peak = np.abs(runs.modal[which, 0, runs.time >= end, :, 0]).max(initial=1e-9)
    factor = float(
        f"{CLIP_SIZE * findings.study.each_link(findings.study.link.length).min() / peak:.1g}"
    )
    off, on = (
        skeleton(findings.study, runs.pose[which, k, index], q[:, k], factor) for k in (0, -1)
    )
    titles = ("without control", "three links controlled")
    animate(Clip(runs.time[index] - end, (off, on), titles, factor), folder / ANIMATION)
