"""The next experiment: which measurement, taken next, would tell most about what is still open.

A measurement has a Jacobian before it is taken, so that its information can be added to what the
data say already. Candidates are the frequencies and damping ratios of the first modes, and
responses from every actuator, slider and hammer to every sensor and deflection, at poses around
home.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import product
from typing import NamedTuple

import numpy as np

from jaxmodel.beam import BASES
from studies.errors import StudyError
from studies.fitting.bench import Bench, Modes, PlantAt, Pose, response
from studies.fitting.kinds.modes import mode_slopes
from studies.space.free import FreeNumbers
from studies.study.signals import Signal, signal_name

#: Noise of the responses: share of the value, and of the largest value.
RELATIVE, FLOOR = 0.02, 0.002
#: Noise of the modes: share of the frequency, and of the damping ratio.
FREQUENCY, DAMPING = 0.003, 0.1
#: Frequencies of a candidate, spread about the model's modes.
POINTS = 120
#: How far from home candidates are taken [m; rad].
SHIFT, TURN = 0.02, 0.15
#: Modes that a measurement covers.
COVERED = 9


class Experiment(NamedTuple):
    """One measurement that could be taken."""

    pose: Pose
    text: str
    widest: float  # standard deviation of the widest direction afterwards, between the bounds [1]


def next_experiments(
    bench: Bench, free: FreeNumbers, u: np.ndarray, covariance: np.ndarray
) -> list[Experiment]:
    """Candidates, the most telling first.

    Args:
        bench: the model.
        free: its parameters.
        u: the optimum, between the bounds, (p,).
        covariance: there, (p, p).
    """
    prior = np.linalg.inv(covariance + 1e-18 * np.eye(len(u)))
    values, slopes = free.values(u), free.slopes(u)
    experiments = []
    for pose in _poses(bench):
        try:
            plant = bench.plant(pose, values, True)
        except StudyError:  # the fitted machine does not reach it
            continue
        for text, slope in _candidates(bench, plant):
            by = slope[np.isfinite(slope).all(axis=1)] * slopes
            after = np.linalg.inv(prior + (by.conj().T @ by).real)
            experiments.append(
                Experiment(pose, text, float(np.sqrt(np.linalg.eigvalsh(after)[-1])))
            )
    return sorted(experiments, key=lambda x: x.widest)


def _candidates(bench: Bench, plant: PlantAt) -> Iterator[tuple[str, np.ndarray]]:
    """What could be measured at a pose, and derivatives over the noise, (n, p)."""
    assert plant.slope is not None
    with suppress(np.linalg.LinAlgError):
        whole = plant.modes
        pole = whole.pole[:COVERED]
        first = Modes(pole, whole.shape[:, :COVERED], whole.dual[:COVERED])
        by_frequency, by_damping = mode_slopes(first, plant.slope.state)
        size, ratio = np.abs(pole) / (2 * np.pi), -pole.real / np.abs(pole)
        noise = FREQUENCY * size, DAMPING * np.maximum(ratio, 1e-4)
        slopes = [by_frequency / noise[0][:, None], by_damping / noise[1][:, None]]
        yield f"frequencies and damping of {len(pole)} modes", np.concatenate(slopes)
    frequency = _about_modes(plant)
    for source, output in _pairs(bench):
        signals = source, output
        one = response(plant, signals, bench.places(signals), 2 * np.pi * frequency)
        assert one.slope is not None
        size = np.abs(one.value)
        sigma = np.hypot(RELATIVE * size, FLOOR * size.max())
        yield f"{signal_name(source)} to {signal_name(output)}", one.slope / sigma[:, None]


def _poses(bench: Bench) -> list[Pose]:
    """Home and poses around it that the machine reaches."""
    x, y, phi = bench.study.motion.waypoints[0]
    shifts = [(0.0, 0.0, 0.0), *((s * SHIFT, 0.0, 0.0) for s in (1, -1))]
    shifts += [*((0.0, s * SHIFT, 0.0) for s in (1, -1)), *((0.0, 0.0, s * TURN) for s in (1, -1))]
    kept = []
    for dx, dy, turn in shifts:
        pose = (x + dx, y + dy, phi + turn)
        try:
            bench.check(pose, "pose")
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
    if BASES[bench.study.link.basis].is_on_chord:
        place = bench.stations[len(bench.stations) // 2]
        sources += [Signal("hammer", i, 0, place) for i in links]
        outputs += [Signal("deflection", i, 0, place) for i in links]
    return list(product(sources, outputs))


def _about_modes(plant: PlantAt) -> np.ndarray:
    """Frequencies [Hz] that are dense about the first modes, none at a mode itself.

    There, a machine without damping has no response.
    """
    modes = np.abs(plant.eigen.pole[plant.eigen.upper[:COVERED]]) / (2 * np.pi)
    count = POINTS // len(modes) // 2 * 2
    each = np.concatenate([f * np.linspace(0.85, 1.15, count) for f in modes])
    return np.unique(each)
