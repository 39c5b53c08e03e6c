"""JSON documents of a sweep: its overview, its best cases, its sensitivities."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from jaxmodel import status
from studies.engine.results import SweepData, direction, swept_names, uncontrolled_value
from studies.results.breaking import BrokenCase
from studies.results.labelled import Labelled, told
from studies.space.methods import Analysis
from studies.sweeps.records import (
    StatusCount,
    case_records,
    failed_cases,
    failed_records,
    status_records,
    units,
    with_others,
)
from studies.sweeps.sensitivity import Cause, failure_causes
from studies.sweeps.show import is_ranked, ranked_cases, ranking, ranking_warnings, requirement

#: A value of a case: of an axis or a metric.
Cell: TypeAlias = bool | int | float | str | list[Any] | None
#: What units say.
_UNITS = "SI symbol of each number by its name, 1 for none; m; m; rad for the entries of a list"


class BestCases(Labelled, command="best", version=2):
    """What `studies best --json` prints: the best cases of a sweep by a metric."""

    by: str = told("metric that ranks the cases")
    direction: str = told("which values come first: smallest or largest")
    subject_to: str = told("condition that the cases meet, empty for none")
    without_control: float | None = told("the metric of the baseline then; null: not known")
    environments: list[str] = told("axes over which metrics of a case are those of its design")
    over: str = told("how: worst, mean, or a quantile")
    cases: list[dict[str, Cell]] = told("best first: number, id, what varies, metrics")
    units: dict[str, str] = told(_UNITS)
    left_out: list[StatusCount] = told("cases that are not ok and hence left out, by status")
    warnings: list[str] = told("margins that are too small, deflections below one ADC step")
    smallest_changes: list[BrokenCase] | None = told("with --breaks: of each case", default=None)


class Overview(Labelled, command="show", version=2):
    """What `studies show --json` prints: overview of a sweep."""

    title: str = told("of the study")
    n_cases: int = told("cases")
    axes: list[str] = told("what varies")
    statuses: list[StatusCount] = told("most frequent first")
    causes: list[Cause] = told("what failures depend on, strongest first")
    best: BestCases | None = told("by the sweep's ranking, null if no case has it")
    failed: list[dict[str, Cell]] | None = told("with --failed: all failed cases", default=None)


class Sensitivity(Labelled, command="sensitivity"):
    """What `studies sensitivity --json` prints: which parameters matter, most important first. The
    columns are those of the sweep's method.
    """

    by: str = told("metric")
    method: str = told("of the sweep")
    n_rows: int = told("of the design")
    factors: list[dict[str, Cell]] = told("a row each, with the intervals of 95 % where there are")
    units: dict[str, str] = told(_UNITS)
    n_left_out: int = told("lost to failed cases")
    left_out: str = told("what is counted there")
    notes: tuple[str, ...] = told("what to know of the figures")


def show_document(data: SweepData, is_failed: bool) -> Overview:
    """The overview of a sweep; is_failed: with the failed cases one by one."""
    by = ranking(data)
    best = None
    if is_ranked(data, by):
        condition = requirement(data, by)
        best = best_document(data, by, ranked_cases(data, by, condition), condition)
    return Overview(
        title=data.spec.study.title,
        n_cases=data.n_cases,
        axes=swept_names(data),
        statuses=status_records(data),
        causes=failure_causes(data),
        best=best,
        failed=failed_records(data, failed_cases(data)) if is_failed else None,
    )


def best_document(data: SweepData, by: str, cases: np.ndarray, condition: str = "") -> BestCases:
    """The best cases of a sweep, from `ranked_cases`."""
    name = by.removeprefix("-")
    metrics = with_others(data, [name])
    return BestCases(
        by=name,
        direction=direction(by),
        subject_to=condition,
        without_control=uncontrolled_value(data, name),
        environments=list(data.spec.sweep.environments),
        over=str(data.spec.sweep.over),
        cases=case_records(data, cases, metrics),
        units=units(data, [*swept_names(data), *metrics]),
        left_out=[x for x in status_records(data) if x.status != status.OK],
        warnings=ranking_warnings(data, cases, name),
    )


def sensitivity_document(data: SweepData, by: str, analysis: Analysis) -> Sensitivity:
    """What a sweep says of a metric."""
    return Sensitivity(
        by=by,
        method=data.spec.sweep.method,
        n_rows=len(data.table.origin),
        factors=[dict(zip(analysis.names, row, strict=True)) for row in analysis.values],
        units=units(data, [by]),
        n_left_out=analysis.n_left_out,
        left_out=analysis.what,
        notes=analysis.notes,
    )
