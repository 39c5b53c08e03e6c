"""Rating of a design: objective and limits from its runs and its loops."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.metrics import Metrics
from jaxmodel.parameters import Array
from studies.engine.programs import kept_jit
from studies.study.entries import parse_entries
from studies.tuning.spec import BASELINE, LOWER, Family, TuneSpec

#: Metrics that a report always shows.
SHOWN = ("residual_rms", "settling_time", "peak_voltage")


class Objective(NamedTuple):
    """What a tuning minimises, and the metrics that it limits; hashable."""

    terms: tuple[tuple[str, float], ...]  # metric and weight
    loop: tuple[tuple[str, float], ...]  # figure of the loop and weight; all weights sum to 1
    limits: tuple[str, ...]  # metrics with a limit
    tail: float  # share of worst scenarios that count
    links: tuple[int, ...]  # those that count if a name gives no link, from 0

    @property
    def metrics(self) -> tuple[str, ...]:
        """Fields of `Metrics` that it needs."""
        return _fields((*dict(self.terms), *self.limits))

    @property
    def shown(self) -> tuple[str, ...]:
        """Names that reports show: those requested, and `SHOWN`."""
        return tuple(dict.fromkeys((*dict(self.terms), *self.limits, *SHOWN)))

    @property
    def shown_metrics(self) -> tuple[str, ...]:
        """Fields of `Metrics` that those need."""
        return _fields(self.shown)


class ScenarioFigures(NamedTuple):
    """What the objective of a design is made of, in each scenario."""

    metrics: Metrics  # (S, ...)
    loop: Array  # terms of the loop in the order of `Objective.loop`, nan: unstable, (S, t)


def _fields(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted({parse_entries(name).metric for name in names}))


def objective_of(spec: TuneSpec) -> Objective:
    """Objective of a tuning."""
    total = sum(map(float, spec.tune.objective.values()))
    weights = {name: float(weight) / total for name, weight in spec.tune.objective.items()}
    return Objective(
        terms=tuple((name, weights[name]) for name in spec.metric_terms),
        loop=tuple((name, weights[name]) for name in spec.loop_terms),
        limits=spec.metric_limits,
        tail=float(spec.tune.scenarios.tail),
        links=spec.counted_links,
    )


def entries(goal: Objective, metrics: Metrics, name: str) -> Array:
    """Entries of a metric, of the links that count, (S, n)."""
    chosen = parse_entries(name)
    return chosen.take(getattr(metrics, chosen.metric), goal.links)


def size(goal: Objective, metrics: Metrics, name: str) -> Array:
    """Root of the mean square of the entries, (S,)."""
    square = jnp.mean(entries(goal, metrics, name) ** 2, axis=1)
    # the root has no slope at 0; NaN stays NaN
    return jnp.where(square == 0, 0.0, jnp.sqrt(jnp.where(square == 0, 1.0, square)))


def largest(goal: Objective, metrics: Metrics, name: str) -> Array:
    """Largest entry, (S,)."""
    return jnp.max(entries(goal, metrics, name), axis=1)


def tail_weights(count: int, tail: float) -> np.ndarray:
    """Weights of scenarios, worst first, that average the worst share of them (CVaR), (S,)."""
    most = max(tail * count, 1.0)
    return np.clip(most - np.arange(count), 0.0, 1.0) / most


def objectives(goal: Objective, design: ScenarioFigures, baseline: ScenarioFigures) -> Array:
    """Objective in each scenario, (S,); the baseline's is 1.

    Sum of weight times the share of the baseline's value: of the size of a metric and of a figure
    of the loop, the other way round of figures of which more is better.

    Args:
        goal: weights.
        design: (S, ...).
        baseline: in the same scenarios, (S, ...).
    """
    shares = [
        weight * size(goal, design.metrics, x) / size(goal, baseline.metrics, x)
        for x, weight in goal.terms
    ]
    for k, (name, weight) in enumerate(goal.loop):
        share = design.loop[:, k] / baseline.loop[:, k]
        shares.append(weight * (1 / share if name in LOWER else share))
    return jnp.sum(jnp.stack(shares), axis=0)


def judge_design(
    goal: Objective, design: ScenarioFigures, baseline: ScenarioFigures, allowed: Array
) -> tuple[Array, Array, Array]:
    """Judge a design.

    Args:
        goal: terms and limits.
        design: (S, ...).
        baseline: (S, ...).
        allowed: limits in each scenario, (S, m).

    Returns:
        objective (), largest value over limit - 1 (m,), largest values (m,).
    """
    each = objectives(goal, design, baseline)
    weights = tail_weights(each.shape[0], goal.tail)
    values = [largest(goal, design.metrics, name) for name in goal.limits]
    peaks = jnp.stack(values, axis=1) if values else jnp.zeros((each.shape[0], 0))
    excess = jnp.max(peaks / allowed - 1, axis=0)
    return jnp.sum(-jnp.sort(-each) * weights), excess, jnp.max(peaks, axis=0)


@kept_jit(static_argnums=0)
def judge_designs(
    goal: Objective, designs: ScenarioFigures, baseline: ScenarioFigures, allowed: Array
) -> tuple[Array, Array, Array]:
    """`judge_design` for designs under the same limits, leaves (designs, S, ...)."""
    return jax.vmap(lambda x: judge_design(goal, x, baseline, allowed))(designs)


class JudgedDesigns(NamedTuple):
    """Designs judged."""

    objective: Array  # (designs,)
    limits: Array  # largest value over limit - 1, (designs, m)
    peaks: Array  # largest values, (designs, m)
    cotangents: ScenarioFigures  # of objective and limits, (1 + m, designs, S, ...)


@kept_jit(static_argnums=0)
def judge_with_cotangents(
    goal: Objective, designs: ScenarioFigures, baseline: ScenarioFigures, allowed: Array
) -> JudgedDesigns:
    """Judge designs and differentiate by what was measured.

    Args:
        goal: terms and limits.
        designs: (designs, S, ...).
        baseline: (S, ...).
        allowed: limits in each scenario, (designs, S, m).
    """

    def one(design: ScenarioFigures, allowed: Array) -> JudgedDesigns:
        def figures(x: ScenarioFigures) -> tuple[Array, Array]:
            objective, limits, peaks = judge_design(goal, x, baseline, allowed)
            return jnp.concatenate([objective[None], limits]), peaks

        values, back, peaks = jax.vjp(figures, design, has_aux=True)
        (cotangents,) = jax.vmap(back)(jnp.eye(values.size, dtype=values.dtype))
        return JudgedDesigns(values[0], values[1:], peaks, cotangents)

    axes: Any = JudgedDesigns._make((0, 0, 0, 1))
    return jax.vmap(one, out_axes=axes)(designs, allowed)


def baseline_limits(goal: Objective, baseline: Metrics) -> np.ndarray:
    """The baseline's values, (S, m)."""
    columns = [np.asarray(largest(goal, baseline, name)) for name in goal.limits]
    count = len(jax.tree.leaves(baseline)[0])
    return np.stack(columns, axis=1) if columns else np.zeros((count, 0))


def allowed_limits(goal: Objective, family: Family, baseline: np.ndarray) -> np.ndarray:
    """Limits of a family's runs in each scenario, (S, m); `baseline` is from `baseline_limits`."""
    limits = [family.limits[name] for name in goal.limits]
    columns = [
        baseline[:, k] if x == BASELINE else np.full(len(baseline), float(x))
        for k, x in enumerate(limits)
    ]
    return np.stack(columns, axis=1) if columns else baseline
