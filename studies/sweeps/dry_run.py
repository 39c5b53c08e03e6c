"""The plan of a sweep, before it runs."""

from __future__ import annotations

from rich.console import Console

from studies.engine.preflight import check_run
from studies.engine.sweep import Plan
from studies.errors import StudyError
from studies.show.units import count_text
from studies.space.table import CaseTable, case_study
from studies.study.paths import field_unit, parse_entry
from studies.sweeps.show import Rows, print_rows, short_value


def print_plan(plan: Plan, console: Console) -> None:
    """Print what a sweep would run, and a sample case; builds no program."""
    table = plan.table
    console.print(
        f"{len(table)} cases ({table.n_dropped} left out by where, {table.n_double} duplicates, "
        f"{plan.n_before} already computed)"
    )
    print_rows(axis_rows(table), console)
    for group in plan.groups:
        layout, structure = group.layout, group.structure
        console.print(
            f"program: {'linear model, ' if structure.is_linear else ''}law {structure.law}, "
            f"{structure.basis}, "
            f"{count_text(structure.n_modes, 'mode')}, {structure.feedback} feedback, "
            f"{count_text(structure.n_steps, 'sample')} of "
            f"{count_text(structure.substeps, 'plant step')}: "
            f"{count_text(len(group.rows), 'case')} in {count_text(len(group.chunks()), 'chunk')} "
            f"of {count_text(layout.devices, 'device')} x {count_text(layout.blocks, 'block')} x "
            f"{count_text(layout.lanes, 'lane')}"
        )
    middle = len(table) // 2
    values = ", ".join(f"{name} = {short_value(c[middle])}" for name, c in table.columns.items())
    console.print(f"sample: case {middle}, id {table.case_id[middle].decode()}: {values}")
    try:
        check_run(case_study(table, middle))
    except StudyError as error:
        console.print(f"the sample cannot run: {error}")
    if not plan.groups:
        console.print("nothing left to run")


def axis_rows(table: CaseTable) -> Rows:
    """Number of values of each column of a sweep, and their range."""
    rows = []
    for name, column in table.columns.items():
        entry = parse_entry(name)
        unit = field_unit(entry.field if entry else name)
        is_numeric = column.dtype.kind in "fi"
        ends = [f"{column.min():.4g}", f"{column.max():.4g}"] if is_numeric else ["", ""]
        rows.append([name, unit, str(len({str(value) for value in column.tolist()})), *ends])
    return Rows(["axis", "unit", "values", "smallest", "largest"], rows)
