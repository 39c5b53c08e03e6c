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
from studies.cases import build_cases
from studies.fields import parse_entry
from studies.runs import check_run
from studies.sweeps.axes import known_field
from studies.sweeps.gradients import make_gradients
from studies.sweeps.plan import LANES, Layout, lane_unit
from studies.tuning.spec import LOOP_LIMITS, TuneSpec

#: Slowest motion that counts as stable where `gain_margin` is limited [1/s].
STABLE = 1.0


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
        checked, self._case = check_run(study)
        self._structure = _structure(spec, checked)
        columns = scenarios(spec)
        self.scenarios = spec.tune.scenarios.count
        tiled = {name: np.tile(column, designs) for name, column in columns.items()}
        n = designs * self.scenarios
        self._layout = _layout(n)
        rows = np.minimum(np.arange(self._layout.size), n - 1)
        padded = {name: column[rows] for name, column in tiled.items()}
        cases = build_cases(study, padded, self._structure)
        real = jax.dtypes.canonicalize_dtype(np.float64)
        self._cases = jax.tree.map(lambda x: x if x.dtype.kind == "i" else x.astype(real), cases)
        self._rows = rows // self.scenarios  # design of every lane
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
        one = jax.jit(jax.vmap(partial(_judged, self.spec)))
        objective, slope, limits, limit_slope = jax.tree.map(np.asarray, one(metrics, slopes))
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

    def _loop_limits(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        names = [name for name in self.limit_names if name in LOOP_LIMITS]
        wanted = tuple((name, self.spec.tune.limits[name]) for name in names)
        plain = self._structure._replace(n_steps=1, substeps=1, n_frequencies=1, has_noise=False)
        pose = np.array(self.spec.study.motion.waypoints[0])
        found = _loop(plain, wanted, self.spec.free.place, self._case, pose, values)
        return np.asarray(found[0]), np.asarray(found[1])


def _structure(spec: TuneSpec, structure: Structure) -> Structure:
    """That of all scenarios; whatever may be free is there."""
    names = {parse_entry(name).field for name in (*spec.tune.objective, *spec.tune.limits)}  # type: ignore[union-attr]
    kept = tuple(sorted(names - set(LOOP_LIMITS)))
    has_position = any("position_gain" in n or "poles" in n for n in spec.free.names)
    return structure._replace(
        metrics=kept, has_position_gain=structure.has_position_gain or has_position
    )


def _layout(n: int) -> Layout:
    devices = len(jax.local_devices())
    unit = lane_unit()
    lanes = min(LANES, -(-n // (unit * devices)) * unit)
    return Layout(devices, -(-n // (devices * lanes)), lanes)


def scenarios(spec: TuneSpec) -> dict[str, np.ndarray]:
    """Columns of the fields that scenarios change, and their seeds; the first is the study itself.

    Args:
        spec: of the tuning.
    """
    asked = spec.tune.scenarios
    columns = {"run.seed": spec.study.run.seed + np.arange(asked.count)}
    if asked.spread:
        sampler = qmc.LatinHypercube(len(asked.spread), rng=asked.seed)
        shift = 2 * sampler.random(asked.count) - 1
        shift[0] = 0.0
        for k, (name, percent) in enumerate(asked.spread.items()):
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
            weight * jnp.mean(_size(metrics, name)) for name, weight in spec.tune.objective.items()
        )
        limits = [
            jnp.max(_largest(metrics, name)) / limit - 1
            for name, limit in spec.tune.limits.items()
            if name not in LOOP_LIMITS
        ]
        return jnp.asarray(objective), jnp.asarray(limits)

    along = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), slopes)
    (objective, limits), (slope, limit_slope) = jax.vmap(
        lambda direction: jax.jvp(figures, (metrics,), (direction,)), out_axes=((None, None), 0)
    )(along)
    return objective, slope, limits, jnp.moveaxis(limit_slope, 0, -1)


def _entries(metrics: Metrics, name: str) -> Array:
    """Entries of a metric, (S, n)."""
    entry = parse_entry(name)
    assert entry is not None
    data = getattr(metrics, entry.field)
    return jnp.reshape(data[(slice(None), *entry.indices)], (data.shape[0], -1))


def _size(metrics: Metrics, name: str) -> Array:
    """Root of the mean square of the entries, (S,)."""
    square = jnp.mean(_entries(metrics, name) ** 2, axis=1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _largest(metrics: Metrics, name: str) -> Array:
    return jnp.max(_entries(metrics, name), axis=1)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _loop(
    structure: Structure, wanted: tuple, place: Any, case: Case, pose: Array, values: Array
) -> tuple[Array, Array]:
    """Limits of the linearised sampled loop and their derivatives, (designs, m) and (.., m, p)."""

    def figures(values: Array) -> Array:
        matrices = closed_loop(structure, place(case, values), pose)
        found = []
        for name, limit in wanted:
            factor = limit if name == "gain_margin" else 1.0
            needed = STABLE if name == "gain_margin" else limit
            whole = matrices.open + factor * matrices.feedback
            found.append(1 - slowest_decay(whole, case.electronics.period) / needed)
        return jnp.asarray(found)

    def one(values: Array) -> tuple[Array, Array]:
        return figures(values), jax.jacrev(figures)(values)

    return jax.lax.map(one, values)
