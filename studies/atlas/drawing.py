"""Drawings of the mechanism, still, as mode shapes, and animated."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel.beam import build_basis
from jaxmodel.case import Case, Structure
from jaxmodel.dynamics import modal_chain
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.show.figures import SERIES, SMALL, WIDTH, axes_or_new, styled
from studies.show.sketch import guides
from studies.study.consistency import each_link
from studies.study.spec import Study

#: Points along a link.
_POINTS = 41
#: Largest drawn deflection of a link, as a share of its length [1].
DRAWN = 0.12
#: Largest drawn displacement of the platform in a mode shape, as a share of a link's length [1].
DRAWN_POSE = 0.05


class Skeleton(NamedTuple):
    """Positions of all parts, (T, ...) in metres."""

    guide: np.ndarray  # ends of the guides, (3, 2, 2)
    slider: np.ndarray  # B, (T, 3, 2)
    joint: np.ndarray  # C, (T, 3, 2)
    link: np.ndarray  # points along the links, (T, 3, points, 2)


def skeleton(study: Study, pose: np.ndarray, q: np.ndarray, exaggeration: float) -> Skeleton:
    """Positions of the machine's parts, with exaggerated bending.

    Args:
        study: the machine.
        pose: (x, y, phi) [m, m, rad], (T, 3).
        q: modal coordinates of the plant [m], (T, 3, R).
        exaggeration: factor on the bending [1].
    """
    structure, case = check_run(study.change(link__modes=q.shape[-1], control__feedback="none"))
    slider, joint, link = (
        np.asarray(part)
        for part in _positions(structure._replace(n_steps=1), case, pose, q, exaggeration)
    )
    direction, _, start = guides(case)
    end = start + study.machine.guide_side * direction
    return Skeleton(np.stack([start, end], axis=1), slider, joint, link)


@kept_jit(static_argnums=0)
def _positions(
    structure: Structure, case: Case, pose: Array, q: Array, exaggeration: Array
) -> tuple[Array, Array, Array]:
    plant = prepare(structure, case).loop.plant
    machine = case.machine
    along = jnp.linspace(0.0, 1.0, _POINTS)
    shape = build_basis(
        structure.basis,
        machine.beam,
        machine.patches,
        structure.n_modes,
        plant.length[:, None] * along,
    ).deflection_at
    u = jnp.stack([plant.ux, plant.uy], axis=1)
    n = jnp.stack([-plant.uy, plant.ux], axis=1)
    corner = -plant.h0[:, None] * n - plant.s0[:, None] * u

    def one(pose: Array, q: Array) -> tuple[Array, Array, Array]:
        chain = modal_chain(plant, pose, jnp.zeros_like(pose), q, jnp.zeros_like(q))
        slider = corner + chain.rho[:, None] * u
        joint = pose[:2] + jnp.stack([chain.cx, chain.cy], axis=1)
        chord = joint - slider
        across = jnp.stack([-chord[:, 1], chord[:, 0]], axis=1) / plant.length[:, None]
        bent = exaggeration * jnp.einsum("isr,ir->is", shape, q)
        straight = slider[:, None] + along[:, None] * chord[:, None]
        return slider, joint, straight + bent[..., None] * across[:, None]

    return jax.vmap(one)(pose, q)


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
    for start, end in parts.guide:
        ax.plot(*zip(1e3 * start, 1e3 * end, strict=True), color="#AAAAAA", linewidth=2.5, zorder=0)
    ax.fill(*(1e3 * parts.joint[k].T), color=color, alpha=0.25 * alpha, linewidth=0)
    for link in parts.link[k]:
        ax.plot(*(1e3 * link.T), color=color, linewidth=1.6, alpha=alpha)
    ax.plot(*(1e3 * parts.slider[k].T), "s", color="#333333", markersize=4, alpha=alpha)
    ax.plot(*(1e3 * parts.joint[k].T), "o", color="#333333", markersize=2.5, alpha=alpha)
    ax.set_aspect("equal")
    ax.set_xlabel("x [mm]")
    ax.set_ylabel("y [mm]")
    return ax


def number_links(parts: Skeleton, k: int, ax: Axes) -> None:
    """Write link numbers next to the sliders, on the side away from the machine."""
    away = parts.slider[k] - parts.joint[k].mean(axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    for i, (slider, side) in enumerate(zip(parts.slider[k], away, strict=True)):
        ax.annotate(
            str(i + 1),
            1e3 * slider,
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
        pose: at rest [m, m, rad], (3,).
        shape: of the mode over (X, q), (3 + 3R,).
    """
    length, q = each_link(study.link.length).min(), shape[3:].reshape(3, -1)
    size = np.abs(shape[:3]) * [1, 1, each_link(study.machine.joint_radius).mean()]
    factor = min(
        DRAWN * length / max(np.abs(q).max(), 1e-300), DRAWN_POSE * length / max(size.max(), 1e-300)
    )
    phases = np.array([0.0, 1.0, -1.0])
    moved = pose + factor * phases[:, None] * shape[:3]
    return skeleton(study, moved, factor * phases[:, None, None] * q, 1.0)


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
            for parts, (links, sliders, joints, plate) in zip(clip.parts, lines, strict=True):
                for line, points in zip(links, parts.link[k], strict=True):
                    line.set_data(*(1e3 * points.T))
                sliders.set_data(*(1e3 * parts.slider[k].T))
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
    links = ax.lines[3:6]
    return links, ax.lines[6], ax.lines[7], ax.patches[0]
