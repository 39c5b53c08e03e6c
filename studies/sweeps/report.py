"""The report of a sweep: what varied, how its cases ended, the best, and what failed and why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxmodel import status
from studies.engine.results import SweepData, load, metric_values, swept_names
from studies.errors import StudyError, shown
from studies.show.figures import styled
from studies.show.markdown import literal, opening, picture, table
from studies.show.pages import write_report
from studies.show.sketch import CAPTION, sketch
from studies.show.units import count_text, readable
from studies.space.axes import SHOWN_AS
from studies.space.methods import METHODS
from studies.space.spec import Node
from studies.space.table import Table, case_study
from studies.study.margin import ENOUGH, margin_text
from studies.study.spec import Study
from studies.study.template import study_template, toml_text, toml_value
from studies.sweeps.dry_run import axis_rows
from studies.sweeps.plots import front, plot, save_plot
from studies.sweeps.show import (
    MARGIN,
    SHARES,
    Rows,
    best_cases,
    case_rows,
    cause_rows,
    counted_text,
    label,
    margin_warning,
    ranking,
    recommended,
    shown_metric,
    shown_value,
    status_rows,
    unit_of_metric,
    written_name,
)

REPORT, FIGURE, FRONT, MACHINE = "report.html", "cases.png", "front.png", "machine.png"
#: Metrics to ask as well.
OTHERS = ("settling_time", "peak_voltage")
#: The best cases are as good as one where they differ by less than this share.
ALIKE = 0.02
#: More listed values of an axis are not spelt out.
MOST_VALUES = 12


#: What a block makes of its axes.
def write_sweep_report(folder: Path) -> None:
    """Write `report.md` and `report.html` of a sweep, with its figures, into its folder.

    Args:
        folder: of a finished sweep.

    Raises:
        StudyError: no sweep there, or a file cannot be written.
    """
    data = load(folder)
    spec = data.spec
    metric = ranking(data)
    drawn = []
    for name, draw in ((FIGURE, _all_axes), (FRONT, _front)):
        try:
            figure = draw(data, metric)
        except StudyError:  # no case is ok, or nothing to draw over
            continue
        save_plot(figure, folder / name)
        drawn.append(name)
    with styled():
        save_plot(sketch(_best_study(data, metric)), folder / MACHINE)
    files = {"Sweep file": toml_text(spec.data), "Study of all cases": study_template(spec.study)}
    write_report(folder, report(data, metric, [*drawn, MACHINE]), files)


def _all_axes(data: SweepData, metric: str) -> Figure:
    return plot(data, None, metric, None)


def _front(data: SweepData, metric: str) -> Figure:
    known = data[MARGIN] if MARGIN in data.variables else np.full(data.n_cases, np.nan)
    fine = known[(data["status"] == status.OK) & np.isfinite(metric_values(data, metric))]
    if len(fine) < 3 or not np.isfinite(fine).all() or np.ptp(fine) <= 0:
        raise StudyError("too few gain margins to draw over")
    return front(data, metric)


def _best_study(data: SweepData, metric: str) -> Study:
    """Of the best case; of the sweep itself where no case is ok."""
    try:
        return case_study(data.table, int(recommended(data, metric, 1)[0]))
    except StudyError:
        return data.spec.study


def report(data: SweepData, metric: str, drawn: list[str]) -> str:
    """Markdown text.

    Args:
        data: the sweep.
        metric: what the best cases are ranked by.
        drawn: figures that there are, of `FIGURE`, `FRONT` and `MACHINE`.
    """
    cases = data.table
    lines = [
        f"# {literal(data.spec.study.title)}: sweep",
        "",
        *opening(_asked(data, cases, metric), *_answer(data, metric)),
        *_figure(MACHINE, f"{CAPTION}. Of the best case, where cases differ", drawn),
        f"## Best cases by {metric}",
        "",
        *_best(data, metric),
        "",
    ]
    told = f"{metric} over the gain margin; the line: cases that no other beats in both"
    lines += [
        *_figure(FIGURE, f"Cases of status ok and their {metric}", drawn),
        *_figure(FRONT, told, drawn),
        "## How the cases ended",
        "",
        *_table(status_rows(data)),
        "",
        "## What varied",
        "",
        *_blocks(data.spec.root),
        "",
        *_counts(data, cases),
        "",
        *_table(axis_rows(cases)),
        "",
    ]
    causes = cause_rows(data)
    if causes.rows:
        lines += [
            "## What the failures depend on",
            "",
            "Distance: between a parameter's distributions in failed cases and in those of status "
            f"ok, 0 to 1. Failures: {SHARES}.",
            "",
            *_table(causes),
            "",
        ]
    return "\n".join(lines)


def _figure(name: str, caption: str, drawn: list[str]) -> list[str]:
    return [picture(name, caption), ""] if name in drawn else []


def _asked(data: SweepData, cases: Table, metric: str) -> str:
    axes = literal(", ".join(written_name(data, name) for name in swept_names(data)))
    return (
        f"{count_text(len(cases), 'case')} of {axes or 'a list'}, ranked by {metric} "
        f"(smallest first; {counted_text(data, metric)})."
    )


def _answer(data: SweepData, metric: str) -> tuple[str, str]:
    """What came out, and what to do next."""
    codes = data["status"]
    n_ok = int(np.sum(codes == status.OK))
    ended = f"{n_ok} of {count_text(data.n_cases, 'case')} ended ok"
    others = [f"{count}: {name}" for name, count, _ in status_rows(data).rows if name != "ok"][:3]
    told = f"{ended}{' (' + '; '.join(others) + ')' if others else ''}."
    value = metric_values(data, metric)
    if not np.isfinite(value[codes == status.OK]).any():
        return told, "look at what the failures depend on, below, and at `studies show --failed`."
    best = recommended(data, metric)
    first, shown = int(best[0]), shown_metric(data, metric)
    unit = readable(unit_of_metric(data, metric))[1]
    names = ", ".join(
        f"{written_name(data, name)} = {shown_value(data, name, first)}"
        for name in swept_names(data)
    )
    told += f" Best: case {first} with {shown[first]:.4g} {unit} ({literal(names)})"
    safe = MARGIN in data.variables and np.isfinite(data[MARGIN][first])
    if safe:
        told += f", gain margin {margin_text(data[MARGIN][first])}"
    others_ok = shown[(codes == status.OK) & np.isfinite(shown)]
    told += f"; half of the ok cases have {np.median(others_ok):.4g} {unit} or more."
    spread = float(np.ptp(shown[best]) / max(abs(shown[first]), 1e-300))
    if len(best) > 3 and spread < ALIKE:
        told += (
            f" **The {len(best)} best differ by {100 * spread:.2g} % only: {metric} does not tell "
            "them apart, ask another metric.**"
        )
    warning = margin_warning(data, best) if safe else ""
    if warning:
        told += f" **{literal(warning)}**"
    condition = ""
    if safe and data[MARGIN][first] >= ENOUGH:
        condition = f' --subject-to "{MARGIN} >= {ENOUGH:g}"'
    others = [x for x in OTHERS if x in data.variables and x != metric.partition("[")[0]]
    rivals = " or ".join(f"`--by {name}`" for name in others)
    rank = f"; before acting on it, see whether another metric ranks alike ({rivals})"
    return told, (
        f'`studies best DIR --by "{metric}"{condition}` for more of them, `studies replay DIR '
        f"--case {first} --out run.h5 --report` for the trajectories of the best"
        f"{rank if others else ''}."
    )


def _blocks(node: Node, depth: int = 0) -> list[str]:
    """A block with its axes and further blocks, as a nested list."""
    block, indent = node.block, "  " * depth
    lines = [f"{indent}- " + METHODS[block.method].text.format(block.count or len(block.cases))]
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
    value = metric_values(data, metric)
    if not np.isfinite(value[data["status"] == status.OK]).any():
        return ["No case of status ok has it."]
    best = recommended(data, metric)
    warning = margin_warning(data, best)
    told = f"Cases of status ok, smallest {label(data, metric)} first."
    if not warning and MARGIN in data.variables and np.isfinite(data[MARGIN][best]).any():
        told = f"Cases with a gain margin of {ENOUGH:g} or more, smallest {metric} first."
        free = best_cases(data, metric, count=1)
        if value[free[0]] < value[best[0]]:
            told += (
                f" Without regard to the margin case {free[0]} is first with "
                f"{shown_metric(data, metric)[free[0]]:.4g} at a margin of "
                f"{data[MARGIN][free[0]]:.3g}."
            )
    return [
        told,
        "",
        *([f"**{literal(warning)}**", ""] if warning else []),
        *_table(case_rows(data, best, [metric])),
    ]


def _table(found: Rows) -> list[str]:
    return table(found.heads, [map(literal, row) for row in found.rows])
