"""The next experiment: which measurement, taken next, would tell most about what is still open.

A measurement has a Jacobian before it is taken, so that its information can be added to what the
data say already. Where other optima explain the data as well, as links that can be exchanged do, it
must first tell them apart: chi square of the wrong ones has to rise by `APART`.

Candidates are what the user owns: the frequencies and damping ratios of the first modes, and
responses from every input to every output, at poses around home.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from typing import NamedTuple

import numpy as np

from jaxmodel.beam import BASES
from studies.errors import StudyError
from studies.fitting.bench import Bench, Modes, PlantAt, Pose, response
from studies.fitting.kinds.modes import mode_slopes
from studies.fitting.spec import MODES, Next, own_signal
from studies.results.labelled import Labelled, derived, told, unwritten
from studies.space.free import FreeNumbers
from studies.study.signals import PLACED, Signal, signal_name

#: Noise of the modes: share of the frequency, and of the damping ratio.
FREQUENCY, DAMPING = 0.003, 0.1
#: Frequencies of a candidate, spread about the model's modes.
POINTS = 120
#: How far from home candidates are taken [m; rad].
SHIFT, TURN = 0.02, 0.15
#: Modes that a measurement covers.
COVERED = 9
#: Rise of chi square at which another optimum is excluded [1].
APART = 20.0


class Experiment(Labelled):
    """One measurement that could be taken."""

    pose: tuple[float, ...] = told("[m, m, rad]")
    text: str = told("in words")
    widest: float = told("standard deviation of the widest direction then, over the bounds [1]")
    # rise of chi square of the other optimum that it tells least from the best [1]
    apart: float = unwritten()

    @derived("", "whether it excludes all other optima, with the measurements before it")
    def tells_apart(self) -> bool:
        return self.apart >= APART


class _Candidate(NamedTuple):
    """A measurement that could be taken, in standard deviations."""

    pose: Pose
    text: str
    by: np.ndarray  # derivatives by the places between the bounds, (n, p)
    apart: np.ndarray  # rise of chi square of each other optimum, (m,)


def next_experiments(
    bench: Bench,
    free: FreeNumbers,
    u: np.ndarray,
    covariance: np.ndarray,
    others: Sequence[np.ndarray] = (),
    own: Next | None = None,
) -> list[Experiment]:
    """What to measure, the most telling first.

    Args:
        bench: the model.
        free: its parameters.
        u: the optimum, between the bounds, (p,).
        covariance: there, (p, p).
        others: optima that explain the data as well, (p,) each.
        own: what can be measured with, and how many measurements at once; None: as usual.

    Returns:
        all candidates by rank; or, if several are taken at once, those: each is the most telling
        one beside those before it, and says what is known after all of them.
    """
    own = own or Next()
    prior = np.linalg.inv(covariance + 1e-18 * np.eye(len(u)))
    candidates = _candidates(bench, free, u, others, own)
    if own.count == 1:
        nothing = np.zeros(len(others))
        alone = [_experiment(x, prior, nothing) for x in candidates]
        return sorted(alone, key=_rank)
    program = []
    told = np.zeros(len(others))
    for _ in range(min(own.count, len(candidates))):
        found = [_experiment(x, prior, told) for x in candidates]
        k = min(range(len(found)), key=lambda k: _rank(found[k]))
        best = candidates.pop(k)
        program.append(found[k])
        prior, told = prior + (best.by.conj().T @ best.by).real, told + best.apart
    return program


def _experiment(x: _Candidate, prior: np.ndarray, told: np.ndarray) -> Experiment:
    """A candidate beside what is known already."""
    after = np.linalg.inv(prior + (x.by.conj().T @ x.by).real)
    widest = float(np.sqrt(np.linalg.eigvalsh(after)[-1]))
    apart = float((told + x.apart).min(initial=np.inf))
    return Experiment(pose=x.pose, text=x.text, widest=widest, apart=apart)


def _rank(x: Experiment) -> tuple[float, float]:
    """What comes first: excluding other optima, then narrow intervals."""
    return -min(x.apart, APART), x.widest


def _candidates(
    bench: Bench,
    free: FreeNumbers,
    u: np.ndarray,
    others: Sequence[np.ndarray],
    own: Next,
) -> list[_Candidate]:
    """What could be measured at all poses."""
    slopes, found = free.slopes(u), []
    for pose in _poses(bench):
        try:
            plants = [bench.plant(pose, free.values(u), True)]
            plants += [bench.plant(pose, free.values(x), False) for x in others]
        except StudyError:  # a fitted machine does not reach it
            continue
        for text, by, apart in _at_pose(bench, plants, own):
            whole = by[np.isfinite(by).all(axis=1)] * slopes
            found.append(_Candidate(pose=pose, text=text, by=whole, apart=apart))
    return found


def _at_pose(
    bench: Bench, plants: list[PlantAt], own: Next
) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Names, derivatives over the noise (n, p), and how far other optima are, (m,)."""
    found = []
    if MODES in own.outputs:
        with suppress(np.linalg.LinAlgError):
            found.append(_of_modes(plants))
    frequency = _about_modes(plants[0])
    for signals in _pairs(bench, own):
        at = bench.places(signals)
        # an acceleration is known as well as the displacement it comes from
        one, *rest = [response(x, signals, at, 2 * np.pi * frequency) for x in plants]
        assert one.slope is not None
        size = np.abs(one.value)
        share, floor = own.sigma_percent / 100, own.floor_percent / 100
        sigma = np.hypot(share * size, floor * size.max())
        apart = [float(np.sum(np.abs((x.value - one.value) / sigma) ** 2)) for x in rest]
        text = f"{signal_name(signals[0])} to {signal_name(signals[1])}"
        found.append((text, one.slope / sigma[:, None], np.array(apart)))
    return found


def _of_modes(plants: list[PlantAt]) -> tuple[str, np.ndarray, np.ndarray]:
    """The same of frequencies and damping ratios.

    Raises:
        numpy.linalg.LinAlgError: eigenvectors that are nearly dependent.
    """
    first, slope = plants[0].modes, plants[0].slope
    assert slope is not None
    pole = first.pole[:COVERED]
    first = Modes(pole, first.shape[:, :COVERED], first.dual[:COVERED])
    by_frequency, by_damping = mode_slopes(first, slope.state)
    size, ratio = np.abs(pole) / (2 * np.pi), -pole.real / np.abs(pole)
    noise = FREQUENCY * size, DAMPING * np.maximum(ratio, 1e-4)
    by = np.concatenate([by_frequency / noise[0][:, None], by_damping / noise[1][:, None]])
    apart = []
    for other in plants[1:]:
        theirs = other.modes.pole[:COVERED]
        count = min(len(theirs), len(pole))
        off = (np.abs(theirs[:count]) / (2 * np.pi) - size[:count]) / noise[0][:count]
        apart.append(float(np.sum(off**2)))
    return f"frequencies and damping of {len(pole)} modes", by, np.array(apart)


def _poses(bench: Bench) -> list[Pose]:
    """Home and poses around it that the machine reaches."""
    home = np.array(bench.study.motion.waypoints[0])
    steps = np.diag([SHIFT, SHIFT, TURN][: len(home)])
    kept = []
    for shift in (np.zeros(len(home)), *(sign * step for step in steps for sign in (1, -1))):
        pose = tuple((home + shift).tolist())
        try:
            bench.check(pose, "pose")
        except StudyError:
            continue
        kept.append(pose)
    return kept


def check_candidates(bench: Bench, own: Next) -> None:
    """Refuse instruments with which nothing can be measured.

    Raises:
        StudyError: no input and output belong together.
    """
    if MODES not in own.outputs and not _pairs(bench, own):
        raise StudyError(
            f"fit.next: no output of {', '.join(own.outputs)} belongs to an input of "
            f"{', '.join(own.inputs)}; allowed: a motor with the command of its own drive, hammers "
            "and deflections in a basis whose ends are on the chord, or 'modes'"
        )


def _pairs(bench: Bench, own: Next) -> list[tuple[Signal, Signal]]:
    """Inputs and outputs that can be had; a motor answers to the command of its own drive."""
    sources = [x for name in own.inputs for x in _signals(bench, name, "inputs")]
    outputs = [x for name in own.outputs for x in _signals(bench, name, "outputs")]
    whole = product(dict.fromkeys(sources), dict.fromkeys(outputs))
    return [
        (source, output)
        for source, output in whole
        if output.kind != "motor" or source == Signal("command", output.link, 0, np.nan)
    ]


def _signals(bench: Bench, name: str, end: str) -> list[Signal]:
    """Signals of a name: that one, or all of its kind, in the middle of the measured places."""
    single = own_signal(bench.study, name, end)
    if single is not None:
        return [single]
    if name == MODES:
        return []
    if name == "platform":
        return [Signal(name, k, 0, np.nan) for k in range(bench.study.n_pose)]
    is_patch = name in ("actuator", "sensor")
    place = np.nan
    if name in PLACED:
        if not BASES[bench.study.link.basis].is_on_chord:
            return []
        place = bench.stations[len(bench.stations) // 2]
    patches = range(bench.n_patches if is_patch else 1)
    return [Signal(name, i, k, place) for i, k in product(range(bench.study.n_links), patches)]


def _about_modes(plant: PlantAt) -> np.ndarray:
    """Frequencies [Hz] that are dense about the first modes, none at a mode itself.

    There, a machine without damping has no response.
    """
    modes = np.abs(plant.eigen.pole[plant.eigen.upper[:COVERED]]) / (2 * np.pi)
    count = POINTS // len(modes) // 2 * 2
    each = np.concatenate([f * np.linspace(0.85, 1.15, count) for f in modes])
    return np.unique(each)
