"""The plan of a sweep, before it runs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from studies.config import usable_cores
from studies.engine.chunks import run_quietly
from studies.engine.plan import Group, local_layout
from studies.engine.preflight import check_run
from studies.engine.stored import chunk_arrays
from studies.errors import StudyError
from studies.phases import duration_text
from studies.result import Result
from studies.results.labelled import Labelled, labelled, told
from studies.show.listing import Rows
from studies.show.report import Report
from studies.show.units import count_text
from studies.space.table import CaseTable, case_study
from studies.study.fields import idle_axes
from studies.study.paths import field_unit, parse_entry
from studies.sweeps.records import Record
from studies.sweeps.run import Plan
from studies.sweeps.show import short_value

#: Cases of each program that are run to measure how long all of them take.
MEASURED = 32


class Estimate(Labelled):
    """Time and storage that cases take."""

    seconds: float = labelled("s", "of running and judging")
    compile_seconds: float = labelled("s", "spent here, which commands need not spend again")
    bytes: float = labelled("byte", "of results on disk")
    measured_cases: int = told("that were run")


class SweptAxis(Labelled):
    """What varies in a sweep."""

    name: str = told("of the column")
    unit: str = told("SI symbol, 1 for none")
    n_values: int = told("how many values")
    smallest: float | None = told("of them, in that unit; null for what is no number")
    largest: float | None = told("the same")


class PlannedProgram(Labelled):
    """A program of a sweep, and the cases that it runs."""

    law: str = told("of control")
    basis: str = told("of the links' modes")
    feedback: str = told("sampled, ideal or none")
    is_linear: bool = told("whether it is of the linear model")
    n_modes: int = told("per link")
    n_samples: int = told("of a run")
    substeps: int = told("plant steps per sample")
    n_cases: int = told("that it runs")
    n_chunks: int = told("of these")
    devices: int = told("side by side")
    blocks: int = told("of cases on each")
    lanes: int = told("cases of a block")


class PlanDocument(Labelled, command="sweep"):
    """What `studies sweep --dry-run --json` prints: the plan of a sweep."""

    title: str = told("of the study")
    n_cases: int = told("cases, or designs of which some are kept")
    n_left_out: int = told("by where; of designs of which some are kept, of a few of them")
    n_duplicates: int = told("left out, of the same")
    n_computed: int = told("cases that --resume finds in the folder")
    axes: list[SweptAxis] = told("what varies, of the same")
    programs: list[PlannedProgram] = told("what would be compiled and run")
    sample: dict[str, Any] = told("the case in the middle: number, id, what varies")
    sample_fault: str = told("why the sample cannot run, empty if it can")
    estimate: Estimate = told("of the cases left, in one process on this machine")


def estimate(plan: Plan) -> Estimate:
    """What the cases left take in this process, measured on some of each program."""
    seconds, compiling, size, measured = 0.0, 0.0, 0.0, 0
    for group in plan.groups:
        count, n_cases = min(MEASURED, len(group.rows)), plan.n_cases(group)
        chosen = np.linspace(0, len(group.rows) - 1, count).astype(int)
        some = group._replace(
            rows=group.rows[chosen],
            is_too_stiff=group.is_too_stiff[chosen],
            layout=local_layout(count, group.structure),
        )
        spent = []
        for _ in range(2):  # the first one compiles
            began = time.perf_counter()
            chunks = list(run_quietly(plan.table, [some]))
            spent.append(time.perf_counter() - began)
        share = n_cases / count
        seconds += share * spent[1]
        compiling += max(spent[0] - spent[1], 0.0)
        for done in chunks if group.is_judged else ():  # those of others are not stored
            arrays = chunk_arrays(plan.table, done, list(done.judged.result.metrics))
            size += share * sum(x.nbytes for x in arrays.values())
        measured += count
    return Estimate(seconds, compiling, size, measured)


def estimate_text(plan: Plan, found: Estimate) -> str:
    """The same as a sentence."""
    left = sum(map(plan.n_cases, plan.groups))
    return (
        f"time: about {duration_text(found.seconds)} for {count_text(left, 'case')} in this "
        f"process on {count_text(usable_cores(), 'core')}, by {found.measured_cases} that "
        f"were run, and what compiling takes, {duration_text(found.compile_seconds)} just now; "
        f"N machines like this one (--workers) take 1/N. Storage: "
        f"about {found.bytes / 2**20:.2g} MiB"
    )


@dataclass(frozen=True, eq=False)
class PlannedSweep(Result):
    """What a sweep would do, and how long that would take."""

    plan: Plan

    @cached_property
    def estimate(self) -> Estimate:
        """What the cases left take in this process, measured on some of each program."""
        return estimate(self.plan)

    def document(self) -> PlanDocument:
        return plan_document(self.plan, self.estimate)


def say(planned: PlannedSweep) -> Report:
    """What a sweep would run, a sample case, and how long it would take."""
    plan, table = planned.plan, planned.plan.table
    sample = sample_record(table)
    values = ", ".join(f"{name} = {short_value(sample[name])}" for name in table.axes)
    fault = sample_fault(table)
    is_timed = plan.groups and not (fault and len(table) == 1)
    return Report(
        title=f"{table.study.title}: plan",
        result=[cases_text(plan), *idle_axes(table.study, table.columns)],
        question="",
        next_steps="",
        top=[
            axis_rows(table),
            *(_program_text(plan, group) for group in plan.groups),
            f"sample: case {sample['case']}, id {sample['case_id']}: {values}",
            fault and f"the sample cannot run: {fault}",
            "" if plan.groups else "nothing left to run",
            estimate_text(plan, planned.estimate) if is_timed else "",
        ],
        chapters=[],
        files={},
    )


def _program_text(plan: Plan, group: Group) -> str:
    layout, structure = group.layout, group.structure
    n_cases, n_chunks = plan.n_cases(group), plan.n_chunks(group)
    return (
        f"program: {'linear model, ' if structure.is_linear else ''}law {structure.law}, "
        f"drive {structure.drive}, {structure.basis}, "
        f"{count_text(structure.n_modes, 'mode')}, {structure.feedback} feedback, "
        f"{count_text(structure.n_steps, 'sample')} of "
        f"{count_text(structure.substeps, 'plant step')}: "
        f"{count_text(n_cases, 'case')} in {count_text(n_chunks, 'chunk')} "
        f"of {count_text(layout.devices, 'device')} x {count_text(layout.blocks, 'block')} x "
        f"{count_text(layout.lanes, 'lane')}"
    )


def cases_text(plan: Plan) -> str:
    """What there is to run, in a sentence."""
    table, screen = plan.table, plan.screen
    if screen is None:
        return (
            f"{count_text(len(table), 'case')} ({table.n_dropped} left out by where, "
            f"{table.n_double} duplicates, {plan.n_before} already computed)"
        )
    sweep = screen.spec.sweep
    margin = f" with a gain margin of at least {sweep.margin:g}" if sweep.margin else ""
    shards = count_text(screen.n_shards, "shard")
    return (
        f"{screen.n_designs:,} designs in {shards} ({plan.n_before:,} already computed) by the "
        f"{sweep.fidelity} model; of them the best {sweep.keep:,}{margin} by the full one. Axes "
        f"and programs are told from {len(table):,} designs"
    )


def plan_document(plan: Plan, found: Estimate) -> PlanDocument:
    """What `studies sweep --dry-run` says; found: what it would take."""
    table = plan.table
    return PlanDocument(
        title=table.study.title,
        n_cases=len(table) if plan.screen is None else plan.screen.n_designs,
        n_left_out=table.n_dropped,
        n_duplicates=table.n_double,
        n_computed=plan.n_before,
        axes=axes_of(table),
        programs=[_program(plan, group) for group in plan.groups],
        sample=sample_record(table),
        sample_fault=sample_fault(table),
        estimate=found,
    )


def _program(plan: Plan, group: Group) -> PlannedProgram:
    structure = group.structure
    return PlannedProgram(
        law=structure.law,
        basis=structure.basis,
        feedback=structure.feedback,
        is_linear=structure.is_linear,
        n_modes=structure.n_modes,
        n_samples=structure.n_steps,
        substeps=structure.substeps,
        n_cases=plan.n_cases(group),
        n_chunks=plan.n_chunks(group),
        **group.layout._asdict(),
    )


def sample_record(table: CaseTable) -> Record:
    """The case in the middle: its number, its id, and what varies."""
    middle = len(table) // 2
    values = {name: column[middle] for name, column in table.columns.items()}
    return {"case": middle, "case_id": table.case_id[middle].decode()} | values


def sample_fault(table: CaseTable) -> str:
    """Why that case cannot run, "" if it can."""
    try:
        check_run(case_study(table, len(table) // 2))
    except StudyError as error:
        return str(error)
    return ""


def axes_of(table: CaseTable) -> list[SweptAxis]:
    """Number of values of each column of a sweep, and their range."""
    axes = []
    for name in table.axes:
        entry, column = parse_entry(name), table.columns[name]
        is_numeric = column.dtype.kind in "fi"
        axes.append(
            SweptAxis(
                name=name,
                unit=field_unit(entry.field if entry else name),
                n_values=len({str(value) for value in column.tolist()}),
                smallest=column.min() if is_numeric else None,
                largest=column.max() if is_numeric else None,
            )
        )
    return axes


def axis_rows(table: CaseTable) -> Rows:
    """The same as a table."""
    rows = [
        [x.name, x.unit, str(x.n_values), _end(x.smallest), _end(x.largest)] for x in axes_of(table)
    ]
    return Rows(["axis", "unit", "values", "smallest", "largest"], rows)


def _end(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
