"""The loops of a chunk, each judged once: cases that differ in motion or seed alone share one."""

from __future__ import annotations

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from studies.engine.margins import judge_loops
from studies.engine.robustness import judge_robustness
from studies.engine.stability import LoopFigures


def judge_cases(structure: Structure, cases: Case, robustness: tuple[str, ...] = ()) -> LoopFigures:
    """Judge the sampled loops of cases.

    Args:
        structure: of their runs.
        cases: leaves with a leading axis, all cases or 1.
        robustness: figures of `jaxmodel.robustness` to judge them by as well.
    """
    first, own = distinct_loops(cases)
    each = jax.tree.map(lambda x: x if len(x) == 1 else x[first], cases)
    figures = judge_loops(structure, each)
    more = judge_robustness(structure, each, robustness, figures.gain_margin)
    of_cases: LoopFigures = jax.tree.map(lambda x: x[own], figures._replace(robustness=more))
    return of_cases


def distinct_loops(cases: Case) -> tuple[np.ndarray, np.ndarray]:
    """First case of every loop about rest at the first way-point, and the loop of every case.

    Args:
        cases: leaves with a leading axis, all cases or 1.

    Returns:
        Numbers of cases, rising, (m,); positions among them, (n,).
    """
    count = max(map(len, jax.tree.leaves(cases)))
    pose = cases.path.waypoints[:, 0]
    loops = pose, cases.machine, cases.n_modes, cases.control, cases.electronics, cases.drive
    varying = [np.asarray(x) for x in jax.tree.leaves((*loops, cases.load)) if len(x) > 1]
    if not varying:
        return np.zeros(1, int), np.zeros(count, int)
    rows = np.concatenate(
        [np.ascontiguousarray(x.reshape(count, -1)).view(np.uint8) for x in varying if x.size],
        axis=1,
    )
    _, first, own = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[np.ravel(own)]
