"""A sweep as a page to look at, see `studies.explorer`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from jaxmodel import status
from jaxmodel.loop_figures import HIGHEST
from studies.engine.results import (
    SweepData,
    direction,
    metric_values,
    read_sweep,
    swept_names,
    uncontrolled_value,
)
from studies.engine.stored import kept_metrics
from studies.errors import StudyError
from studies.explorer.replays import replayed, rows_to_replay
from studies.explorer.table import Column, ExplorerTable, Placement, text_column
from studies.extensions import options
from studies.show.figures import is_wide
from studies.show.units import is_cut_off, readable
from studies.show.words import baseline_text
from studies.space.table import CaseTable, case_study
from studies.study.fields import Fields
from studies.study.margin import ENOUGH
from studies.sweeps.records import BESIDE, MARGIN, is_there, reason, watched
from studies.sweeps.sensitivity import scalar_columns
from studies.sweeps.show import (
    is_ranked,
    ranked_cases,
    ranking,
    ranking_warnings,
    recommended,
    requirement,
    shown_metric,
    unit_of_metric,
)

#: Figures by which replayed cases are chosen, beside the one that ranks.
_FIGURES = (MARGIN, "peak_voltage")
#: Of the cases that meet a condition, how many of the best are replayed.
FIRST = 6


def explore_sweep(
    folder: Path, on_progress: Callable[[int, int], None], subject_to: str = ""
) -> ExplorerTable:
    """Cases of a sweep, with a few of them replayed.

    Args:
        folder: of a sweep, finished or not.
        on_progress: called with the numbers of replayed cases, and of all.
        subject_to: condition on metrics and axes; the best cases that meet it are replayed, too.

    Raises:
        StudyError: no sweep there, or no case has what ranks them or meets the condition.
    """
    data = read_sweep(folder)
    rank = ranking(data)
    codes = data["status"]
    if not _has_numbers(data, rank):
        why = " ".join(data.notes) or "so there is nothing to explore"
        raise StudyError(f"{folder}: no case has {rank}; {why}")
    names = [rank, *(x for x in (MARGIN, *BESIDE, *kept_metrics(data.spec)) if x != rank)]
    figures = [_figure(data, x) for x in dict.fromkeys(names) if _has_numbers(data, x)]
    table = ExplorerTable(
        title=data.spec.study.title,
        noun="case",
        columns=(*_parameters(data), *figures),
        status=codes,
        reasons={int(code): reason(int(code)) for code in np.unique(codes)},
        names=tuple(map(str, range(data.n_cases))),
        rank=rank,
        baseline=_baseline(data, [x.name for x in figures]),
        conditions=_conditions(data, rank),
        command=(
            f"studies {options()}simulate {quote(str(folder))} --case ",
            " --report --out case-",
            ".h5",
        ),
        placement=_placement(data.table),
        notes=(*data.notes, *_warnings(data, rank)),
        about=_about(data),
    )
    n_ok = int(np.sum(codes == status.OK))
    by = [x for x in (rank, *_FIGURES) if _has_numbers(data, x)]
    smaller = [(-1 if direction(x) == "largest" else 1) * metric_values(data, x) for x in by]
    wanted = ranked_cases(data, rank, subject_to, FIRST).tolist() if subject_to else []
    others = rows_to_replay(table.order[:n_ok], np.stack(smaller, axis=1))
    rows = list(dict.fromkeys([*wanted, *others]))
    done = replayed(rows, lambda row: case_study(data.table, row), on_progress)
    return table._replace(replays=done)


def _about(data: SweepData) -> dict[str, str]:
    """What varied, and in which machine."""
    varied = ", ".join(swept_names(data)) or "a list of cases"
    return {
        "varied": f"{varied} ({data.spec.sweep.method})",
        "baseline": baseline_text(data.spec.study),
    }


def _warnings(data: SweepData, rank: str) -> tuple[str, ...]:
    """What to know before acting on the best cases."""
    if not is_ranked(data, rank):
        return ()
    linear = "Figures are those of the linear model, drawn motions of the full one."
    said = ranking_warnings(data, recommended(data, rank), rank)  # as the page begins
    return (linear, *said) if data.spec.sweep.fidelity == "linear" else tuple(said)


def _conditions(data: SweepData, rank: str) -> dict[str, float]:
    """The gain margin that recommended cases have, if any has it."""
    return {MARGIN: ENOUGH} if MARGIN in requirement(data, rank) else {}


def _parameters(data: SweepData) -> list[Column]:
    """What varies."""
    columns = []
    for name, values in scalar_columns(data):
        if values.dtype.kind in "UO":
            columns.append(text_column(name, values, is_parameter=True))
            continue
        unit = unit_of_metric(data, name)
        columns.append(
            Column(
                name=name,
                unit=unit,
                value=values.astype(float),
                is_parameter=True,
                is_log=is_wide(values),
            )
        )
    return columns


def _has_numbers(data: SweepData, name: str) -> bool:
    """Whether some case has this figure, as one number of one unit."""
    return is_there(data, name) and ";" not in unit_of_metric(data, name)


def _figure(data: SweepData, name: str) -> Column:
    values = shown_metric(data, name).astype(float)
    if name.startswith("settling_time"):  # beyond what was watched nothing is known
        values = np.where(is_cut_off(1e-3 * values, watched(data)), np.nan, values)
    return Column(
        name=name,
        unit=_shown_unit(data, name),
        value=values,
        is_log=is_wide(values),
        better=direction(name),
        bound=HIGHEST if name == MARGIN else np.inf,
    )


def _shown_unit(data: SweepData, name: str) -> str:
    return readable(unit_of_metric(data, name))[1]


def _baseline(data: SweepData, names: list[str]) -> dict[str, float]:
    """Figures without control, in the units shown."""
    found: dict[str, Any] = {name: uncontrolled_value(data, name) for name in names}
    settling = found.get("settling_time")
    if settling is not None and np.all(is_cut_off(settling, watched(data))):
        del found["settling_time"]
    return {
        name: readable(unit_of_metric(data, name))[0] * value
        for name, value in found.items()
        if value is not None
    }


def _placement(table: CaseTable) -> Placement:
    """Links and patches of every case."""
    fields, n = Fields(table.study, table.fields), len(table)

    def all_cases(array: np.ndarray) -> np.ndarray:
        return np.broadcast_to(array, (n, *array.shape[1:]))

    centers = fields.numbers("patches.centers")
    if centers.ndim == 2:  # one list for all links
        centers = np.repeat(centers[:, None], table.study.n_links, axis=1)
    is_on = fields.numbers("control.links") * (fields.raw("control.feedback") != "none")[:, None]
    lengths = ("link.length", "patches.actuator_length", "patches.sensor_length")
    length, actuator, sensor = (1e3 * all_cases(fields.each_link(name)) for name in lengths)
    return Placement(
        length=length,
        actuator=actuator,
        sensor=sensor,
        centers=1e3 * all_cases(centers),
        is_controlled=all_cases(is_on),
    )
