"""What a tuned design is worth: with the real converters, on machines it was not tuned on."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel import status
from jaxmodel.sampled_loop import loop_report
from jaxmodel.simulate import Result
from studies.cases import as_arrays, build_case, build_cases, build_structure
from studies.fields import parse_entry
from studies.spec import Study, parse_study
from studies.sweeps.axes import replaced
from studies.sweeps.executor import make_executor
from studies.sweeps.plan import even_layout
from studies.tuning.evaluate import largest, metrics_of, scenario_columns, size, with_margin_modes
from studies.tuning.free import PLACEMENT, POLES
from studies.tuning.spec import LOOP_LIMITS, TuneSpec


class Judged(NamedTuple):
    """One design on fresh scenarios, the first of them the study's own machine."""

    objective: np.ndarray  # nan where a run did not finish, (S,)
    metrics: dict[str, np.ndarray]  # size or largest entry of each metric that counts, (S,)
    status: np.ndarray  # (S,)
    gain_margin: float  # of the linearised sampled loop; nan with other feedback [1]


def tuned_study(spec: TuneSpec, values: np.ndarray) -> Study:
    """The study with the free numbers set.

    Args:
        spec: of the tuning.
        values: of the free numbers, (p,).
    """
    study = spec.study
    case = spec.free.place(as_arrays(build_case(study)), values)
    whole = {}
    if any(name.startswith(PLACEMENT) for name in spec.free.names):
        whole["patches.centers"] = case.machine.patches.center
    if any(name.startswith(POLES) for name in spec.free.names):
        whole["control.velocity_gain"] = case.control.velocity_gain
        whole["control.position_gain"] = case.control.position_gain
    plain = zip(spec.free.names, values, strict=True)
    whole |= {name: v for name, v in plain if not name.startswith((PLACEMENT, *POLES))}
    data = study.model_dump()
    for name, value in whole.items():
        entry = parse_entry(name)
        assert entry is not None
        section, _, leaf = entry.field.partition(".")
        new = np.asarray(value).tolist()
        data[section][leaf] = replaced(data[section][leaf], entry.indices, new)
    return parse_study(data)


def judge(spec: TuneSpec, designs: list[Study]) -> list[Judged]:
    """Run designs on scenarios that the tuning has not seen.

    Args:
        spec: of the tuning.
        designs: studies that differ from the tuning's own in numbers only.
    """
    result = _run(spec, designs)
    count, found = spec.tune.scenarios.check, []
    for k, study in enumerate(designs):
        part = slice(k * count, (k + 1) * count)
        metrics = jax.tree.map(lambda x: np.asarray(x)[part], result.metrics)  # noqa: B023
        sizes = {name: np.asarray(size(metrics, name)) for name in spec.tune.objective}
        peaks = {
            name: np.asarray(largest(metrics, name))
            for name in spec.tune.limits
            if name not in LOOP_LIMITS
        }
        objective = sum(weight * sizes[name] for name, weight in spec.tune.objective.items())
        codes = result.status[part]
        judged = np.where(np.isin(codes, status.FINISHED), objective, np.nan)
        found.append(Judged(judged, {**sizes, **peaks}, codes, _gain_margin(study)))
    return found


def _run(spec: TuneSpec, designs: list[Study]) -> Result:
    """All scenarios of the first design, then of the next, in one batch."""
    count = spec.tune.scenarios.check
    columns = scenario_columns(spec, count, spec.tune.scenarios.seed + 1)
    has_position = any(any(g != 0 for g in study.control.position_gain) for study in designs)
    structure = build_structure(designs[0])._replace(
        metrics=metrics_of(spec), has_position_gain=has_position
    )
    layout = even_layout(count * len(designs))
    rows = np.minimum(np.arange(layout.size), count * len(designs) - 1)
    parts = [build_cases(study, columns, structure) for study in designs]

    def joined(*leaves: np.ndarray) -> np.ndarray:
        return np.concatenate([np.broadcast_to(x, (count, *x.shape[1:])) for x in leaves])[rows]

    return make_executor(structure, layout, False).start(jax.tree.map(joined, *parts)).wait()


def _gain_margin(study: Study) -> float:
    if study.control.feedback != "sampled":
        return float("nan")
    larger = with_margin_modes(study)
    case = as_arrays(build_case(larger))
    pose = np.array(larger.motion.waypoints[0])
    return loop_report(build_structure(larger), case, pose).gain_margin
