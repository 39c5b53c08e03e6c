"""The next experiment: which response, taken next, would tell most about what is still open.

A frequency response has a Jacobian before it is measured, so that its information can be added to
what the data say already. Candidates are responses from every actuator and slider to every sensor
at poses around home.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.fitting.bench import Bench, PlantAt, Pose, response
from studies.fitting.signals import Signal
from studies.space.free import FreeNumbers

#: Noise of the responses: share of the value, and of the largest value.
RELATIVE, FLOOR = 0.02, 0.002
#: Frequencies of a candidate, spread about the model's modes.
POINTS = 120
#: How far from home candidates are taken [m; rad].
SHIFT, TURN = 0.02, 0.15
#: Modes that responses cover.
COVERED = 9


class Experiment(NamedTuple):
    """One response that could be measured."""

    pose: Pose
    source: Signal
    output: Signal
    widest: float  # standard deviation of the widest direction afterwards, between the bounds [1]

    @property
    def text(self) -> str:
        """In words."""
        return f"{_name(self.source)} to {_name(self.output)}"


def _name(signal: Signal) -> str:
    patch = f".{signal.patch + 1}" if signal.kind in ("actuator", "sensor") else ""
    return f"{signal.kind} {signal.link + 1}{patch}"


def next_experiments(
    bench: Bench, free: FreeNumbers, u: np.ndarray, covariance: np.ndarray
) -> list[Experiment]:
    """Candidates, the most telling first.

    Args:
        bench: the model.
        free: its free numbers.
        u: the optimum, between the bounds, (p,).
        covariance: there, (p, p).
    """
    known = np.linalg.inv(covariance + 1e-18 * np.eye(len(u)))
    values, slopes = free.values(u), free.slopes(u)
    found = []
    for pose in _poses(bench):
        plant = bench.plant(pose, values, True)
        frequency = _about_modes(plant)
        for source, output in _pairs(bench):
            one = response(
                plant,
                plant.input(source, source.row(bench.n_patches, bench.stations)),
                plant.output(output, output.row(bench.n_patches, bench.stations)),
                2 * np.pi * frequency,
            )
            assert one.slope is not None
            size = np.abs(one.value)
            sigma = np.hypot(RELATIVE * size, FLOOR * size.max())
            by = one.slope * slopes / sigma[:, None]
            after = np.linalg.inv(known + (by.conj().T @ by).real)
            widest = float(np.sqrt(np.linalg.eigvalsh(after)[-1]))
            found.append(Experiment(pose, source, output, widest))
    return sorted(found, key=lambda x: x.widest)


def _poses(bench: Bench) -> list[Pose]:
    """Home and poses around it that the machine reaches."""
    x, y, phi = bench.study.motion.waypoints[0]
    shifts = [(0.0, 0.0, 0.0), *((s * SHIFT, 0.0, 0.0) for s in (1, -1))]
    shifts += [*((0.0, s * SHIFT, 0.0) for s in (1, -1)), *((0.0, 0.0, s * TURN) for s in (1, -1))]
    kept = []
    for dx, dy, turn in shifts:
        pose = (x + dx, y + dy, phi + turn)
        try:
            bench.check(pose)
        except StudyError:
            continue
        kept.append(pose)
    return kept


def _pairs(bench: Bench) -> list[tuple[Signal, Signal]]:
    """Inputs and outputs of the machine."""
    links, patches = range(3), range(bench.n_patches)
    sources = [Signal("actuator", i, k, np.nan) for i, k in product(links, patches)]
    sources += [Signal("slider", i, 0, np.nan) for i in links]
    outputs = [Signal("sensor", i, k, np.nan) for i, k in product(links, patches)]
    return list(product(sources, outputs))


def _about_modes(plant: PlantAt) -> np.ndarray:
    """Frequencies [Hz] that are dense about the first modes."""
    modes = np.abs(plant.eigen.pole[plant.eigen.upper[:COVERED]]) / (2 * np.pi)
    each = np.concatenate([f * np.linspace(0.85, 1.15, POINTS // len(modes)) for f in modes])
    return np.unique(each)
