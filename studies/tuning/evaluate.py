"""Designs under all scenarios: objective, limits, and their derivatives by the free numbers.

Runs are differentiated forward (`studies.sweeps.gradients`), all scenarios of all designs in one
batch, with limits and rounding made smooth (`Structure.is_smooth`). The linearised sampled loop is
differentiated by itself.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from jaxmodel.case import Case, Structure
from jaxmodel.metrics import Metrics
from jaxmodel.parameters import Array
from jaxmodel.sampled_loop import closed_loop, slowest_decay
from studies.cases import as_arrays, build_case, build_cases
from studies.fields import parse_entry
from studies.runs import check_run
from studies.spec import Study
from studies.sweeps.axes import known_field
from studies.sweeps.gradients import make_gradients
from studies.sweeps.plan import even_layout
from studies.tuning.spec import LOOP_LIMITS, TuneSpec

#: Slowest motion that counts as stable where `gain_margin` is limited [1/s].
STABLE = 10.0
#: Plant modes of the linearised loop at least: modes that nobody controls limit the gains.
MARGIN_MODES = 12


class Evaluation(NamedTuple):
    """Designs and how they change; NumPy arrays."""

    objective: np.ndarray  # (designs,), nan where a scenario did not finish
    slope: np.ndarray  # by the free numbers, (designs, p)
    limits: np.ndarray  # value over limit - 1, positive where violated, (designs, m)
    limit_slope: np.ndarray  # (designs, m, p)
    status: np.ndarray  # of each run, (designs, scenarios)


class Evaluator:
    """Evaluates batches of one number of designs."""

    def __init__(self, spec: TuneSpec, designs: int) -> None:
        """
        Args:
            spec: what is free and what for.
            designs: in a batch.

        Raises:
            StudyError: as `check_run`.
        """
        self.spec, self.designs = spec, designs
        study = spec.study.change(run__smooth=True)
        checked, _ = check_run(study)
        self._structure = _structure(spec, checked)
        asked = spec.tune.scenarios
        columns = scenario_columns(spec, asked.count, asked.seed)
        self.scenarios = asked.count
        tiled = {name: np.tile(column, designs) for name, column in columns.items()}
        n = designs * self.scenarios
        self._layout = even_layout(n)
        rows = np.minimum(np.arange(self._layout.size), n - 1)
        padded = {name: column[rows] for name, column in tiled.items()}
        cases = build_cases(study, padded, self._structure)
        real = jax.dtypes.canonicalize_dtype(np.float64)
        self._cases = jax.tree.map(lambda x: x if x.dtype.kind == "i" else x.astype(real), cases)
        self._rows = rows // self.scenarios  # design of every lane
        larger = with_margin_modes(study)
        self._case = as_arrays(build_case(larger))
        self._plain = self._structure._replace(
            n_modes=larger.link.modes, n_steps=1, substeps=1, n_frequencies=1, has_noise=False,
            metrics=(),
        )  # fmt: skip
        self._pose = np.array(study.motion.waypoints[0])
        self._judge = jax.jit(jax.vmap(partial(_judged, spec)))
        self._gradients = make_gradients(self._structure, self._layout, spec.free.place)

    def evaluate(self, values: np.ndarray) -> Evaluation:
        """Objective and limits of designs.

        Args:
            values: of the free numbers in the study's units, (designs, p).
        """
        shape = (self.designs, self.scenarios)
        n = self.designs * self.scenarios
        runs = self._gradients.evaluate(self._cases, values[self._rows])

        def split(x: Any) -> np.ndarray:
            return np.asarray(x)[:n].reshape(shape + np.shape(x)[1:])

        metrics, slopes = (
            jax.tree.map(split, part) for part in (runs.result.metrics, runs.metrics)
        )
        judged = self._judge(metrics, slopes)
        objective, slope, limits, limit_slope = jax.tree.map(np.asarray, judged)
        if any(name in LOOP_LIMITS for name in self.spec.tune.limits):
            found, change = self._loop_limits(values)
            limits = np.concatenate([limits, found], axis=1)
            limit_slope = np.concatenate([limit_slope, change], axis=1)
        return Evaluation(objective, slope, limits, limit_slope, split(runs.result.status))

    @property
    def limit_names(self) -> tuple[str, ...]:
        """Names of the limits in the order of `Evaluation.limits`."""
        names = list(self.spec.tune.limits)
        return tuple(sorted(names, key=lambda name: name in LOOP_LIMITS))

    def loop_excess(self, values: np.ndarray) -> np.ndarray:
        """How far designs are from a stable linearised loop and its limits, (n,); cheap.

        Args:
            values: (n, p), any number of designs.
        """
        if self._structure.feedback != "sampled":
            return np.zeros(len(values))
        limits = self.spec.tune.limits
        wanted = [(name, limits[name]) for name in LOOP_LIMITS if name in limits]
        found = _loop_values(
            self._plain, tuple(wanted or [("slowest_decay", STABLE)]), self.spec.free.place,
            self._case, self._pose, values,
        )  # fmt: skip
        worst = np.asarray(found).max(axis=1)
        return np.where(np.isfinite(worst), worst, np.inf)

    def _loop_limits(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        names = [name for name in self.limit_names if name in LOOP_LIMITS]
        wanted = tuple((name, self.spec.tune.limits[name]) for name in names)
        found = _loop(self._plain, wanted, self.spec.free.place, self._case, self._pose, values)
        return np.asarray(found[0]), np.asarray(found[1])


def _structure(spec: TuneSpec, structure: Structure) -> Structure:
    """That of all scenarios; whatever may be free is there."""
    has_position = any("position_gain" in n or "poles" in n for n in spec.free.names)
    return structure._replace(
        metrics=metrics_of(spec), has_position_gain=structure.has_position_gain or has_position
    )


def with_margin_modes(study: Study) -> Study:
    """The study with as many plant modes as its gain margin is judged with."""
    return study.change(link__modes=max(MARGIN_MODES, study.link.modes))


def metrics_of(spec: TuneSpec) -> tuple[str, ...]:
    """Metrics that objective and limits are made of."""
    names = [parse_entry(name) for name in (*spec.tune.objective, *spec.tune.limits)]
    return tuple(sorted({entry.field for entry in names if entry} - set(LOOP_LIMITS)))


def scenario_columns(spec: TuneSpec, count: int, seed: int) -> dict[str, np.ndarray]:
    """Columns of the fields that scenarios change, and their seeds; the first is the study itself.

    Args:
        spec: of the tuning.
        count: scenarios.
        seed: of their shifts and of their noise.
    """
    spread = spec.tune.scenarios.spread
    noise = np.random.default_rng(seed).integers(1, 10**9, count)
    columns = {"run.seed": np.where(np.arange(count) > 0, noise, spec.study.run.seed)}
    if spread:
        shift = 2 * qmc.LatinHypercube(len(spread), rng=seed).random(count) - 1
        shift[0] = 0.0
        for k, (name, percent) in enumerate(spread.items()):
            columns[name] = known_field(name, spec.study) * (1 + percent / 100 * shift[:, k])
    return columns


def _judged(spec: TuneSpec, metrics: Metrics, slopes: Metrics) -> tuple:
    """Objective and limits of one design from the metrics of its runs, scenarios first.

    Args:
        spec: weights and limits.
        metrics: (S, ...).
        slopes: derivatives, (S, p, ...).
    """

    def figures(metrics: Metrics) -> tuple[Array, Array]:
        objective = sum(
            weight * jnp.mean(size(metrics, name)) for name, weight in spec.tune.objective.items()
        )
        limits = [
            jnp.max(largest(metrics, name)) / limit - 1
            for name, limit in spec.tune.limits.items()
            if name not in LOOP_LIMITS
        ]
        return jnp.asarray(objective), jnp.asarray(limits)

    along = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), slopes)
    (objective, limits), (slope, limit_slope) = jax.vmap(
        lambda direction: jax.jvp(figures, (metrics,), (direction,)), out_axes=((None, None), 0)
    )(along)
    return objective, slope, limits, jnp.moveaxis(limit_slope, 0, -1)


def entries(metrics: Metrics, name: str) -> Array:
    """Entries of a metric, (S, n)."""
    entry = parse_entry(name)
    assert entry is not None
    data = getattr(metrics, entry.field)
    return jnp.reshape(data[(slice(None), *entry.indices)], (data.shape[0], -1))


def size(metrics: Metrics, name: str) -> Array:
    """Root of the mean square of the entries, (S,)."""
    square = jnp.mean(entries(metrics, name) ** 2, axis=1)
    # the root has no slope at 0; what is no number stays none
    return jnp.where(square == 0, 0.0, jnp.sqrt(jnp.where(square == 0, 1.0, square)))


def largest(metrics: Metrics, name: str) -> Array:
    """Largest entry, (S,)."""
    return jnp.max(entries(metrics, name), axis=1)


def _loop_figures(
    structure: Structure, wanted: tuple, place: Any, case: Case, pose: Array, values: Array
) -> Array:
    """Limits of one design's linearised sampled loop, (m,), positive where violated.

    x/(1 + |x|) of x = 1 - value/limit: decay rates reach hundreds of the limit on both sides of it.
    """
    matrices = closed_loop(structure, place(case, values), pose)
    found = []
    for name, limit in wanted:
        factor = limit if name == "gain_margin" else 1.0
        needed = STABLE if name == "gain_margin" else limit
        whole = matrices.open + factor * matrices.feedback
        lack = 1 - slowest_decay(whole, case.electronics.period) / needed
        found.append(lack / (1 + jnp.abs(lack)))
    return jnp.asarray(found)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _loop_values(
    structure: Structure, wanted: tuple, place: Any, case: Case, pose: Array, values: Array
) -> Array:
    """Limits of designs, (designs, m)."""
    return jax.lax.map(partial(_loop_figures, structure, wanted, place, case, pose), values)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _loop(
    structure: Structure, wanted: tuple, place: Any, case: Case, pose: Array, values: Array
) -> tuple[Array, Array]:
    """Limits of designs and their derivatives, (designs, m) and (designs, m, p)."""
    figures = partial(_loop_figures, structure, wanted, place, case, pose)
    return jax.lax.map(lambda x: (figures(x), jax.jacrev(figures)(x)), values)
