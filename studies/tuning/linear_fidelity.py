"""Figures of designs from the linearised sampled loop: margins, spillover, residual vibration.

No eigenvalues and no runs: repeated squaring and doubling (`jaxmodel.sampled_loop`), so it works in
batches on any device. The plant has at least 12 modes, because uncontrolled modes limit the gains.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.frequency_response import SampledLoopResponse, response_of_loop
from jaxmodel.kinematics import singularity_distance
from jaxmodel.linear_residual import linear_residual
from jaxmodel.loop_figures import MARGINS, PEAKS
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.robustness import MarginPlace, margin_at, norm_peaks
from jaxmodel.sampled_loop import LoopMatrices, closed_loop, slowest_decay, spillover
from studies.engine.plan import padded_rows
from studies.engine.programs import kept_jit
from studies.engine.robustness import find_margins, judge_robustness, response_and_modes
from studies.engine.stability import gain_margin
from studies.study.cases import as_arrays, build_case, build_structure, case_of
from studies.study.margin import MARGIN_MODES
from studies.study.numbers import Numbers, one_study, stack_numbers
from studies.study.paths import parts_of
from studies.study.spec import Study
from studies.tuning.scenarios import nominal
from studies.tuning.spec import BASELINE, Family, TuneSpec

#: Unit of violations of `gain_margin`, and the decay rate that counts as stable if no limit of the
#: loop is set [1/s].
STABLE = 10.0
#: Points of each straight move at which its distance from singularities is evaluated.
PATH_POINTS = 17
#: Designs per call; each core takes one call after another.
BATCH = 16


class DesignFigures(NamedTuple):
    """Figures of a design, on the host."""

    gain_margin: float  # largest factor on all gains with every smaller one stable [1]
    slowest_decay: float  # [1/s]
    spillover: float  # see `jaxmodel.sampled_loop.spillover` [1]
    singularity_distance: float  # [rad]
    # of `jaxmodel.robustness`, nan where nothing limits them
    disk_margin: float = np.nan  # [1]
    phase_margin: float = np.nan  # [deg]
    delay_margin: float = np.nan  # [samples]
    sensitivity_peak: float = np.nan  # [1]
    control_effort_peak: float = np.nan  # [1]
    disturbance_deflection_peak: float = np.nan  # [m/N]


def with_margin_modes(study: Study) -> Study:
    """The study with the number of plant modes used to judge its loop."""
    return study.change(link__modes=max(MARGIN_MODES, study.link.modes))


class LinearFidelity:
    """Evaluates designs of some families."""

    def __init__(self, spec: TuneSpec, families: list[Family]) -> None:
        """
        Args:
            spec: of the tuning.
            families: of each design, in the order given.
        """
        self._spec, self.names, self._links = spec, spec.loop_limits, spec.counted_links
        self._pose = np.array(nominal(spec, None).motion.waypoints[0])
        every = [spec.parts(family) for family in families]
        self._batches = {
            parts: _batch(spec, families, np.flatnonzero([x == parts for x in every]))
            for parts in dict.fromkeys(every)
        }
        self._own: DesignFigures | None = None
        self._limits = np.array(
            [[self._limit(family, name) for name in self.names] for family in families]
        ).reshape(len(families), len(self.names))

    def _limit(self, family: Family, name: str) -> float:
        limit = family.limits[name]
        if limit != BASELINE:
            return float(limit)
        self._own = self._own or loop_figures(self._spec, self._spec.study)
        return float(getattr(self._own, name))

    def limits(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far designs exceed the limits of their loop, with derivatives.

        Args:
            values: one design for each family of the constructor, (designs, p).

        Returns:
            (x/(1 + |x|) of x = value/limit - 1, positive where violated, (designs, m), its
            derivatives, (designs, m, p)).
        """
        if not self.names:
            return np.zeros((len(values), 0)), np.zeros((len(values), 0, values.shape[1]))
        excess = np.zeros(self._limits.shape)
        slopes = np.zeros((*excess.shape, values.shape[1]))
        for batch in self._batches.values():
            # drop what the matrices do not depend on, to avoid a compilation
            structure = batch.structure._replace(n_steps=1, substeps=1)
            place, mine = self._spec.free.place, values[batch.rows]
            margins, places = tuple(name for name in self.names if name in MARGINS), {}
            if margins:
                response, modes = _responses(structure, place, batch.numbers, self._pose, mine)
                places = find_margins(response, modes, margins, is_fine=True)
            excess[batch.rows], slopes[batch.rows] = _limit_slopes(
                structure,
                self.names,
                place,
                batch.numbers,
                self._pose,
                self._limits[batch.rows],
                mine,
                places,
            )
        return excess, slopes

    def screen(self, position: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A quick evaluation of designs of one family.

        Args:
            position: index of a design of that family among those of the constructor.
            values: (n, p), any number of them.

        Returns:
            (largest excess over the limits of the loop, at least that of a stable one, inf where
            none is found, (n,); linear residual vibration [m], (n,)).
        """
        batch = next(x for x in self._batches.values() if position in x.rows)
        if batch.structure.feedback != "sampled":
            return np.zeros(len(values)), np.zeros(len(values))
        # margins by frequency response take longer than all others: their designs must be stable
        quick = [k for k, name in enumerate(self.names) if name not in (*MARGINS, *PEAKS)]
        names = tuple(self.names[k] for k in quick) or ("slowest_decay",)
        limits = self._limits[position, quick] if quick else np.array([STABLE])
        evaluate = partial(
            _screen_batch,
            batch.structure,
            names,
            self._spec.free.place,
            jax.tree.map(lambda x: x[np.searchsorted(batch.rows, position)], batch.numbers),
            self._pose,
            limits,
            self._links,
        )
        count = len(values)
        rows = padded_rows(count, BATCH)
        parts = np.split(values[rows], len(rows) // BATCH)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            results = list(pool.map(lambda part: jax.tree.map(np.asarray, evaluate(part)), parts))
        excess, residual = (np.concatenate(x)[:count] for x in zip(*results, strict=True))
        worst = excess.max(axis=1)
        return (
            np.where(np.isfinite(worst), worst, np.inf),
            np.where(np.isfinite(residual), residual, np.inf),
        )


class _Batch(NamedTuple):
    """Designs of one law and drive."""

    rows: np.ndarray  # places among all designs, rising
    structure: Structure
    numbers: Numbers


def _batch(spec: TuneSpec, families: list[Family], rows: np.ndarray) -> _Batch:
    chosen = [families[k] for k in rows]
    parts = spec.parts(chosen[0])
    first = None if parts == spec.parts() else chosen[0]
    structure = _judged_structure(spec, nominal(spec, first))
    of_family = {
        name: one_study(with_margin_modes(nominal(spec, family)), structure)
        for name, family in {family.name: family for family in chosen}.items()
    }
    numbers = as_arrays(stack_numbers([of_family[family.name] for family in chosen]))
    return _Batch(rows, structure, numbers)


def _judged_structure(spec: TuneSpec, study: Study) -> Structure:
    """Program of the linearised loop of a study's law and drive."""
    return build_structure(with_margin_modes(study))._replace(
        n_frequencies=1,
        has_noise=False,
        metrics=(),
        has_position_gain=spec.has_position_gain(parts_of(study)),
    )


def _excess(
    structure: Structure,
    names: tuple[Any, ...],
    case: Case,
    pose: Array,
    matrices: LoopMatrices,
    limits: Array,
    places: dict[str, MarginPlace],
) -> Array:
    """x/(1 + |x|) for each limit, (m,): decay rates reach hundreds of their limit on both sides.

    x is value/limit - 1, or -decay/STABLE of the loop with all gains times the required margin.
    Figures of `jaxmodel.robustness` are those of stable loops: others count as 1 - decay/STABLE,
    which is what margins reach at the edge.
    """
    period, excesses = case.electronics.period, []
    wanted = tuple(name for name in names if name in (*MARGINS, *PEAKS))
    if wanted:
        response = response_of_loop(structure, case, prepare(structure, case).loop, pose)
        figures = {name: margin_at(response, name, place) for name, place in places.items()}
        peaks = tuple(name for name in names if name in PEAKS)
        figures |= norm_peaks(response, peaks) if peaks else {}
        own_decay = slowest_decay(matrices.open + matrices.feedback, period)
    for k, name in enumerate(names):
        if name in wanted:
            share = figures[name] / limits[k]
            within = 1 - share if name in MARGINS else share - 1
            x = jnp.where(own_decay > 0, within, 1 - own_decay / STABLE)
        elif name == "spillover":
            x = spillover(structure, case, matrices) / limits[k] - 1
        elif name == "singularity_distance":
            x = 1 - _singularity_distance(structure, case) / limits[k]
        else:
            factor = limits[k] if name == "gain_margin" else 1.0
            decay = slowest_decay(matrices.open + factor * matrices.feedback, period)
            x = -decay / STABLE if name == "gain_margin" else 1 - decay / limits[k]
        excesses.append(x / (1 + jnp.abs(x)))
    return jnp.stack(excesses)


def _singularity_distance(structure: Structure, case: Case) -> Array:
    """Of the straight lines between way-points [rad], ()."""
    points, share = case.path.waypoints, jnp.linspace(0.0, 1.0, PATH_POINTS)[:, None, None]
    line = points[:-1] + share * (points[1:] - points[:-1])
    pose = jnp.concatenate([points, jnp.reshape(line, (-1, 3))])
    return singularity_distance(prepare(structure, case).loop.plant, pose)


# compiled without optimisation: it takes a fraction of the time
@kept_jit(static_argnums=(0, 1), compiler_options={"xla_backend_optimization_level": 0})
def _responses(
    structure: Structure, place: Any, numbers: Numbers, pose: Array, values: Array
) -> tuple[SampledLoopResponse, tuple[Array, Array]]:
    """What a search of margins reads of each design."""

    def one(x: Array, numbers: Numbers) -> tuple[SampledLoopResponse, tuple[Array, Array]]:
        return response_and_modes(structure, case_of(structure, place(numbers, x)), pose)

    return jax.vmap(one)(values, numbers)


@kept_jit(static_argnums=(0, 1, 2))
def _limit_slopes(
    structure: Structure,
    names: tuple[Any, ...],
    place: Any,
    numbers: Numbers,
    pose: Array,
    limits: Array,
    values: Array,
    places: dict[str, MarginPlace],
) -> tuple[Array, Array]:
    def figures(
        x: Array, numbers: Numbers, limit: Array, places: dict[str, MarginPlace]
    ) -> tuple[Array, Array]:
        case = case_of(structure, place(numbers, x))
        matrices = closed_loop(structure, case, pose)
        excess = _excess(structure, names, case, pose, matrices, limit, places)
        return excess, excess

    def one(design: tuple[Any, ...]) -> tuple[Array, Array]:
        slope, excess = jax.jacrev(figures, has_aux=True)(*design)  # the figures come with it
        return excess, slope

    return jax.lax.map(one, (values, numbers, limits, places))


@kept_jit(static_argnums=(0, 1, 2, 6))
def _screen_batch(
    structure: Structure,
    names: tuple[Any, ...],
    place: Any,
    numbers: Numbers,
    pose: Array,
    limits: Array,
    links: tuple[int, ...],
    values: Array,
) -> tuple[Array, Array]:
    def one(x: Array) -> tuple[Array, Array]:
        case = case_of(structure, place(numbers, x))
        matrices = closed_loop(structure, case, pose)
        rms = linear_residual(structure, case, matrices)
        excess = _excess(structure, names, case, pose, matrices, limits, {})
        return excess, jnp.sqrt(jnp.mean(rms[np.array(links)] ** 2))

    return jax.lax.map(one, values)


_closed_loop = kept_jit(static_argnums=0)(closed_loop)
_spillover = kept_jit(static_argnums=0)(spillover)
_distance = kept_jit(static_argnums=0)(_singularity_distance)


def loop_figures(spec: TuneSpec, study: Study) -> DesignFigures:
    """Figures of a design's loop on a plant of 12 modes or more.

    Args:
        spec: of the tuning; its designs of one law and drive share a program.
        study: one of them, with sampled feedback.
    """
    larger = with_margin_modes(study)
    structure, case = _judged_structure(spec, study), as_arrays(build_case(larger))
    plain = structure._replace(n_steps=1, substeps=1)
    matrices = _closed_loop(plain, case, np.array(larger.motion.waypoints[0]))
    open_loop, feedback = np.asarray(matrices.open), np.asarray(matrices.feedback)
    period = float(case.electronics.period)

    def poles(factor: float) -> np.ndarray:
        return np.linalg.eigvals(open_loop + factor * feedback)

    margin = gain_margin(poles)
    limited = tuple(name for name in (*MARGINS, *PEAKS) if name in spec.loop_limits)
    one = jax.tree.map(lambda x: np.asarray(x)[None], case)
    robust = judge_robustness(plain, one, limited, np.array([margin]))
    return DesignFigures(
        margin,
        float(-np.log(np.abs(poles(1.0)).max()) / period),
        float(_spillover(plain, case, matrices)),
        float(_distance(plain, case)),
        **{name: float(value[0]) for name, value in robust.items()},
    )
