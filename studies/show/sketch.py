"""A sketch of a machine at the first way-point of its study, for reports."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel.case import Case
from studies.show import figures
from studies.study.cases import build_case
from studies.study.consistency import each_link, patch_centers
from studies.study.spec import Study

#: Colours of controlled links, other links, and patches.
ON, OFF, PATCH = figures.SERIES[0], "#888888", figures.SERIES[1]
CAPTION = (
    "The machine at its first way-point; blue: links under control, grey: the others, orange: "
    "patches, red: the path of the platform's reference point, enlarged where it is short, black "
    "cross: a payload's centre of mass"
)
#: The path is drawn at least this long, as a share of the guides' side.
SHORTEST_PATH = 0.08


def sketch(study: Study) -> Figure:
    """Guides, sliders, links with their patches, platform and path."""
    case, pose = build_case(study), np.array(study.motion.waypoints[0], float)
    slider, joint = standing(case, pose)
    figure = Figure(figsize=(3.4, 3.0), layout="constrained")
    ax: Axes = figure.subplots()
    _guides(ax, study, case)
    ax.fill(*(1e3 * joint.T), color="#DDDDDD", zorder=1)
    for i, (start, end) in enumerate(zip(slider, joint, strict=True)):
        _link(ax, study, i, start, end)
    ax.plot(*(1e3 * slider.T), "s", color="#333333", markersize=6, zorder=4)
    ax.plot(*(1e3 * joint.T), "o", color="#333333", markersize=3, zorder=4)
    for i, start in enumerate(slider):
        away = (start - joint.mean(axis=0)) / np.linalg.norm(start - joint.mean(axis=0))
        ax.annotate(
            str(i + 1),
            1e3 * start,
            12 * away,
            textcoords="offset points",
            ha="center",
            va="center",
        )
    _path(ax, study, pose)
    if study.load.mass:
        turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
        center = pose[:2] + turn @ np.array(study.load.offset)
        ax.plot(*(1e3 * center), "P", color="black", markersize=6, zorder=5)
    ax.set_aspect("equal")
    ax.margins(0.14)
    ax.set(xlabel="x [mm]", ylabel="y [mm]")
    return figure


def standing(case: Case, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sliders B and joints C [m] of straight links at a pose, (3, 2) each; NaN out of reach."""
    u, n, corner = guides(case)
    angle = case.machine.geometry.joint_angle + pose[2]
    radius = np.asarray(case.machine.geometry.joint_radius)[..., None]
    joint = pose[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    away = joint - corner
    height, length = np.sum(n * away, axis=1), each_link(case.machine.beam.length)
    with np.errstate(invalid="ignore"):
        rho = np.sum(u * away, axis=1) - np.sqrt(length**2 - height**2)
    return corner + rho[:, None] * u, joint


def guides(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions and inward normals of the guides, and where they start [m], (3, 2) each."""
    geometry = case.machine.geometry
    angle, side = np.asarray(geometry.guide_angle), float(geometry.guide_side)
    u = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    n = np.stack([-u[:, 1], u[:, 0]], axis=1)
    away = side / np.sqrt(12.0) + each_link(geometry.guide_offset)
    return u, n, -away[:, None] * n - side / 2 * u


def _guides(ax: Axes, study: Study, case: Case) -> None:
    u, _, corner = guides(case)
    for start, end in zip(corner, corner + study.machine.guide_side * u, strict=True):
        ax.plot(*(1e3 * np.stack([start, end], axis=1)), color="#BBBBBB", linewidth=3, zorder=0)


def _link(ax: Axes, study: Study, i: int, start: np.ndarray, end: np.ndarray) -> None:
    is_on = study.control.feedback != "none" and study.control.links[i]
    ax.plot(
        *(1e3 * np.stack([start, end], axis=1)), color=ON if is_on else OFF, linewidth=2, zorder=2
    )
    length = each_link(study.link.length)[i]
    for center in patch_centers(study)[i]:
        half = each_link(study.patches.actuator_length)[i] / 2
        places = [start + (end - start) * (center + x) / length for x in (-half, half)]
        ax.plot(
            *(1e3 * np.stack(places, axis=1)),
            color=PATCH,
            linewidth=5,
            zorder=3,
            solid_capstyle="butt",
        )


def _path(ax: Axes, study: Study, pose: np.ndarray) -> None:
    points = np.array(study.motion.waypoints, float)[:, :2]
    size = np.linalg.norm(np.ptp(points, axis=0))
    least = SHORTEST_PATH * study.machine.guide_side
    factor = np.ceil(least / size) if 0 < size < least else 1.0
    drawn = 1e3 * (pose[:2] + factor * (points - pose[:2]))
    ax.plot(*drawn.T, color="#C00000", linewidth=1.2, zorder=5)
    ax.plot(*drawn[0], ".", color="#C00000", zorder=5)
    if factor > 1:
        ax.set_title(f"path drawn {factor:g} times its size", fontsize=figures.SMALL, loc="left")
