"""Everything the study computes, for its claims, figures and page."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from studies.engine.batches import ProgressCallback
from studies.papers.rrr_2016.confirmation import Confirmed, confirm
from studies.papers.rrr_2016.coupling import (
    DEFINITIONS,
    after_plucks,
    coupling_ratio,
    of_all_links,
    of_itself,
    of_platform,
)
from studies.papers.rrr_2016.energies import Energies, free_energies
from studies.papers.rrr_2016.machines import REACH, MachineSample, baselines, home, sample
from studies.papers.rrr_2016.maps import STRENGTHS, STRONG, DampingMap, damping_map
from studies.papers.rrr_2016.thresholds import Threshold, threshold
from studies.study.spec import Study

#: Reductions of the others' rms vibration that may be called calming; the first one decides [1].
LEVELS = (0.1, 0.01, 0.03, 0.2)
#: Control that removes less than this of the vibration of its own link is not judged [1].
WORKING = 0.3
#: Coupling ratios near which machines are simulated as a whole, and their least damping, since
#: long decays take long [1].
SIMULATED, LEAST_DAMPING = (0.9, 0.5, 0.2), 0.004


class Effort(NamedTuple):
    """How much is computed."""

    machines: int = 4096  # of a sample, a power of 2
    poses: int = 8  # of baselines and maps
    modes: tuple[int, ...] = (1, 2, 3)  # per link, for the convergence at home
    drives: int = 9  # points of a map
    masses: int = 6
    strengths: tuple[float, ...] = STRENGTHS
    simulated: tuple[float, ...] = SIMULATED

    @property
    def steps(self) -> int:
        """What `find` reports as done."""
        return len(baselines()) * (5 + len(self.simulated))


class Baseline(NamedTuple):
    """A baseline at home, first, and at other poses within reach; arrays (p,) or (p, 2)."""

    ratio: np.ndarray  # coupling ratio [1]
    others: np.ndarray  # reduction of the other links [1]
    itself: np.ndarray  # of the controlled link [1]
    every: np.ndarray  # of all links, all controlled [1]
    platform: np.ndarray  # of place and turn of the platform [1]
    converged: np.ndarray  # ratio and reduction at home by `Effort.modes` [1], (modes, 2)


class Sampled(NamedTuple):
    """Machines of a sample whose pose is feasible and whose control works; arrays (n,)."""

    machines: MachineSample
    row: np.ndarray  # in `machines`
    ratio: np.ndarray  # coupling ratio [1]
    reduction: dict[str, np.ndarray]  # of the others, by DEFINITIONS [1]
    thresholds: dict[str, list[Threshold]]  # by DEFINITIONS, for LEVELS


class Kind(NamedTuple):
    """What was found about one kind of machine."""

    study: Study
    baseline: Baseline
    sampled: Sampled
    strong: DampingMap  # with control as strong as the baseline's
    best: DampingMap  # with the strength that calms the others most
    confirmed: list[tuple[int, Confirmed]]  # with the place in `sampled`


def find(effort: Effort, on_progress: ProgressCallback) -> dict[str, Kind]:
    """Findings by kind of machine.

    Args:
        effort: sizes.
        on_progress: called with progress messages.
    """
    return {name: _find(name, study, effort, on_progress) for name, study in baselines().items()}


def _find(name: str, study: Study, effort: Effort, on_progress: ProgressCallback) -> Kind:
    def begin(text: str, share: float = 1.0) -> None:
        on_progress(f"{name}: {text}", share)

    begin("the machine of the papers", 0.0)
    baseline = _baseline(study, effort)
    begin("machines around it")
    sampled = _sampled(study, effort.machines)
    begin("map, strong control")
    drives, masses = np.geomspace(0.2, 8, effort.drives), np.geomspace(1, 32, effort.masses)
    strong = damping_map(study, LEVELS[0], drives, masses, effort.poses, (STRONG,))
    begin("map, best control")
    best = damping_map(study, LEVELS[0], drives, masses, effort.poses, effort.strengths)
    begin("whole simulations")
    confirmed = []
    for ratio in effort.simulated:
        k = _nearest(sampled, ratio)
        confirmed.append((k, confirm(sampled.machines, int(sampled.row[k]), lambda *_: None)))
        begin("whole simulations")
    begin("done")
    return Kind(
        study=study,
        baseline=baseline,
        sampled=sampled,
        strong=strong,
        best=best,
        confirmed=confirmed,
    )


def _baseline(study: Study, effort: Effort) -> Baseline:
    unit = qmc.Halton(3, rng=np.random.default_rng(1)).random(effort.poses - 1)
    poses = home(study) + np.vstack([np.zeros(3), REACH * (2 * unit - 1)])
    found = _kept(_unvaried(study, poses, 1), WORKING)[0]
    first = [_unvaried(study, poses[:1], modes) for modes in effort.modes]
    return Baseline(
        ratio=coupling_ratio(found),
        others=after_plucks(found),
        itself=of_itself(found),
        every=of_all_links(found),
        platform=of_platform(found),
        converged=np.array([[coupling_ratio(x)[0], after_plucks(x)[0]] for x in first]),
    )


def _unvaried(study: Study, poses: np.ndarray, modes: int) -> Energies:
    columns = {"drive.kp": np.full(len(poses), study.drive.kp)}
    return free_energies(study, columns, poses, modes)


def _kept(energies: Energies, least: float) -> tuple[Energies, np.ndarray]:
    """Feasible machines whose control removes at least this of its own link's vibration."""
    with np.errstate(invalid="ignore", divide="ignore"):  # of those that are left out
        row = np.flatnonzero(energies.is_feasible & (of_itself(energies) >= least))
    return Energies(*(x[row] for x in energies)), row


def _sampled(study: Study, count: int) -> Sampled:
    machines = sample(study, count, seed=0)
    found = free_energies(machines.study, machines.columns, machines.poses, 1)
    energies, row = _kept(found, WORKING)
    ratio = coupling_ratio(energies)
    reduction = {name: measure(energies) for name, measure in DEFINITIONS.items()}
    return Sampled(
        machines=machines,
        row=row,
        ratio=ratio,
        reduction=reduction,
        thresholds={
            name: [threshold(ratio, values, level) for level in LEVELS]
            for name, values in reduction.items()
        },
    )


def _nearest(sampled: Sampled, ratio: float) -> int:
    """The machine nearest to a coupling ratio that is not too lightly damped."""
    damping = sampled.machines.columns["link.damping_ratio"][sampled.row]
    apart = np.abs(sampled.ratio - ratio)
    return int(np.argmin(np.where(damping >= LEAST_DAMPING, apart, np.inf)))
