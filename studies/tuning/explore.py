"""A tuning as a page to look at, see `studies.explorer`: where each starting point led."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from studies.engine.folder import TUNING
from studies.errors import StudyError
from studies.explorer.replays import MOST_REPLAYS, replayed
from studies.explorer.table import Column, ExplorerTable, Placement, text_column
from studies.job import KINDS
from studies.reading import parse_json, read_json
from studies.results.labelled import Variable
from studies.show.figures import is_wide
from studies.show.units import readable
from studies.show.words import baseline_text
from studies.store import read_store
from studies.study.spec import Study
from studies.tuning.check import tuned_study
from studies.tuning.folder import RESULTS
from studies.tuning.spec import TuneSpec, parse_tuning

MANIFEST = KINDS["tune"].mark
#: Statuses of a starting point.
_REASONS = {0: "descended", 1: "stopped: a run did not finish"}


def explore_tuning(folder: Path, on_progress: Callable[[int, int], None]) -> ExplorerTable:
    """The best design from each starting point of a tuning, with a few of them replayed.

    Args:
        folder: of a finished tuning.
        on_progress: called with the numbers of replayed cases, and of all.

    Raises:
        StudyError: the tuning is not finished, or its file is damaged.
    """
    if not (folder / RESULTS).is_file():
        raise StudyError(f"{folder}: the tuning is not finished; continue it with --resume")
    data, attributes = read_store(folder / RESULTS)
    try:
        spec = parse_tuning(parse_json(attributes["tuning"]))
        values, names = data["value"].data, data["start_family"].data
        columns = (*_parameters(data), *_figures(data))
        table = ExplorerTable(
            title=spec.study.title,
            noun="starting point",
            columns=columns,
            status=data["is_frozen"].data.astype(int),
            reasons=_REASONS,
            names=tuple(str(k + 1) for k in range(len(values))),
            rank="objective",
            placement=_placement(spec, data),
            about={
                "free": ", ".join(str(name) for name in data["free"].data),
                "baseline": baseline_text(spec.study),
            },
            notes=_is_stale(folder, attributes),
        ).checked()
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        raise StudyError(f"{folder / RESULTS}: damaged ({error})") from None
    families = {family.name: family for family in spec.families}

    def study_of(row: int) -> Study:
        return tuned_study(spec, families[str(names[row])], values[row])

    rows = [int(row) for row in table.order[:MOST_REPLAYS] if table.status[row] == 0]
    done = replayed(rows, study_of, on_progress)
    return table._replace(replays=done)


def _is_stale(folder: Path, attributes: Mapping[str, Any]) -> tuple[str, ...]:
    """That the results are those of another file than the one the folder was last begun with."""
    try:
        begun = read_json(folder / TUNING).get("spec")
    except (OSError, ValueError, AttributeError):
        return ()
    if begun == parse_json(attributes["tuning"]):
        return ()
    return (
        f"{folder / RESULTS} is of another tuning file than {folder / TUNING}: the tuning begun "
        "last is not finished. What is shown is the earlier one.",
    )


def _parameters(data: dict[str, Variable]) -> list[Column]:
    """The family and the free parameters."""
    values = data["value"].data
    units = ["" if unit == "1" else str(unit) for unit in data["free_unit"].data]
    return [
        text_column("family", data["start_family"].data, is_parameter=True),
        *(
            Column(
                name=str(name),
                unit=unit,
                value=values[:, k],
                is_parameter=True,
                is_log=is_wide(values[:, k]),
            )
            for k, (name, unit) in enumerate(zip(data["free"].data, units, strict=True))
        ),
    ]


def _figures(data: dict[str, Variable]) -> list[Column]:
    """Objective, linear residual vibration and how far each limit is kept."""
    factor, unit = readable("m")
    residual = factor * data["linear_residual"].data
    columns = [
        _smaller("objective", "", data["objective"].data),
        _smaller("linear_residual", unit, residual),
    ]
    if "excess" in data:
        excess = data["excess"].data
        limits = data["limit"].data
        columns += [_smaller(f"excess of {x}", "", excess[:, k]) for k, x in enumerate(limits)]
    return columns


def _smaller(name: str, unit: str, values: np.ndarray) -> Column:
    value = np.where(np.isfinite(values), values, np.nan).astype(float)
    return Column(name, unit, value, is_log=is_wide(value), better="smallest")


def _placement(spec: TuneSpec, data: dict[str, Variable]) -> Placement:
    """Patches of each design; families may control other links than the baseline."""
    centers = 1e3 * data["patch_center"].data
    shape = centers.shape[:2]
    links = {family.name: family.study(spec.study).control.links for family in spec.families}
    study = spec.study
    fields = study.link.length, study.patches.actuator_length, study.patches.sensor_length
    length, actuator, sensor = (np.broadcast_to(1e3 * study.each_link(x), shape) for x in fields)
    is_on = np.array([links[str(name)] for name in data["start_family"].data])
    return Placement(
        length=length, actuator=actuator, sensor=sensor, centers=centers, is_controlled=is_on
    )
