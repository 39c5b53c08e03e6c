"""Stability of linearised sampled loops: spectral radius, gain margin, damping of their modes.

Eigenvalues of small matrices, on the host; one compiled program makes all matrices of a case
(`jaxmodel.sampled_loop`): at rest, and frozen at the extreme instants of its motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.axial import axial_force
from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller, linear_parts
from jaxmodel.judge import with_margin_modes
from jaxmodel.laws import LAWS
from jaxmodel.laws.imsc import IMSC
from jaxmodel.linear import Moment, resting
from jaxmodel.loop import coordinate_omega
from jaxmodel.loop_figures import HIGHEST, LOWEST, MARGIN_MODES
from jaxmodel.motion import PathSample, end_of_path, sample_path
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import RADIUS_TOLERANCE, LoopMatrices, loop_matrices
from studies.engine.host_loop import SampledLoop, name_motion, sampled_loop
from studies.engine.programs import kept_jit
from studies.study.margin import DAMPINGS
from studies.threads import serial_blas

#: Largest ratio of successive gain factors [1].
STRIDE = 1.25
#: The first factor, and the ratio of smaller ones if it is unstable [1].
FIRST, DESCENT = 0.01, 4.0
#: Gain factors at which modes are traced from no control to the given gains [1].
STEPS = np.linspace(0, 1, 41)[1:]
#: Instants of a motion at which axial forces are evaluated.
INSTANTS = 401


class LoopFigures(NamedTuple):
    """Figures of one sampled loop, or of many with leading axes (...); None: not computed.

    Of a law whose channels act one at a time: the worst figures of its parts, each judged alone.
    """

    gain_margin: Array  # largest common factor on all gains, all smaller ones stable [1], (...)
    spectral_radius: Array = None  # of the closed loop [1], (...)
    breaking_frequency: Array = None  # of what goes unstable at the margin [Hz], (...)
    breaking: str | None = None  # what that is, see `name_motion`; of a single loop
    # order of the link mode nearest to it, 0: a mode of the platform on its drive; NaN as above,
    # and for the static stiffness
    breaking_mode: Array = None
    # least [1] of the most damped modes of each order, one per controlled link, (..., J)
    least_damping: Array = None
    frequency_hz: Array = None  # of the tracked link modes [Hz], (..., J, 3)
    damping_ratio: Array = None  # [1], (..., J, 3): three assembled modes per link mode
    time: Array = None  # of the frozen instants of a motion [s], (k,)
    axial_force: Array = None  # tension in the links then [N], (k, 3)
    robustness: dict[str, Array] | None = None  # of `jaxmodel.robustness`, by name, (...)
    # gain margins at rest by the damping of longitudinal modes [1]; None: links keep their length
    by_stretch: dict[float, float] | None = None

    @property
    def is_stable(self) -> bool:
        """Whether this loop and every one with smaller gains is stable."""
        return self.spectral_radius <= 1 + RADIUS_TOLERANCE and self.gain_margin >= 1


def modes_alone(structure: Structure, cases: Case) -> list[tuple[Structure, Case]]:
    """Loops of a law whose controlled modes act one at a time: those of each mode by itself."""
    modes, alone = np.arange(structure.n_controlled), structure._replace(law=IMSC.name)
    control = cases.control
    masks = (control.mode_mask * (modes == j) for j in modes)
    return [(alone, cases._replace(control=control._replace(mode_mask=mask))) for mask in masks]


class _Loops(NamedTuple):
    """Matrices of a case's loops; axes: instants of its motion (k), parts of its law (p)."""

    at_rest: LoopMatrices  # (p, ...)
    omega: Array  # of the links' coordinates [rad/s], (3, R)
    time: Array | None  # [s], (k,)
    axial_force: Array | None  # tension in the links [N], (k, 3)
    in_motion: LoopMatrices | None  # (k, p, ...)


@kept_jit(static_argnums=(0, 1), is_quick=True)
def _loops(
    structure: Structure, has_motion: bool, case: Case, pose: Array, parts: Controller | None
) -> _Loops:
    """All loops of a case.

    Args:
        structure: static choices, feedback "sampled".
        has_motion: also at its start, and where the tension in a link is smallest or largest.
        case: the numbers.
        pose: of the loop at rest [m, m, rad], (3,).
        parts: controllers to judge, stacked; None: the case's own.
    """
    loop = prepare(structure, case).loop
    if parts is None:
        parts = jax.tree.map(lambda x: jnp.asarray(x)[None], loop.controller)

    def matrices(pose: Array, moment: Moment | None) -> LoopMatrices:
        return jax.lax.map(
            lambda law: loop_matrices(structure, case, loop, law, pose, moment), parts
        )

    if not has_motion:
        at_rest = matrices(pose, resting(structure, case))
        return _Loops(at_rest, coordinate_omega(loop), time=None, axial_force=None, in_motion=None)
    time = jnp.linspace(0.0, 1.0, INSTANTS) * end_of_path(case.path)
    sample = sample_path(case.path, time)
    each = jax.vmap(axial_force, (None, 0, 0, 0, None))
    force = each(loop.plant, *sample, case.load.wrench)
    extremes = jnp.concatenate([force, -force], axis=1).argmin(axis=0)
    instants = jnp.concatenate([jnp.zeros(1, int), extremes])
    wrench = jnp.asarray(case.load.wrench, force.dtype)
    home = PathSample(pose, jnp.zeros_like(pose), jnp.zeros_like(pose))
    points = jax.tree.map(lambda one, x: jnp.concatenate([one[None], x[instants]]), home, sample)

    def at(point: PathSample) -> LoopMatrices:
        return matrices(point.position, Moment(point.velocity, point.acceleration, wrench))

    every = jax.lax.map(at, points)
    return _Loops(
        at_rest=jax.tree.map(lambda x: x[0], every),
        omega=coordinate_omega(loop),
        time=time[instants],
        axial_force=force[instants],
        in_motion=jax.tree.map(lambda x: x[1:], every),
    )


@kept_jit(static_argnums=0)
def _controller(structure: Structure, case: Case) -> Controller:
    return prepare(structure, case).loop.controller


def _parts(
    structure: Structure, case: Case, law: Controller | None
) -> tuple[list[slice], Controller | None]:
    """The modes that each controller to judge covers, and these, stacked; None: the case's own."""
    if law is None and not LAWS[structure.law].is_switching:
        return [slice(None)], None
    law = _controller(structure, case) if law is None else law
    modes, parts = zip(*linear_parts(jax.tree.map(np.asarray, law)), strict=True)
    return list(modes), jax.tree.map(lambda *x: np.stack(x), *parts)


def loop_report(
    structure: Structure,
    case: Case,
    pose: Array,
    n_tracked: int = 3,
    law: Controller | None = None,
    n_modes: int = MARGIN_MODES,
) -> LoopFigures:
    """Spectral radius, gain margin and damping of the lowest link modes.

    Modes are traced from zero gain to full gain, so that filter poles are not mistaken for them.
    If channels act one at a time, the figures are the worst over them, each judged alone.

    Args:
        structure: static choices.
        case: the numbers.
        pose: where to linearise [m, m, rad], (3,).
        n_tracked: J, link modes to follow.
        law: controller to judge instead of the case's own.
        n_modes: plant modes per link at least.

    Raises:
        LinAlgError: an entry of the loop's matrices is not finite.
    """
    return _figures(structure, case, pose, n_tracked, law, n_modes, has_motion=False)[0]


def run_report(
    structure: Structure, case: Case, pose: Array, n_tracked: int = 3
) -> tuple[LoopFigures, LoopFigures]:
    """Figures of a run's loop at rest, as `loop_report`, and gain margins during its motion.

    The second is linearised at the start of the unshaped motion and where the tension in a link is
    largest or smallest, with that instant frozen, under the forces that act then.

    Args:
        structure, case, pose, n_tracked: as for `loop_report`.

    Raises:
        LinAlgError: an entry of the loops' matrices is not finite.
    """
    at_rest, in_motion = _figures(
        structure, case, pose, n_tracked, None, MARGIN_MODES, has_motion=True
    )
    assert in_motion is not None
    return at_rest, in_motion


def _figures(
    structure: Structure,
    case: Case,
    pose: Array,
    n_tracked: int,
    law: Controller | None,
    n_modes: int,
    has_motion: bool,
) -> tuple[LoopFigures, LoopFigures | None]:
    plain, case = with_margin_modes(structure, case, n_modes)
    modes, stacked = _parts(plain, case, law)
    period = float(case.electronics.period)

    def all_loops(case: Case) -> _Loops:
        return jax.tree.map(np.asarray, _loops(plain, has_motion, case, pose, stacked))

    def loop(matrices: LoopMatrices, *place: int) -> SampledLoop:
        matrices = jax.tree.map(lambda x: x[place], matrices)
        return sampled_loop(matrices, loops.omega, period, n_tracked, plain.has_stretch)

    def margin(matrices: LoopMatrices, *place: int) -> float:
        each = [loop(matrices, *place, p).poles for p in range(len(modes))]
        return min(gain_margin(cache(poles)) for poles in each)

    loops: Any = all_loops(case)
    with serial_blas():
        parts = [judge_loop(loop(loops.at_rest, p)) for p in range(len(modes))]
        figures = worst_figures(list(zip(modes, parts, strict=True)))
        if not has_motion:
            return figures, None
        if plain.has_stretch:
            others = [x for x in DAMPINGS if np.any(case.machine.damping.stretch != x)]
            by_stretch = dict.fromkeys(DAMPINGS, float(figures.gain_margin))
            by_stretch |= {x: margin(all_loops(_stretching(case, x)).at_rest) for x in others}
            figures = figures._replace(by_stretch=by_stretch)
        _, instants = np.unique(loops.time, return_index=True)
        margins = [margin(loops.in_motion, k) for k in instants]
    time, force = loops.time[instants], loops.axial_force[instants]
    return figures, LoopFigures(np.array(margins), time=time, axial_force=force)


def _stretching(case: Case, damping: float) -> Case:
    own = case.machine.damping._replace(stretch=np.full_like(case.machine.damping.stretch, damping))
    return case._replace(machine=case.machine._replace(damping=own))


def judge_loop(loop: SampledLoop, steps: np.ndarray = STEPS) -> LoopFigures:
    """Figures of one loop, whose gains belong to factor 1.

    Args:
        loop: the loop.
        steps: gain factors at which its modes are traced, from near 0 to 1 [1].
    """
    poles = cache(loop.poles)
    frequency, ratio = modal_damping(loop, follow_modes(loop, steps, poles)[-1])
    margin = gain_margin(poles, steps)
    beyond = pole_beyond(loop, margin)
    return LoopFigures(
        gain_margin=margin,
        spectral_radius=float(np.abs(poles(1.0)).max()),
        breaking_frequency=float(abs(np.angle(beyond)) / (2 * np.pi * loop.period)),
        breaking=breaking_motion(loop, margin, beyond),
        frequency_hz=frequency,
        damping_ratio=ratio,
    )


def worst_figures(parts: list[tuple[slice, LoopFigures]]) -> LoopFigures:
    """Worst figures of a law's parts, with the modes that each covers, see `linear_parts`."""

    def mode_by_mode(name: str) -> np.ndarray:
        whole = np.array(getattr(parts[0][1], name))
        for modes, part in parts:
            whole[modes] = getattr(part, name)[modes]
        return whole

    each = [part for _, part in parts]
    return min(each, key=lambda part: part.gain_margin)._replace(
        spectral_radius=max(part.spectral_radius for part in each),
        frequency_hz=mode_by_mode("frequency_hz"),
        damping_ratio=mode_by_mode("damping_ratio"),
    )


def breaking_factor(margin: float) -> float:
    """A factor on all gains just beyond a margin [1]."""
    return max(1.001 * margin, LOWEST)


def pole_beyond(loop: SampledLoop, margin: float) -> complex:
    """The pole that is unstable just beyond a margin, NaN if none is up to `HIGHEST`."""
    if margin >= HIGHEST:
        return complex(np.nan)
    poles = loop.poles(breaking_factor(margin))
    return complex(poles[np.argmax(np.abs(poles))])


def breaking_motion(loop: SampledLoop, margin: float, beyond: complex) -> str:
    """What goes unstable just beyond the margin, with `pole_beyond`; "" if that is NaN."""
    return "" if np.isnan(beyond) else name_motion(loop, breaking_factor(margin), beyond)


def follow_modes(
    loop: SampledLoop, factors: np.ndarray, poles: Callable[[float], np.ndarray]
) -> np.ndarray:
    """Discrete poles of the link modes while the gains grow, (steps, J, 3), NaN: overdamped.

    Args:
        loop: the loop.
        factors: gain factors, rising from near 0 [1], (steps,).
        poles: `loop.poles`, or a cached version.
    """
    has_poles = ~np.isnan(loop.mode_poles[:, 0])
    start = np.exp(loop.mode_poles[has_poles] * loop.period)
    path = follow_poles(start.ravel(), map(poles, map(float, factors)))
    tracked = np.full((len(factors), *loop.mode_poles.shape), np.nan, complex)
    tracked[:, has_poles] = path.reshape(len(factors), *start.shape)
    return tracked


def modal_damping(loop: SampledLoop, tracked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequency [Hz] and damping ratio of traced modes.

    A pole z of a mode above half the sample rate is exp(s T) of an s that differs from ln(z)/T by a
    multiple of 2 pi/T: the one nearest to the mode without control is used.

    Args:
        loop: the loop.
        tracked: discrete poles, (..., J, 3).

    Returns:
        two arrays (..., J, 3).
    """
    rate = np.log(tracked) / loop.period
    turn = 2 * np.pi / loop.period
    rate = rate + 1j * turn * np.round((loop.mode_poles.imag - rate.imag) / turn)
    return np.abs(rate) / (2 * np.pi), -rate.real / np.abs(rate)


def gain_margin(
    poles: Callable[[float], np.ndarray],
    first: np.ndarray | None = None,
    highest: float = HIGHEST,
) -> float:
    """Largest factor on all gains with every smaller one stable.

    Args:
        poles: discrete poles by factor; called repeatedly with the same factor, so cache it.
        first: factors to start with, rising [1]; default: only `FIRST`.
        highest: where to stop [1].

    Returns:
        [1], with a relative error of 1e-4; 0 if even `LOWEST` is unstable.
    """

    @cache
    def excess(factor: float) -> float:
        return float(np.log(np.abs(poles(factor)).max()) - np.log1p(RADIUS_TOLERANCE))

    first = np.array([FIRST]) if first is None else first
    first = first[first < highest]
    last = float(first[-1]) if len(first) else highest
    count = int(np.ceil(np.log(highest / last) / np.log(STRIDE)))
    low = 0.0
    for high in map(float, [*first[:-1], *np.geomspace(last, highest, count + 1)]):
        if excess(high) > 0:
            break
        low = high
    else:
        return highest
    low = low or high / DESCENT
    while excess(low) > 0:
        if low <= LOWEST:
            return 0.0
        high, low = low, low / DESCENT
    from scipy.optimize import brentq  # takes a quarter of a second

    return float(brentq(excess, low, high, xtol=2e-5 * low, rtol=2e-5))


def follow_poles(start: np.ndarray, sets: Iterable[np.ndarray]) -> np.ndarray:
    """Trace poles while the loop changes step by step.

    Each is matched to the pole nearest to its extrapolated position; none is matched twice.

    Args:
        start: poles to follow, (m,).
        sets: all poles of the loop after each step, (n,) each.

    Returns:
        the poles after each step, (steps, m).
    """
    tracked, velocity, path = start, np.zeros_like(start), []
    for candidates in map(list, sets):
        matched = []
        for predicted in tracked + velocity:
            nearest = int(np.argmin(np.abs(np.array(candidates) - predicted)))
            matched.append(candidates.pop(nearest))
        velocity, tracked = np.array(matched) - tracked, np.array(matched)
        path.append(tracked)
    return np.array(path)
