"""Drawings of the mechanism, still, as mode shapes, and animated."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.show.figures import SERIES, SMALL, WIDTH, axes_or_new, styled
from studies.show.skeleton import Skeleton, skeleton
from studies.study.cases import build_structure
from studies.study.spec import Study

#: Largest drawn deflection of a link, as a share of its length [1].
DRAWN = 0.12
#: Largest drawn displacement of the platform in a mode shape, as a share of a link's length [1].
DRAWN_POSE = 0.05


def draw_machine(
    parts: Skeleton, k: int, ax: Axes | None = None, color: str = SERIES[0], alpha: float = 1.0
) -> Axes:
    """The machine at instant k of a `skeleton`.

    Args:
        parts: where everything is [m].
        k: which instant.
        ax: where to draw; default: a new figure.
        color: of links and platform.
        alpha: opacity [1].
    """
    ax = axes_or_new(ax)
    for start, end in parts.carrier[k]:
        ax.plot(*zip(1e3 * start, 1e3 * end, strict=True), color="#AAAAAA", linewidth=2.5, zorder=0)
    ax.fill(*(1e3 * parts.joint[k].T), color=color, alpha=0.25 * alpha, linewidth=0)
    for link in parts.link[k]:
        ax.plot(*(1e3 * link.T), color=color, linewidth=1.6, alpha=alpha)
    ax.plot(*(1e3 * parts.near[k].T), "s", color="#333333", markersize=4, alpha=alpha)
    ax.plot(*(1e3 * parts.joint[k].T), "o", color="#333333", markersize=2.5, alpha=alpha)
    ax.set_aspect("equal")
    ax.set_xlabel("x [mm]")
    ax.set_ylabel("y [mm]")
    return ax


def number_links(parts: Skeleton, k: int, ax: Axes) -> None:
    """Write link numbers next to the sliders, on the side away from the machine."""
    away = parts.near[k] - parts.joint[k].mean(axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    for i, (near, side) in enumerate(zip(parts.near[k], away, strict=True)):
        ax.annotate(
            str(i + 1),
            1e3 * near,
            10 * side,
            textcoords="offset points",
            fontsize=SMALL,
            ha="center",
            va="center",
        )


def mode_skeleton(study: Study, pose: np.ndarray, shape: np.ndarray) -> Skeleton:
    """A natural mode at its two turning points and at rest, drawn large.

    Args:
        study: the machine.
        pose: at rest [m, m, rad], (n,) coordinates.
        shape: of the mode over (X, q), (n + links x R,); elongations are not drawn.
    """
    n, length = study.n_pose, study.each_link(study.link.length).min()
    q = shape[n:].reshape(study.n_links, -1)
    arm = study.each_link(study.machine.joint_radius).mean()
    size = np.abs(shape[:n]) * np.array([1, 1, arm])[:n]
    factor = min(
        DRAWN * length / max(np.abs(q).max(), 1e-300), DRAWN_POSE * length / max(size.max(), 1e-300)
    )
    phases = np.array([0.0, 1.0, -1.0])
    moved = pose + factor * phases[:, None] * shape[:n]
    bent = q[:, :-1] if build_structure(study).has_stretch else q
    return skeleton(study, moved, factor * phases[:, None, None] * bent, 1.0)


def draw_mode(parts: Skeleton, ax: Axes | None = None) -> Axes:
    """A `mode_skeleton`: at rest pale, at its turning points in two colours."""
    ax = draw_machine(parts, 0, ax, "#999999", 0.6)
    number_links(parts, 0, ax)
    draw_machine(parts, 1, ax, SERIES[0])
    return draw_machine(parts, 2, ax, SERIES[1], 0.8)


class Clip(NamedTuple):
    """Two motions of one machine, side by side."""

    time: np.ndarray  # from the end of the command [s], (T,)
    parts: tuple[Skeleton, Skeleton]
    titles: tuple[str, str]
    exaggeration: float


def animate(clip: Clip, path: Path) -> None:
    """Write the clip as a GIF.

    Args:
        clip: what moves.
        path: file, whose name ends in .gif.
    """
    with styled():
        figure = Figure(figsize=(WIDTH, 3.9), layout="constrained")
        axes = figure.subplots(1, 2)
        label = figure.supxlabel(" ", fontsize=9)
        lines = [_moving(parts, ax) for parts, ax in zip(clip.parts, axes, strict=True)]
        for ax, title in zip(axes, clip.titles, strict=True):
            ax.set_title(title)
            ax.set_axis_off()
        for parts, ax in zip(clip.parts, axes, strict=True):
            number_links(parts, 0, ax)

        def frame(k: int) -> list[Any]:
            label.set_text(
                f"{1e3 * clip.time[k]:+.0f} ms from the end of the move; bending drawn "
                f"{clip.exaggeration:.0f} times"
            )
            for parts, (carried, near, joints, plate) in zip(clip.parts, lines, strict=True):
                for line, points in zip(carried, [*parts.carrier[k], *parts.link[k]], strict=True):
                    line.set_data(*(1e3 * points.T))
                near.set_data(*(1e3 * parts.near[k].T))
                joints.set_data(*(1e3 * parts.joint[k].T))
                plate.set_xy(1e3 * parts.joint[k])
            return []

        frame(0)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # a new layout for every frame takes most of the time
        film = FuncAnimation(figure, frame, frames=len(clip.time), interval=50, blit=False)
        film.save(path, writer=PillowWriter(fps=20), dpi=80)


def _moving(parts: Skeleton, ax: Axes) -> tuple[Any, ...]:
    draw_machine(parts, 0, ax)
    *carried, near, joints = ax.lines
    return carried, near, joints, ax.patches[0]
