"""Machines and moves that designs must handle, as columns of a table of cases."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from studies.engine.chunks import distinct_loops
from studies.show.units import count_text
from studies.space.machines import drawn_machines
from studies.study.cases import build_structure
from studies.study.fields import Columns, column_of
from studies.study.numbers import build_cases
from studies.study.paths import as_list, as_tuples, known_field, set_values
from studies.study.spec import Study, parse_study
from studies.tuning.spec import Family, TuneSpec, others


def scenario_columns(
    spec: TuneSpec, count: int, seed: int, is_fresh: bool = False
) -> dict[str, np.ndarray]:
    """What scenarios change: machine by machine within each move.

    Args:
        spec: of the tuning.
        count: machines.
        seed: of their shifts and of their noise.
        is_fresh: all machines differ from the nominal one; otherwise it is the first.

    Returns:
        Columns of `count` rows for each move.
    """
    spread, moves = spec.tune.scenarios.spread, len(spec.moves)
    noise = np.random.default_rng(seed).integers(1, 10**9, count)
    is_own = (np.arange(count) == 0) & (not is_fresh)
    machines = {"run.seed": np.where(is_own, spec.study.run.seed, noise)}
    if spread:
        machines |= drawn_machines(spec.study, spread, count, seed)
    for name in spread:
        machines[name][is_own] = known_field(name, spec.study)
    for name, values in spec.tune.scenarios.machines.items():
        baseline = [] if is_fresh else [known_field(name, spec.study)]
        column = [as_tuples(x) for x in baseline + others(values, count, is_fresh)]
        if any(isinstance(x, tuple) for x in column):  # one number stands for all links
            column = [as_list(name, x, spec.study) for x in column]
        machines[name] = column_of(column)
    columns = {name: _repeat(column, moves) for name, column in machines.items()}
    for name in spec.tune.scenarios.each:
        columns[name] = np.repeat(column_of([move[name] for move in spec.moves]), count, axis=0)
    return columns


class LoopMachines(NamedTuple):
    """Machines of some scenarios, each once: noise and most moves leave the loop as it is."""

    columns: dict[str, np.ndarray]  # of the first scenario with each, (machines, ...)
    of_scenario: np.ndarray  # machine of each scenario, (S,)

    @property
    def size(self) -> int:
        """How many there are."""
        return len(self.columns["run.seed"])


def loop_machines(spec: TuneSpec, columns: dict[str, np.ndarray]) -> LoopMachines:
    """Machines whose linearised loops differ, for any law and drive of the tuning.

    Args:
        spec: of the tuning.
        columns: from `scenario_columns`.
    """
    every = []
    for parts in dict.fromkeys([spec.parts(), *map(spec.parts, spec.families)]):
        study = spec.studies(parts)[0]
        every.append(distinct_loops(build_cases(study, columns, build_structure(study)))[1])
    loops = np.stack(every, axis=1)
    loops = np.broadcast_to(loops, (len(columns["run.seed"]), loops.shape[1]))
    _, first, own = np.unique(loops, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    kept = {name: column[first[order]] for name, column in columns.items()}
    return LoopMachines(kept, np.argsort(order)[np.ravel(own)])


def tuned_machines(spec: TuneSpec) -> LoopMachines:
    """Machines of a tuning, the nominal one first."""
    scenarios = spec.tune.scenarios
    return loop_machines(spec, scenario_columns(spec, scenarios.count, scenarios.seed))


def fresh_machines(spec: TuneSpec) -> str:
    """What designs are judged on, in words."""
    if spec.tune.scenarios.has_others:
        return count_text(spec.tune.scenarios.check, "fresh machine")
    return f"{count_text(spec.tune.scenarios.check, 'run')} of the nominal machine"


def move_label(move: dict[str, Any]) -> str:
    """Name of a move, "" if there is only one."""
    return ", ".join(f"{name} = {value}" for name, value in move.items())


def lane_columns(
    spec: TuneSpec, columns: dict[str, np.ndarray], families: list[Family | None]
) -> Columns:
    """Columns for designs times scenarios, design by design.

    Columns equal to the baseline's values are omitted: what all runs share is prepared once.

    Args:
        spec: of the tuning.
        columns: from `scenario_columns`.
        families: of each design; None is the baseline.
    """
    count = len(next(iter(columns.values())))
    lanes = {name: _repeat(column, len(families)) for name, column in columns.items()}
    for name in sorted({name for family in families if family for name in family.columns}):
        baseline = known_field(name, spec.study)
        values = [family.columns.get(name, baseline) if family else baseline for family in families]
        lanes[name] = np.repeat(column_of(values), count, axis=0)
    return {
        name: column
        for name, column in lanes.items()
        if not _is_everywhere(column, known_field(name, spec.study))
    }


def _repeat(column: np.ndarray, times: int) -> np.ndarray:
    """All rows of a column, several times over."""
    return np.concatenate([column] * times)


def _is_everywhere(column: np.ndarray, value: Any) -> bool:
    """Whether a column has this value in all rows."""
    if column.dtype == object:  # lists of unequal length
        return all(row == value for row in column)
    same = np.asarray(value)
    return column.shape[1:] == same.shape and bool(np.all(column == same))


def nominal(spec: TuneSpec, family: Family | None) -> Study:
    """The nominal machine on the first move, with a family's settings."""
    study = family.study(spec.study) if family else spec.study
    move = spec.moves[0]
    return parse_study(set_values(study, move)) if move else study
