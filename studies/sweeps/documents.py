"""JSON documents of a sweep: its overview, its best cases, its sensitivities."""

from __future__ import annotations

import numpy as np

from jaxmodel import status
from studies.engine.results import (
    SweepData,
    direction,
    metric_values,
    swept_names,
    uncontrolled_value,
)
from studies.space.methods import Analysis
from studies.sweeps.records import (
    Record,
    case_records,
    failed_cases,
    failed_records,
    status_records,
    units,
    with_others,
)
from studies.sweeps.sensitivity import Cause, failure_causes
from studies.sweeps.show import (
    ranked_cases,
    ranking,
    ranking_warnings,
    requirement,
)


def show_document(data: SweepData, is_failed: bool) -> Record:
    """What `studies show` says; is_failed: with the failed cases one by one."""
    by = ranking(data)
    condition = requirement(data, by) if _has(data, by) else ""
    document = {
        "title": data.spec.study.title,
        "n_cases": data.n_cases,
        "axes": swept_names(data),
        "statuses": status_records(data),
        "causes": [_cause(cause) for cause in failure_causes(data)],
        "best": best_document(data, by, condition) if _has(data, by) else None,
    }
    return document | ({"failed": failed_records(data, failed_cases(data))} if is_failed else {})


def _cause(cause: Cause) -> Record:
    quarters = {
        name: {"share": share, "where": where}
        for name, (share, where) in (("low", cause.low), ("high", cause.high))
    }
    return cause._asdict() | quarters


def _has(data: SweepData, metric: str) -> bool:
    """Whether some case that is ok has a metric."""
    if metric.partition("[")[0] not in data.variables:
        return False
    return bool(np.isfinite(metric_values(data, metric)[data["status"] == status.OK]).any())


def best_document(data: SweepData, by: str, subject_to: str = "", count: int = 10) -> Record:
    """What `studies best` says; arguments and errors as `best_cases`."""
    name = by.removeprefix("-")
    cases, metrics = ranked_cases(data, by, subject_to, count), with_others(data, [name])
    return {
        "by": name,
        "direction": direction(by),
        "subject_to": subject_to,
        "without_control": uncontrolled_value(data, name),
        "environments": list(data.spec.sweep.environments),
        "over": str(data.spec.sweep.over),
        "cases": case_records(data, cases, metrics),
        "units": units(data, [*swept_names(data), *metrics]),
        "left_out": [x for x in status_records(data) if x["status"] != status.OK],
        "warnings": ranking_warnings(data, cases, name),
    }


def sensitivity_document(data: SweepData, by: str, analysis: Analysis) -> Record:
    """What `studies sensitivity` says of a metric."""
    return {
        "by": by,
        "method": data.spec.sweep.method,
        "n_rows": len(data.table.origin),
        "factors": [dict(zip(analysis.names, row, strict=True)) for row in analysis.values],
        "units": units(data, [by]),
        "n_left_out": analysis.n_left_out,
        "left_out": analysis.what,
        "notes": analysis.notes,
    }
