"""Compiled programs of the linearised loops of a tuning, with derivatives."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.linear import resting
from jaxmodel.linear_residual import linear_residual
from jaxmodel.loop_figures import MARGINS, PEAKS
from jaxmodel.numbers import Numbers, case_of
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.robustness import MarginPlace, margin_at, norm_peaks
from jaxmodel.sampled_loop import LoopMatrices, loop_matrices, slowest_decay, spillover
from jaxmodel.sampled_response import SampledLoopResponse, response_of_loop
from studies.engine.programs import kept_jit
from studies.engine.robustness import response_and_modes
from studies.tuning.loop_figures import distance_of_path

#: Unit of violations of `gain_margin`, and the decay rate that counts as stable if no limit of the
#: loop is set [1/s].
STABLE = 10.0


class _Loop(NamedTuple):
    """A loop in the program that judges it."""

    structure: Structure
    case: Case
    matrices: LoopMatrices
    figures: dict[str, Array]  # of its frequency response
    decay: Array  # [1/s], ()


def _excess(loop: _Loop, names: tuple[Any, ...], limits: Array) -> Array:
    """x/(1 + |x|) for each limit, (m,): decay rates reach hundreds of their limit on both sides.

    x is value/limit - 1, or -decay/STABLE of the loop with all gains times the required margin.
    Figures of `jaxmodel.robustness` are those of stable loops: others count as 1 - decay/STABLE,
    which is what margins reach at the edge.
    """
    excesses = []
    for k, name in enumerate(names):
        if name in loop.figures:
            share = loop.figures[name] / limits[k]
            within = 1 - share if name in MARGINS else share - 1
            x = jnp.where(loop.decay > 0, within, 1 - loop.decay / STABLE)
        elif name == "spillover":
            x = spillover(loop.structure, loop.case, loop.matrices) / limits[k] - 1
        elif name == "singularity_distance":
            x = 1 - distance_of_path(loop.structure, loop.case) / limits[k]
        elif name == "slowest_decay":
            x = 1 - loop.decay / limits[k]
        else:
            feedback = limits[k] * loop.matrices.feedback
            x = -_decay(loop.case, loop.matrices._replace(feedback=feedback)) / STABLE
        excesses.append(x / (1 + jnp.abs(x)))
    return jnp.stack(excesses) if names else jnp.zeros(0)


def _terms(loop: _Loop, names: tuple[Any, ...]) -> Array:
    """Terms of the objective, nan where the loop is unstable, (t,)."""
    values = []
    for name in names:
        if name == "slowest_decay":
            values.append(loop.decay)
        elif name == "spillover":
            values.append(spillover(loop.structure, loop.case, loop.matrices))
        else:
            values.append(loop.figures[name])
    return jnp.where(loop.decay > 0, jnp.stack(values), jnp.nan) if names else jnp.zeros(0)


def _decay(case: Case, matrices: LoopMatrices) -> Array:
    return slowest_decay(matrices.open + matrices.feedback, case.electronics.period)


def _loop(
    structure: Structure, case: Case, names: tuple[Any, ...], places: dict[str, MarginPlace]
) -> _Loop:
    """A loop with its named figures of the frequency response, margins at their places."""
    pose, loop, figures = case.path.waypoints[0], prepare(structure, case).loop, {}
    moment = resting(structure, case)
    matrices = loop_matrices(structure, case, loop, loop.controller, pose, moment)
    if places or any(name in PEAKS for name in names):
        response = response_of_loop(structure, case, loop, pose)
        figures = {name: margin_at(response, name, place) for name, place in places.items()}
        peaks = tuple(name for name in PEAKS if name in names)
        figures |= norm_peaks(response, peaks) if peaks else {}
    return _Loop(
        structure=structure,
        case=case,
        matrices=matrices,
        figures=figures,
        decay=_decay(case, matrices),
    )


@kept_jit(static_argnums=(0, 1), is_quick=True)
def loop_responses(
    structure: Structure, place: Any, numbers: Numbers, values: Array
) -> tuple[SampledLoopResponse, tuple[Array, Array]]:
    """What a search of margins reads of each design."""

    def one(x: Array, numbers: Numbers) -> tuple[SampledLoopResponse, tuple[Array, Array]]:
        case = case_of(structure, place(numbers, x))
        loop = prepare(structure, case).loop
        return response_and_modes(structure, case, loop, case.path.waypoints[0])

    return jax.vmap(one)(values, numbers)


@kept_jit(static_argnums=(0, 1))
def tuned_cases(structure: Structure, place: Any, numbers: Numbers, values: Array) -> Case:
    """Cases of designs (n, p), by the numbers of each, (n, ...)."""
    cases: Case = jax.vmap(lambda numbers, x: case_of(structure, place(numbers, x)))(
        numbers, values
    )
    return cases


@kept_jit(static_argnums=(0, 1, 2, 3), is_quick=True)
def figure_slopes(
    structure: Structure,
    names: tuple[Any, ...],
    terms: tuple[Any, ...],
    place: Any,
    numbers: Numbers,
    limits: Array,
    values: Array,
    places: dict[str, MarginPlace],
) -> tuple[Array, Array]:
    """Excesses over limits and terms of loops, (n, m + t), and their derivatives by `values`."""

    def figures(
        x: Array, numbers: Numbers, limit: Array, places: dict[str, MarginPlace]
    ) -> tuple[Array, Array]:
        case = case_of(structure, place(numbers, x))
        loop = _loop(structure, case, (*names, *terms), places)
        whole = jnp.concatenate([_excess(loop, names, limit), _terms(loop, terms)])
        return whole, whole

    def one(design: tuple[Any, ...]) -> tuple[Array, Array]:
        slope, whole = jax.jacrev(figures, has_aux=True)(*design)  # the figures come with it
        return whole, slope

    return jax.lax.map(one, (values, numbers, limits, places))


@kept_jit(static_argnums=(0, 1, 2, 5), is_quick=True)
def screen_designs(
    structure: Structure,
    names: tuple[Any, ...],
    place: Any,
    numbers: Numbers,
    limits: Array,
    links: tuple[int, ...],
    values: Array,
) -> tuple[Array, Array]:
    """Excesses over limits of a machine's loops with designs (n, p), and linear residual vibration.

    Returns:
        (excesses (n, m); of the links that count [m], (n,)).
    """

    def one(x: Array) -> tuple[Array, Array]:
        loop = _loop(structure, case_of(structure, place(numbers, x)), names, {})
        rms = linear_residual(structure, loop.case, loop.matrices)
        return _excess(loop, names, limits), jnp.sqrt(jnp.mean(rms[np.array(links)] ** 2))

    return jax.lax.map(one, values)
