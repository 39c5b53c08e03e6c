"""Stability of every case of a chunk: gain margin, what breaks beyond it, and damping.

See `jaxmodel.loci`. The steps run as traced kernels if available, otherwise in XLA's scan: first
along the axis; then between the two frequencies of each crossing, with more iterations; then by
Newton's iteration, repeated with the points known divided out, since similar links have crossings
close together. Uses `MARGIN_MODES` plant modes, at rest at the first way-point.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.drives import DRIVES
from jaxmodel.laws import LAWS
from jaxmodel.loci import (
    AxisCrossing,
    FrequencyPoint,
    KnownCrossing,
    Loci,
    follow_loci,
    refine_crossing,
    start_crossing,
    start_loci,
)
from jaxmodel.pairs import Pair
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import (
    NARROWEST,
    AssembledModes,
    LoopResponse,
    assembled_modes,
    controlled_first,
    loop_response,
    loop_strength,
)
from jaxmodel.sampled_loop import RADIUS_TOLERANCE
from studies.config import hosts
from studies.engine.damping import damping_ratios, least_controlled
from studies.engine.lanes import BLOCK, run_steps
from studies.engine.programs import kept_jit
from studies.engine.stability import LoopFigures, loop_report, modes_alone, with_margin_modes
from studies.study.margin import HIGHEST, LOWEST
from studies.threads import serial_blas


class FrequencySweep(NamedTuple):
    """Frequencies of a sweep along the axis."""

    background: int  # between `LOWEST_HZ` and half the sample rate
    beside: tuple[float, ...]  # next to each mode of the machine, multiples of its zeta omega
    repeats: int  # iterations at each


#: The sweep, and a finer one for cases in which it saw spurious crossings.
SWEEPS = (
    FrequencySweep(160, (-9.0, -4.5, -2.2, -1.0, -0.3, 0.3, 1.0, 2.2, 4.5, 9.0), 1),
    FrequencySweep(400, tuple(np.tan(np.linspace(-1.5, 1.5, 24)).tolist()), 3),
)
LOWEST_HZ = 5.0
#: Replaces 0 [rad/s], where the hold would be 0/0.
STILL = 0.01
#: Links with less damping [1] have peaks too sharp for a sweep; eigenvalues judge their loops. So
#: they do where a mode of one link has this many times the damping of another link's: such modes
#: stay with their links, and the sweep, which takes them for modes of the machine, misses the sharp
#: one (from 50 times on).
LEAST_DAMPED, UNEVEN = 5e-4, 20.0
#: Separates the eigenvalues of idle channels, on the sweep and in the refinement.
SPREAD, FINE_SPREAD = 1e-3, 1e-6
#: Beyond this an eigenvalue on the sweep was thrown away by another one and does not return [1].
FARTHEST = 1e6
#: Crossings examined again per case, and kept per examined place.
CHOSEN, KEPT = 4, 2
#: The sweep starts from small numbers, so stronger loops are examined with weaker gains [1].
STRONG = 30.0
#: Steps of Newton's iteration, and the last step that counts as converged.
NEWTON, CONVERGED = 10, 1e-3
#: Starting points for crossings near the rightmost one found, as multiples of it.
AGAIN = (1.02, 1.1, 1.005)
#: A crossing seen on the sweep is examined once more if nothing is found within this factor of it.
NEAR = 1.2


class Refinement(NamedTuple):
    """How the neighbourhood of a crossing is examined."""

    wider: float  # beyond the two frequencies on either side of it, as a share of their distance
    frequencies: int
    repeats: int  # at each of them
    starts: int  # before the first


REFINEMENT = Refinement(0.3, 10, 3, 24)


#: What a batch has of `LoopFigures`.
BATCHED = ("gain_margin", "breaking_frequency", "breaking_mode", "least_damping")


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
    # idle links cost nothing; one number for all cases, since each number has its own programs
    n_links = np.sum(whole.control.link_mask > 0, axis=1)
    most, threads = max(1, int(n_links.max())), len(hosts())
    with serial_blas(), ThreadPoolExecutor(threads) as pool:

        def judge(rows: np.ndarray, sweep: FrequencySweep) -> np.ndarray:
            """Write the figures of these cases; returns the doubtful ones."""
            share = min(BLOCK, -(-len(rows) // threads))
            parts = [rows[k : k + share] for k in range(0, len(rows), share)]
            judge_part = partial(_judge_block, structure, sweep, most, whole)
            doubtful = []
            for part, those in zip(parts, pool.map(judge_part, parts), strict=True):
                for name in BATCHED:
                    getattr(figures, name)[part] = getattr(those.figures, name)
                doubtful.append(part[those.is_doubtful])
                is_beyond[part] = those.is_beyond
            return np.concatenate(doubtful)

        is_sharp = _least_damping(structure, whole) < LEAST_DAMPED
        is_sharp |= _unevenness(whole) > UNEVEN
        # no return difference link by link
        is_sharp |= LAWS[structure.law].channel == "none" or DRIVES[structure.drive].is_sampled
        is_sharp |= structure.has_drive_lag
        rows, is_beyond = np.flatnonzero(~is_sharp), np.zeros(count, bool)
        for sweep in SWEEPS:
            if len(rows):
                rows = judge(rows, sweep)
        is_lost = np.isnan(figures.least_damping).any(axis=1) & (figures.gain_margin >= 1)
        is_lost &= n_links > 0
        by_eigenvalues = partial(_judge_by_eigenvalues, structure, whole, figures)
        deque(pool.map(by_eigenvalues, map(int, np.flatnonzero(is_sharp | is_beyond | is_lost))), 0)
    return figures


def _least_damping(structure: Structure, cases: Case) -> np.ndarray:
    """Smallest given damping ratio of a link's modes [1], (n,)."""
    damping = cases.machine.damping
    falling = np.minimum(np.asarray(damping.exponent), 0.0)
    return np.min(damping.ratio, axis=(1, 2)) * float(structure.n_modes) ** (2 * falling)


def _unevenness(cases: Case) -> np.ndarray:
    """Largest ratio between the damping of two links in a mode [1], (n,)."""
    ratio = np.asarray(cases.machine.damping.ratio)
    with np.errstate(all="ignore"):  # without damping: caught as too little
        return np.max(np.nan_to_num(ratio.max(axis=1) / ratio.min(axis=1)), axis=1)


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


class _JudgedBlock(NamedTuple):
    """Figures of a block's cases."""

    figures: LoopFigures
    is_doubtful: np.ndarray  # spurious crossings were seen
    is_beyond: np.ndarray  # the sweep was lost, or saw nothing and could not see up to `HIGHEST`


class Crossings(NamedTuple):
    """Where eigenvalues can be real and positive, (k,) each."""

    case: np.ndarray  # number in the block
    value: np.ndarray  # eigenvalue [1]
    omega: np.ndarray  # [rad/s]


def _judge_block(
    structure: Structure, sweep: FrequencySweep, most: int, cases: Case, rows: np.ndarray
) -> _JudgedBlock:
    """Figures of some cases, at most a block."""
    mask = cases.control.link_mask[rows].T
    n_links = np.sum(mask > 0, axis=0)
    filled = rows[np.minimum(np.arange(BLOCK), len(rows) - 1)]  # one size, one compilation
    block = jax.tree.map(lambda x: x[filled], cases)
    padded = _respond(structure, block)
    response, modes, strength = jax.tree.map(lambda x: np.asarray(x)[..., : len(rows)], padded)
    response = controlled_first(response, mask, most)
    with np.errstate(all="ignore"):  # non-finite values find no crossing
        ratio = damping_ratios(response, modes, n_links, structure.n_controlled)
        return _judged(response, modes, np.maximum(strength / STRONG, 1.0), sweep, ratio)


@kept_jit(static_argnums=0)
def _respond(structure: Structure, cases: Case) -> tuple[LoopResponse, AssembledModes, Any]:
    """The loops, their modes and their strength, lanes last."""

    def one(case: Case) -> tuple[LoopResponse, AssembledModes, Any]:
        loop = prepare(structure, case).loop
        response = loop_response(structure, case, loop, case.path.waypoints[0])
        return response, assembled_modes(response), loop_strength(response)

    return jax.vmap(one, out_axes=-1)(cases)


def _judged(
    response: LoopResponse,
    modes: AssembledModes,
    weaker: np.ndarray,
    sweep: FrequencySweep,
    ratio: np.ndarray,
) -> _JudgedBlock:
    """Figures of loops, examined with gains `weaker` by these factors, (lanes,)."""
    count, top = len(response.period), np.pi / response.period
    response = _with_gains(response, 1 / weaker)
    least = np.maximum(1 / (HIGHEST * weaker), SPREAD)
    seen, left, right, is_lost = _sweep_axis(response, modes, sweep, 0.8 * least)
    start = _refine(response, seen, left, right, 0.8 * least)
    refined = np.zeros(count)
    np.maximum.at(refined, start.case, start.value)
    is_strange = ~_is_confirmed(seen, start) & (seen.value > refined[seen.case])
    is_doubtful = np.isin(np.arange(count), seen.case[is_strange])
    value, omega = np.zeros(count), np.full(count, np.nan)
    crossing, has_converged = _converge(response, start, _known_crossing(count, None))
    best = _rightmost(crossing.value, has_converged, start.case, count)
    rows = np.flatnonzero(best >= 0)
    crossing = jax.tree.map(lambda x: x[best[rows]], crossing)
    part = jax.tree.map(lambda x: x[..., rows], response)
    for start_at in AGAIN if len(rows) else ():
        # once more, slightly to the right, with the known points divided out
        again = Crossings(np.arange(len(rows)), crossing.value * start_at, crossing.omega)
        other, is_other = _converge(part, again, _known_crossing(len(rows), crossing))
        is_more = is_other & (other.value > crossing.value)
        crossing = jax.tree.map(lambda a, b, more=is_more: np.where(more, b, a), crossing, other)
    value[rows], omega[rows] = crossing.value, crossing.omega
    at_end, where = _end_eigenvalues(response, least)
    is_more = at_end > value
    value, omega = np.where(is_more, at_end, value), np.where(is_more, where, omega)
    breaks = value > least
    margin = np.where(breaks, 1 / (weaker * np.where(breaks, value, 1.0)), HIGHEST)
    # even without control: the machine, or a filter of a mode too close to the sample rate
    falls = (modes.growth * response.period > RADIUS_TOLERANCE) | _filters_grow(response)
    margin = np.where(falls | (margin < LOWEST), 0.0, margin)
    breaks, omega = breaks | falls, np.where(falls, 0.0, np.where(breaks, omega, np.nan))
    apart = np.abs(_fold_frequency(modes.omega, top) - np.abs(omega))
    order = np.take_along_axis(
        np.argmax(modes.share, axis=0), np.argmin(apart, axis=0)[None], axis=0
    )[0]
    leaves = jax.tree.leaves(response)
    is_finite = np.all([np.isfinite(x).reshape(-1, count).all(axis=0) for x in leaves], axis=0)
    # static: not a mode's frequency
    order = np.where(is_more & (omega == 0) & ~falls, np.nan, order)
    figures = LoopFigures(
        gain_margin=np.where(is_finite, margin, np.nan),
        breaking_frequency=np.where(is_finite, np.abs(omega) / (2 * np.pi), np.nan),
        breaking_mode=np.where(is_finite & breaks, order, np.nan),
        least_damping=ratio,
    )
    is_beyond = is_lost | (~breaks & (HIGHEST * weaker * SPREAD > 1))
    return _JudgedBlock(figures, is_doubtful & is_finite, is_beyond & is_finite)


def _filters_grow(response: LoopResponse) -> np.ndarray:
    """Whether the filter of a channel that acts is unstable by itself, (lanes,)."""
    first, (a1, a2) = response.estimator.first[2], response.estimator.denominator
    edge = 1 + RADIUS_TOLERANCE
    is_calm = (np.abs(first) < edge) & (np.abs(a2) < edge) & (np.abs(a1) < edge + a2)
    acts = response.velocity_gain != 0
    if response.position_gain is not None:
        acts = acts | (response.position_gain != 0)
    return np.any(~is_calm & acts, axis=(0, 1))


def _with_gains(response: LoopResponse, factor: np.ndarray) -> LoopResponse:
    """The loops with all gains times a factor, (lanes,)."""
    position = response.position_gain
    return response._replace(
        velocity_gain=response.velocity_gain * factor,
        position_gain=None if position is None else position * factor,
    )


def _fold_frequency(omega: np.ndarray, top: np.ndarray) -> np.ndarray:
    """Frequencies after aliasing, 0 to pi/T."""
    return np.abs((omega + top) % (2 * top) - top)


def sweep_frequencies(
    modes: AssembledModes, period: np.ndarray, sweep: FrequencySweep
) -> np.ndarray:
    """Frequencies of the sweep, rising [rad/s], (F, lanes)."""
    top = np.pi / period
    lowest = 2 * np.pi * LOWEST_HZ
    background = lowest * (top / lowest) ** np.linspace(0, 1, sweep.background)[:, None]
    width = np.maximum(modes.decay, NARROWEST * modes.omega)
    beside = [np.abs(_fold_frequency(modes.omega, top) + x * width) for x in sweep.beside]
    omega = np.concatenate([background, *beside])
    omega = np.where(omega > top, 2 * top - omega, omega)
    return np.sort(np.clip(omega, 1.0, top * (1 - 1e-6)), axis=0)


def _sweep_axis(
    response: LoopResponse, modes: AssembledModes, sweep: FrequencySweep, least: np.ndarray
) -> tuple[Crossings, np.ndarray, np.ndarray, np.ndarray]:
    """The rightmost crossings of each case, the frequencies [rad/s] on either side, lost cases."""
    omega = np.repeat(sweep_frequencies(modes, response.period, sweep), sweep.repeats, axis=0)
    visit = np.arange(len(omega)) + 1
    kind = np.where(visit % sweep.repeats > 0, 0.0, np.where(visit == sweep.repeats, 1.0, 2.0))
    spread = _spread(response, SPREAD)
    first = -spread.reshape(-1, spread.shape[2])
    loci = _follow_axis(response, spread, Pair(first, 0 * first), omega, kind)
    size = np.hypot(np.asarray(loci.value.re), np.asarray(loci.value.im))
    is_lost = ~np.all(size < FARTHEST, axis=0)
    return (*_crossings(loci, np.arange(spread.shape[2]), CHOSEN, least), is_lost)


def _crossings(
    loci: Loci, case: np.ndarray, most: int, least: np.ndarray
) -> tuple[Crossings, np.ndarray, np.ndarray]:
    """The rightmost crossings of each lane, and the frequencies [rad/s] on either side.

    Args:
        loci: after a sweep.
        case: of each lane.
        most: crossings of a lane.
        least: value that counts [1], by case.
    """
    order = np.argsort(-loci.crossing, axis=0)[:most]
    value, place, left, right = (
        np.take_along_axis(x, order, axis=0)
        for x in (loci.crossing, loci.place, loci.left, loci.right)
    )
    at = np.nonzero(value > least[case])
    return Crossings(case[at[1]], value[at], place[at]), left[at], right[at]


def _is_confirmed(crossings: Crossings, refined: Crossings) -> np.ndarray:
    """Whether anything was found near each crossing, (k,)."""
    order = np.argsort(refined.case, kind="stable")
    begin, end = (
        np.searchsorted(refined.case[order], crossings.case, side) for side in ("left", "right")
    )
    width = int(np.max(end - begin, initial=0))
    place = begin[:, None] + np.arange(width)
    value = (
        refined.value[order[np.minimum(place, len(order) - 1)]] if width else np.ones((len(end), 0))
    )
    near = np.abs(np.log(value / crossings.value[:, None])) < np.log(NEAR)
    return np.any(near & (place < end[:, None]), axis=1)


def _refine(
    response: LoopResponse,
    crossings: Crossings,
    left: np.ndarray,
    right: np.ndarray,
    least: np.ndarray,
) -> Crossings:
    """The rightmost crossings of each interval."""
    more = REFINEMENT.wider * (right - left)
    share = (np.arange(REFINEMENT.frequencies)[:, None] + 0.382) / (REFINEMENT.frequencies - 0.5)
    omega = left - more + (right - left + 2 * more) * share
    first, others = (
        np.repeat(omega[:1], REFINEMENT.starts, 0),
        np.repeat(omega[1:], REFINEMENT.repeats, 0),
    )
    omega = np.concatenate([first, others])
    kind = [0.0] * (REFINEMENT.starts - 1) + [1.0]
    kind += ([0.0] * (REFINEMENT.repeats - 1) + [2.0]) * (REFINEMENT.frequencies - 1)
    selected = jax.tree.map(lambda x: x[..., crossings.case], response)
    spread = _spread(selected, FINE_SPREAD)
    loci = _follow_axis(selected, spread, _ring(spread, crossings.value), omega, np.array(kind))
    return _crossings(loci, crossings.case, KEPT, least)[0]


def _end_eigenvalues(response: LoopResponse, least: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest eigenvalue above `least` at the ends of the axis, 0: none, and where [rad/s], (n,).

    L is real there, so its curves end on the real axis without crossing it: position feedback loses
    its static stiffness at 0, differences their sign at pi/T.
    """
    spread, top = _spread(response, FINE_SPREAD), np.pi / response.period
    ring = _ring(spread, np.ones_like(top))
    value, omega = np.zeros(len(top)), np.full(len(top), np.nan)
    for place, name in ((0 * top + STILL, 0 * top), (top * (1 - 1e-6), top)):
        steps = np.repeat(place[None], REFINEMENT.starts, axis=0)
        eigenvalue = _follow_axis(response, spread, ring, steps, np.zeros(REFINEMENT.starts)).value
        is_real = (eigenvalue.re > least) & (np.abs(eigenvalue.im) < 1e-3 * eigenvalue.re)
        largest = np.max(np.where(is_real, eigenvalue.re, 0.0), axis=0)
        omega = np.where(largest > value, name, omega)
        value = np.maximum(value, largest)
    return value, omega


def _ring(spread: np.ndarray, size: np.ndarray) -> Pair:
    """Initial guesses of each lane's eigenvalues, scattered up to its size [1]."""
    n = spread.shape[0] * spread.shape[1]
    k = np.arange(n)[:, None]
    ring = np.exp(2j * np.pi * (k + 0.3) / n) * (0.2 + 0.8 * ((4 * k) % n) / n) * size
    return Pair(ring.real, ring.imag)


def _spread(response: LoopResponse, size: float) -> np.ndarray:
    """See `evaluate_loop_gain`: up to `size`, different for each channel, (n, C, lanes)."""
    shape = response.velocity_gain.shape
    n = shape[0] * shape[1]
    return np.broadcast_to(size * (1 + np.arange(n).reshape(*shape[:2], 1)) / n, shape)


def _known_crossing(count: int, crossing: AxisCrossing | None) -> KnownCrossing:
    is_there = np.full(count, float(crossing is not None))
    crossing = crossing or start_crossing(*np.zeros((4, count)))
    return KnownCrossing(
        is_there=is_there,
        omega=crossing.omega,
        value=crossing.value,
        by_omega=crossing.by_omega,
        by_value=crossing.by_value,
    )


def _converge(
    response: LoopResponse, start: Crossings, known: KnownCrossing
) -> tuple[AxisCrossing, np.ndarray]:
    """Newton's iteration from each crossing; where it ended, and whether it converged."""
    response = jax.tree.map(lambda x: x[..., start.case], response)
    known = jax.tree.map(lambda x: x[start.case], known)
    angle = start.omega * response.period
    guess = start_crossing(start.omega, start.value, np.cos(angle), np.sin(angle))
    last = run_steps(refine_crossing, (response, known), (), guess, NEWTON)
    return last, (last.step < CONVERGED) & (last.value > 0) & np.isfinite(last.value)


def _rightmost(
    value: np.ndarray, has_converged: np.ndarray, case: np.ndarray, count: int
) -> np.ndarray:
    """Index of the largest value of each case, -1 if it has none, (count,)."""
    best = np.full(count, -1)
    for k in np.argsort(np.where(has_converged, value, -np.inf)):
        if has_converged[k]:
            best[case[k]] = k
    return best


# --- the steps on this machine --------------------------------------------------------------------


def _follow_axis(
    response: LoopResponse, spread: np.ndarray, first: Pair, omega: np.ndarray, kind: np.ndarray
) -> Loci:
    angle = omega * response.period
    inputs = FrequencyPoint(omega, np.cos(angle), np.sin(angle), kind)
    return run_steps(follow_loci, (response, spread), inputs, start_loci(first), len(omega))
