"""Random sampled loops, and their margins by the eigenvalues of the whole matrices."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxmodel.case import Case, Structure
from studies.engine.stability import _loops, gain_margin, with_margin_modes
from studies.study.cases import build_structure
from studies.study.numbers import build_cases
from tests.canonical import MACHINE, study_of

STUDY = study_of(MACHINE)


class Loops(NamedTuple):
    """Cases with all leaves as long as there are cases."""

    structure: Structure
    cases: Case


def random_loops(count: int, seed: int) -> Loops:
    """Placements, gains, modes, links, damping, filters and poses far beyond what anyone builds."""
    rng = np.random.default_rng(seed)
    link, patches = STUDY.link, STUDY.patches
    half = 0.51 * max(patches.sensor_length, patches.actuator_length)

    def centers() -> np.ndarray:
        while True:
            found = np.sort(rng.uniform(half, link.length - half, 3))
            if np.all(np.diff(found) > 2 * half):
                return found

    links = rng.random((count, 3)) < 0.7
    links[~links.any(axis=1)] = True
    same = rng.random(count) < 0.5
    pose = np.array([0, 0, np.pi / 6]) + rng.uniform(-1, 1, (count, 3)) * [0.01, 0.01, 0.1]
    columns = {
        "patches.centers": np.array(
            [[centers()] * 3 if one else [centers() for _ in range(3)] for one in same]
        ),
        "control.links": links,
        "control.gain_factor": np.exp(rng.normal(-1.5, 1.2, count)),
        "control.modes": rng.integers(1, 4, count),
        "control.feedthrough_factor": rng.choice([0.0, 1.0], count),
        "link.damping_ratio": 10 ** rng.uniform(-3, -1.7, (count, 1)),
        "electronics.antialias_hz": rng.choice([1000.0, 2000.0, 4000.0], count),
        "electronics.sample_rate_hz": rng.choice([11_000.0, 16_000.0, 20_000.0], count),
    }
    structure = build_structure(STUDY)._replace(n_steps=1, n_controlled=3)
    cases = build_cases(STUDY, columns, structure)
    cases = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape[1:])), cases)
    points = np.broadcast_to(pose[:, None], cases.path.waypoints.shape)
    return Loops(structure, cases._replace(path=cases.path._replace(waypoints=points)))


def matrices(structure: Structure, cases: Case) -> tuple[np.ndarray, np.ndarray]:
    """Of the loops at rest, open and what the gains add to them, (n, m, m) each."""
    opened, feedback = [], []
    for k in range(len(cases.path.waypoints)):
        case = jax.tree.map(lambda x, k=k: np.asarray(x)[k], cases)
        found = _loops(structure, False, case, case.path.waypoints[0], None).at_rest
        opened.append(np.asarray(found.open)[0])
        feedback.append(np.asarray(found.feedback)[0])
    return np.array(opened), np.array(feedback)


def exact_margins(loops: Loops) -> np.ndarray:
    """By eigenvalues, (n,)."""
    opened, feedback = matrices(*with_margin_modes(*loops))

    def margin(k: int) -> float:
        return gain_margin(cache(lambda f: np.linalg.eigvals(opened[k] + f * feedback[k])))

    with threadpool_limits(1, "blas"), ThreadPoolExecutor(2) as pool:
        return np.array(list(pool.map(margin, range(len(opened)))))
