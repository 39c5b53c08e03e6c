"""The plan of a sweep, before it runs."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from rich.console import Console

from studies.config import usable_cores
from studies.engine.chunks import run_quietly
from studies.engine.plan import Group, local_layout
from studies.engine.preflight import check_run
from studies.engine.progress import duration_text
from studies.engine.stored import chunk_arrays
from studies.errors import StudyError
from studies.results.labelled import Labelled, labelled, told
from studies.show.listing import Rows, print_rows
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
    is_linear: bool = told("of a screen")
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
    n_cases: int = told("cases")
    n_left_out: int = told("by where")
    n_duplicates: int = told("left out")
    n_computed: int = told("cases that --resume finds in the folder")
    axes: list[SweptAxis] = told("what varies")
    programs: list[PlannedProgram] = told("what would be compiled and run")
    sample: dict[str, Any] = told("the case in the middle: number, id, what varies")
    sample_fault: str = told("why the sample cannot run, empty if it can")
    estimate: Estimate = told("of the cases left, in one process on this machine")


def estimate(plan: Plan) -> Estimate:
    """What the cases left take in this process, measured on some of each program."""
    seconds, compiling, size, measured = 0.0, 0.0, 0.0, 0
    for group in plan.groups:
        count = min(MEASURED, len(group.rows))
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
        share = len(group.rows) / count
        seconds += share * spent[1]
        compiling += max(spent[0] - spent[1], 0.0)
        for done in chunks:
            arrays = chunk_arrays(plan.table, done, list(done.judged.result.metrics))
            size += share * sum(x.nbytes for x in arrays.values())
        measured += count
    return Estimate(seconds, compiling, size, measured)


def estimate_text(plan: Plan, found: Estimate) -> str:
    """The same as a sentence."""
    left = sum(len(group.rows) for group in plan.groups)
    return (
        f"time: about {duration_text(found.seconds)} for {count_text(left, 'case')} in this "
        f"process on {count_text(usable_cores(), 'core')}, by {found.measured_cases} that "
        f"were run, and what compiling takes, {duration_text(found.compile_seconds)} just now; "
        f"N machines like this one (--scheduler) take 1/N. Storage: "
        f"about {found.bytes / 2**20:.2g} MiB"
    )


def print_plan(plan: Plan, console: Console) -> None:
    """Print what a sweep would run, a sample case, and how long it would take."""
    table = plan.table
    console.print(
        f"{count_text(len(table), 'case')} ({table.n_dropped} left out by where, "
        f"{table.n_double} duplicates, {plan.n_before} already computed)"
    )
    for line in idle_axes(table.study, table.columns):
        console.print(line)
    print_rows(axis_rows(table), console)
    for group in plan.groups:
        layout, structure = group.layout, group.structure
        console.print(
            f"program: {'linear model, ' if structure.is_linear else ''}law {structure.law}, "
            f"drive {structure.drive}, {structure.basis}, "
            f"{count_text(structure.n_modes, 'mode')}, {structure.feedback} feedback, "
            f"{count_text(structure.n_steps, 'sample')} of "
            f"{count_text(structure.substeps, 'plant step')}: "
            f"{count_text(len(group.rows), 'case')} in {count_text(len(group.chunks()), 'chunk')} "
            f"of {count_text(layout.devices, 'device')} x {count_text(layout.blocks, 'block')} x "
            f"{count_text(layout.lanes, 'lane')}"
        )
    sample = sample_record(table)
    values = ", ".join(f"{name} = {short_value(sample[name])}" for name in table.axes)
    console.print(f"sample: case {sample['case']}, id {sample['case_id']}: {values}")
    if fault := sample_fault(table):
        console.print(f"the sample cannot run: {fault}")
    if not plan.groups:
        console.print("nothing left to run")
    if not plan.groups or (sample_fault(table) and len(table) == 1):
        return
    console.print("measuring how long that takes ...")
    console.print(estimate_text(plan, estimate(plan)), soft_wrap=True)


def plan_document(plan: Plan) -> PlanDocument:
    """What `studies sweep --dry-run` says."""
    table = plan.table
    return PlanDocument(
        title=table.study.title,
        n_cases=len(table),
        n_left_out=table.n_dropped,
        n_duplicates=table.n_double,
        n_computed=plan.n_before,
        axes=axes_of(table),
        programs=[_program(group) for group in plan.groups],
        sample=sample_record(table),
        sample_fault=sample_fault(table),
        estimate=estimate(plan),
    )


def _program(group: Group) -> PlannedProgram:
    structure = group.structure
    return PlannedProgram(
        law=structure.law,
        basis=structure.basis,
        feedback=structure.feedback,
        is_linear=structure.is_linear,
        n_modes=structure.n_modes,
        n_samples=structure.n_steps,
        substeps=structure.substeps,
        n_cases=len(group.rows),
        n_chunks=len(group.chunks()),
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
