"""Stability of every case of a chunk: gain margin, what breaks beyond it, and damping.

`jaxmodel.judge` judges blocks of cases, each in one program; the eigenvalues of whole loops judge
those of which it cannot tell. Uses `MARGIN_MODES` plant modes, at rest at the first way-point.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.damping import least_controlled
from jaxmodel.judge import LoopVerdicts, can_judge, judge, with_margin_modes
from jaxmodel.laws import LAWS
from jaxmodel.steps import GROUP, Steps
from studies.config import hosts, on_host
from studies.engine.plan import in_parts, padded_rows
from studies.engine.stability import LoopFigures, loop_report, modes_alone
from studies.engine.steps import program_of_steps
from studies.threads import serial_blas

#: Cases of a block: one size, one compilation. Few cases have smaller ones.
BLOCK, FEW = 64, 2 * GROUP


def judge_loops(structure: Structure, cases: Case) -> LoopFigures:
    """Judge the sampled loops of cases.

    Args:
        structure: of their runs.
        cases: leaves with a leading axis, all cases or 1.
    """
    if structure.feedback != "sampled":
        return no_margins(structure, cases)
    if LAWS[structure.law].is_switching:
        return _judge_one_by_one(structure, cases)
    count, figures = _count(cases), no_margins(structure, cases)
    structure, cases = with_margin_modes(structure, cases)
    whole = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape[1:])), cases)
    is_known = np.zeros(count, bool)
    if can_judge(structure):
        is_known = _judge_blocks(structure, whole, figures)
    with serial_blas(), ThreadPoolExecutor(len(hosts())) as pool:
        by_eigenvalues = partial(_judge_by_eigenvalues, structure, whole, figures)
        deque(pool.map(by_eigenvalues, map(int, np.flatnonzero(~is_known))), 0)
    return figures


def _judge_blocks(structure: Structure, cases: Case, figures: LoopFigures) -> np.ndarray:
    """Write the figures of all cases; returns which of them are known."""
    count, canonical = _count(cases), jax.dtypes.canonicalize_dtype
    size, most = GROUP, structure.n_links
    if count > FEW:  # idle links cost nothing; one number, since each has its own programs
        size, most = BLOCK, max(1, int(np.sum(cases.control.link_mask > 0, axis=1).max()))

    def block(rows: np.ndarray) -> Case:
        some: Case = jax.tree.map(lambda x: x[rows].astype(canonical(x.dtype)), cases)
        return some

    with on_host():
        run = program_of_steps(_judged, [structure, most], block(padded_rows(1, size)))

        def judge_block(rows: np.ndarray) -> LoopVerdicts:
            with on_host():
                return run(block(rows))

        whole = in_parts(judge_block, count, size, len(hosts()))
    for name, value in whole._asdict().items():
        if name != "is_known":
            getattr(figures, name)[:] = value
    return whole.is_known


def _judged(structure: Structure, n_active: int, steps: Steps, cases: Case) -> LoopVerdicts:
    return judge(structure, cases, steps, n_active)


def _judge_by_eigenvalues(structure: Structure, cases: Case, figures: LoopFigures, k: int) -> None:
    """Write the figures of case k, except the mode that breaks; takes half a second."""
    case = jax.tree.map(lambda x: x[k], cases)
    try:
        one = loop_report(structure, case, case.path.waypoints[0], structure.n_controlled)
    except np.linalg.LinAlgError:  # not finite
        return
    figures.gain_margin[k] = one.gain_margin
    figures.breaking_frequency[k] = one.breaking_frequency
    n_links = np.sum(case.control.link_mask > 0)
    figures.least_damping[k] = least_controlled(
        one.damping_ratio.T, np.full(structure.n_controlled, n_links)
    )


def _judge_one_by_one(structure: Structure, cases: Case) -> LoopFigures:
    """Worst figures of loops whose controlled modes act one at a time, each judged alone."""
    parts = [judge_loops(*alone) for alone in modes_alone(structure, cases)]
    margins = np.stack([part.gain_margin for part in parts])
    worst = np.argmin(np.where(np.isnan(margins), -np.inf, margins), axis=0)[None]

    def of_worst(name: str) -> np.ndarray:
        values = np.stack([getattr(part, name) for part in parts])
        return np.take_along_axis(values, worst, axis=0)[0]

    return LoopFigures(
        gain_margin=of_worst("gain_margin"),
        breaking_frequency=of_worst("breaking_frequency"),
        breaking_mode=of_worst("breaking_mode"),
        least_damping=np.stack([part.least_damping[:, j] for j, part in enumerate(parts)], axis=1),
    )


def _count(cases: Case) -> int:
    return max(len(leaf) for leaf in jax.tree.leaves(cases))


def no_margins(structure: Structure, cases: Case) -> LoopFigures:
    """NaN for every case; arguments as `judge_loops`."""
    count = _count(cases)
    margin, frequency, mode = np.full((3, count), np.nan)
    return LoopFigures(
        gain_margin=margin,
        breaking_frequency=frequency,
        breaking_mode=mode,
        least_damping=np.full((count, structure.n_controlled), np.nan),
    )
