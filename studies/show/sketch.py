"""A sketch of a machine at the first way-point of its study, for reports."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from studies.show import figures
from studies.study.consistency import patch_centers
from studies.study.geometry import far_joints, machine_geometry
from studies.study.spec import Study

#: Colours of controlled links, other links, actuators and sensors.
ON, OFF, ACTUATOR, SENSOR = figures.SERIES[0], "#888888", figures.SERIES[1], figures.SERIES[2]
#: How far patches stand out of a link of the whole machine, as a share of the machine's size.
OUTSTANDING = 0.018
#: Largest thickness drawn, as a share of the longest link, and factors on true thickness.
THICKEST, FACTORS = 0.1, (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)
#: The path is drawn at least this long, as a share of the machine's size.
SHORTEST_PATH = 0.08


def sketch(study: Study) -> Figure:
    """The machine with its patches, platform and path; beside it links to scale."""
    pose = np.array(study.motion.waypoints[0], float)
    near, joint = standing(study, pose)
    figure = Figure(figsize=(figures.WIDTH, 3.0), layout="constrained")
    ax: Axes
    ax, below = figure.subplots(1, 2, width_ratios=(1.0, 1.3))
    _carriers(ax, study, near)
    ax.fill(*(1e3 * joint.T), color="#DDDDDD", zorder=1)
    for i, (start, end) in enumerate(zip(near, joint, strict=True)):
        _link(ax, study, i, start, end)
    ax.plot(*(1e3 * near.T), "s", color="#333333", markersize=6, zorder=4)
    ax.plot(*(1e3 * joint.T), "o", color="#333333", markersize=3, zorder=4)
    for i, start in enumerate(near):
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
    if study.load.mass and len(pose) > 2:
        turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
        center = pose[:2] + turn @ np.array(study.load.offset)
        ax.plot(*(1e3 * center), "P", color="black", markersize=6, zorder=5)
    ax.set_aspect("equal")
    ax.margins(0.14)
    ax.set(xlabel="x [mm]", ylabel="y [mm]")
    _links_to_scale(below, study)
    return figure


def standing(study: Study, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints B and C [m] of straight links at a pose, (n, 2) each; NaN out of reach."""
    (geometry, _), length = machine_geometry(study), study.each_link(study.link.length)
    joint, _ = far_joints(geometry, pose, study.n_links)
    near = geometry.legs(np).near(*joint.T, length**2, 0.0, np)
    away = np.stack(near.to_far(), axis=1)
    return np.where(near.root_squared[:, None] < 0, np.nan, joint - away), joint


def _carriers(ax: Axes, study: Study, near: np.ndarray) -> None:
    geometry, near_mass = machine_geometry(study)
    for carrier, joint in zip(geometry.carriers(near_mass), near, strict=True):
        ax.plot(*(1e3 * carrier.line(joint).T), color="#BBBBBB", linewidth=3, zorder=0)


def _link(ax: Axes, study: Study, i: int, start: np.ndarray, end: np.ndarray) -> None:
    ax.plot(
        *(1e3 * np.stack([start, end], axis=1)), color=_color(study, i), linewidth=1.5, zorder=3
    )
    along = (end - start) / np.linalg.norm(end - start)
    out = OUTSTANDING * machine_geometry(study)[0].size() * np.array([-along[1], along[0]])
    patches = study.patches
    for size, color, side in (
        (study.each_link(patches.actuator_length)[i], ACTUATOR, out),
        (study.each_link(patches.sensor_length)[i], SENSOR, -out),
    ):
        for center in patch_centers(study)[i]:
            first, last = (start + (center + x) * along for x in (-size / 2, size / 2))
            corners = np.array([first, last, last + side, first + side])
            ax.fill(*(1e3 * corners.T), color=color, linewidth=0, zorder=2)


def _color(study: Study, i: int) -> str:
    return ON if study.control.feedback != "none" and study.control.links[i] else OFF


class Part(NamedTuple):
    """A link or a patch on it: its extent along the link and, on its edge, across [m]."""

    color: str
    start: float
    length: float
    width: float
    bottom: float
    thickness: float


def link_parts(study: Study, i: int) -> list[Part]:
    """Link i and its patches; the longer ones of a pair come first."""
    link, patches = study.link, study.patches
    length, width, thickness = (
        float(study.each_link(x)[i]) for x in (link.length, link.width, link.thickness)
    )
    across, ceramic = (float(study.each_link(x)[i]) for x in (patches.width, patches.thickness))
    kinds = [
        (float(study.each_link(patches.actuator_length)[i]), ACTUATOR, thickness / 2),
        (float(study.each_link(patches.sensor_length)[i]), SENSOR, -thickness / 2 - ceramic),
    ]
    body = Part(
        color=_color(study, i),
        start=0.0,
        length=length,
        width=width,
        bottom=-thickness / 2,
        thickness=thickness,
    )
    return [body] + [
        Part(
            color=color,
            start=center - size / 2,
            length=size,
            width=across,
            bottom=bottom,
            thickness=ceramic,
        )
        for size, color, bottom in sorted(kinds, reverse=True)
        for center in map(float, patch_centers(study)[i])
    ]


def _links_to_scale(ax: Axes, study: Study) -> None:
    """Faces and edges of the links, one below another, in millimetres."""
    links = [link_parts(study, i) for i in range(study.n_links)]
    height = max(parts[0].thickness + 2 * parts[-1].thickness for parts in links)
    longest = max(parts[0].length for parts in links)
    factor = max((x for x in FACTORS if x * height <= THICKEST * longest), default=FACTORS[0])
    gap, half, low, ticks = 20 * longest, 500 * factor * height, 0.0, []
    for parts in links:
        face = low - 500 * parts[0].width
        edge = face - 500 * parts[0].width - gap - half
        for part in parts:
            at, size = 1e3 * part.start, 1e3 * part.length
            for bottom, across in (
                (face - 500 * part.width, 1e3 * part.width),
                (edge + 1e3 * factor * part.bottom, 1e3 * factor * part.thickness),
            ):
                ax.add_patch(Rectangle((at, bottom), size, across, color=part.color, linewidth=0))
        ticks.append((face + edge) / 2)
        low = edge - half - 2 * gap
    ax.set_xlim(0, 1e3 * longest)
    ax.set_ylim(low + gap, gap)
    ax.set_aspect("equal")
    ax.set_yticks(ticks, [f"link {i + 1}" for i in range(study.n_links)])
    ax.tick_params(axis="y", length=0)
    ax.grid(False)
    ax.set_xlabel("from the actuated joint [mm]")
    ax.set_title(f"edges drawn {factor:g} times as thick", fontsize=8, loc="left")


def _path(ax: Axes, study: Study, pose: np.ndarray) -> None:
    points = np.array(study.motion.waypoints, float)[:, :2]
    size = np.linalg.norm(np.ptp(points, axis=0))
    least = SHORTEST_PATH * machine_geometry(study)[0].size()
    factor = np.ceil(least / size) if 0 < size < least else 1.0
    drawn = 1e3 * (pose[:2] + factor * (points - pose[:2]))
    ax.plot(*drawn.T, color="#C00000", linewidth=1.2, zorder=5)
    ax.plot(*drawn[0], ".", color="#C00000", zorder=5)
    if factor > 1:
        ax.set_title(f"path drawn {factor:g} times its size", fontsize=figures.SMALL, loc="left")
