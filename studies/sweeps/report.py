"""The report of a sweep: what varied, how its cases ended, the best, and what failed and why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxmodel import status
from studies.errors import StudyError, shown
from studies.pages import literal, picture, table, write_report
from studies.sweeps.axes import SHOWN_AS
from studies.sweeps.plots import plot, save_plot
from studies.sweeps.results import SweepData, kept_metrics, load, metric_values
from studies.sweeps.show import (
    DEFAULT_METRIC,
    SHARES,
    Rows,
    axis_rows,
    best_cases,
    case_rows,
    cause_rows,
    label,
    margin_warning,
    status_rows,
)
from studies.sweeps.spec import Node
from studies.sweeps.table import Table, build_table
from studies.template import study_template, toml_text, toml_value

REPORT, FIGURE = "report.html", "cases.png"
#: More listed values of an axis are not spelt out.
MOST_VALUES = 12
#: What a block makes of its axes.
_METHODS = {
    "grid": "every combination of",
    "zip": "side by side",
    "list": "{} cases, spelt out in the file",
    "random": "{} random points of",
    "latin_hypercube": "{} points of Latin hypercubes of",
    "sobol": "{} Sobol points of",
    "morris": "{} trajectories of a Morris design of",
    "saltelli": "{} base points of a Saltelli design of",
}


def write_sweep_report(folder: Path) -> None:
    """Write `report.md` and `report.html` of a sweep, with its figure, into its folder.

    Args:
        folder: of a finished sweep.

    Raises:
        StudyError: no sweep there, or a file cannot be written.
    """
    data = load(folder)
    spec = data.spec
    metric = DEFAULT_METRIC if DEFAULT_METRIC in data.variables else kept_metrics(spec)[0]
    try:
        figure = plot(data, None, metric, None)
    except StudyError:  # no case is ok, or no axis is a single number or text
        has_figure = False
    else:
        save_plot(figure, folder / FIGURE)
        has_figure = True
    files = {"Sweep file": toml_text(spec.data), "Study of all cases": study_template(spec.study)}
    write_report(folder, report(data, metric, has_figure), files)


def report(data: SweepData, metric: str, has_figure: bool) -> str:
    """Markdown text.

    Args:
        data: the sweep.
        metric: what the best cases are ranked by.
        has_figure: whether there is a figure of it, `FIGURE`.
    """
    cases = build_table(data.spec)
    lines = [
        f"# {literal(data.spec.study.title)}: sweep", "",
        "## What varied", "",
        *_blocks(data.spec.root), "",
        *_counts(data, cases), "",
        *_table(axis_rows(cases)), "",
        "## How the cases ended", "",
        *_table(status_rows(data)), "",
        f"## Best cases by {metric}", "",
        *_best(data, metric), "",
    ]  # fmt: skip
    if has_figure:
        lines += [picture(FIGURE, f"Cases of status ok and their {metric}"), ""]
    causes = cause_rows(data)
    if causes.rows:
        lines += [
            "## What the failures depend on", "",
            "Distance: between a parameter's distributions in failed cases and in those of status "
            f"ok, 0 to 1. Failures: {SHARES}.", "",
            *_table(causes), "",
        ]  # fmt: skip
    return "\n".join(lines)


def _blocks(node: Node, depth: int = 0) -> list[str]:
    """A block with its axes and further blocks, as a nested list."""
    block, indent = node.block, "  " * depth
    lines = [f"{indent}- " + _METHODS[block.method].format(block.count or len(block.cases))]
    for name, written in block.axes.items():
        field = f" (`{SHOWN_AS[name]}`)" if name in SHOWN_AS else ""
        lines.append(f"{indent}  - `{name}`{field}: {literal(_values(written))}")
    for child in node.children:
        lines += _blocks(child, depth + 1)
    return lines


def _values(written: Any) -> str:
    """Values of an axis in words."""
    if isinstance(written, str):
        return written
    if isinstance(written, list):
        names = [value if isinstance(value, str) else shown(value) for value in written]
        more = f", ... ({len(names)} values)" if len(names) > MOST_VALUES else ""
        return ", ".join(names[:MOST_VALUES]) + more
    if "from" in written:
        count = f", {written['count']} values" if "count" in written else ""
        scale = ", log scale" if written.get("scale") == "log" else ""
        return f"{written['from']:g} to {written['to']:g}{count}{scale}"
    return toml_value(written)


def _counts(data: SweepData, cases: Table) -> list[str]:
    sweep = data.spec.sweep
    words = f"{len(cases)} cases"
    if sweep.repeats > 1:
        words += f", {sweep.repeats} runs of each with noise of its own among them"
    if sweep.where:
        words += f"; {cases.n_dropped} left out that do not fulfil {literal(sweep.where)}"
    if cases.n_double:
        words += f"; {cases.n_double} doubles run once"
    return [f"{words}. Seed of the design: {sweep.seed}. Columns that vary:"]


def _best(data: SweepData, metric: str) -> list[str]:
    if not np.isfinite(metric_values(data, metric)[data["status"] == status.OK]).any():
        return ["No case of status ok has it."]
    best = best_cases(data, metric)
    warning = margin_warning(data, best)
    return [
        f"Cases of status ok, smallest {label(data, metric)} first; a metric of several links or "
        "stations counts with the largest of the controlled links.", "",
        *([f"**{literal(warning)}**", ""] if warning else []),
        *_table(case_rows(data, best, [metric])),
    ]  # fmt: skip


def _table(found: Rows) -> list[str]:
    return table(found.heads, [map(literal, row) for row in found.rows])
