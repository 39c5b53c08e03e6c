"""What a sweep tells: what varied, how cases ended, the best ones, what failed and why."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from jaxmodel import status
from studies.engine.fidelity import Agreement, agreement
from studies.engine.results import SweepData, counted_links, metric_values, swept_names
from studies.errors import shown
from studies.publish import publish
from studies.show.pages import write_report
from studies.show.report import Chapter, Drawing, Items, Report, chapter, drawing, machine, sentence
from studies.show.units import count_text
from studies.space.axes import SHOWN_AS
from studies.space.methods import METHODS
from studies.space.spec import BlockNode, SweepSpec
from studies.space.table import case_study
from studies.study.margin import margin_in_db
from studies.study.template import toml_text, toml_value
from studies.sweeps import show
from studies.sweeps.dry_run import axis_rows
from studies.sweeps.environments import environments_text, has_environments
from studies.sweeps.plots import front, has_axes, plot
from studies.sweeps.records import MARGIN, is_there
from studies.sweeps.result import SweepResult
from studies.sweeps.screened import with_screen

#: Other metrics to check.
OTHERS = ("settling_time", "peak_voltage")
#: The best cases count as equal if they differ by less than this share.
ALIKE = 0.02
#: At most this many listed values of an axis are shown.
MOST_VALUES = 12


def write_sweep_report(sweep: SweepResult) -> None:
    """Write `report.html` of a sweep, with its figures, into its folder.

    Args:
        sweep: in its folder; as read, of one that keeps its best designs, it tells of these alone.

    Raises:
        StudyError: a file cannot be written.
    """
    assert sweep.folder is not None
    stale = ("cases.png", "front.png", "values.png", "influence.png")
    with publish(sweep.folder, stale=stale) as staging:
        write_report(sweep.report(), staging)


def say(sweep: SweepResult) -> Report:
    """What a sweep tells."""
    data, agreed = sweep.found, None
    if data.spec.sweep.fidelity == "linear":
        agreed = agreement(data.spec, data.table, show.ranking(data))
    asked = data.spec if sweep.screen is None else sweep.screen.screen.spec
    report = report_of(data, str(sweep.folder), agreed, asked)
    return report if sweep.screen is None else with_screen(report, sweep.screen, data)


def report_of(
    data: SweepData,
    folder: str = "DIR",
    agreed: Agreement | None = None,
    asked: SweepSpec | None = None,
) -> Report:
    """What the cases of a sweep tell.

    Args:
        data: of the sweep.
        folder: of the sweep, in commands.
        agreed: how a linear sweep ranks beside the full model, if that is known.
        asked: whose designs they are the best of; default: they are all that was asked for.
    """
    metric, spec = show.ranking(data), data.spec
    best = show.recommended(data, metric) if show.is_ranked(data, metric) else np.array([], int)
    shown_study = case_study(data.table, int(best[0])) if len(best) else spec.study
    return Report(
        title=f"{spec.study.title or 'untitled study'}: sweep",
        result=[*_best_texts(data, metric, best), *_run_texts(data, agreed)],
        question=f"""which of {count_text(data.n_cases, "case")} of
        {", ".join(swept_names(data)) or "a list"} are the
        {show.ranking_text(data, metric, show.requirement(data, metric))}?
        {show.runs_text(spec.study)}""",
        next_steps=_next_steps(data, metric, best, folder),
        top=[machine(shown_study, "Where cases differ: the best")],
        chapters=[
            _best_cases(data, metric, best),
            chapter("How the cases ended", show.status_rows(data)),
            _varied(data, asked or data.spec),
            _causes(data),
        ],
        files={"Sweep file": toml_text(spec.data), "Study of all cases": spec.study},
    )


def _best_texts(data: SweepData, metric: str, best: np.ndarray) -> list[str]:
    """The best case, and what to know before acting on it, in sentences."""
    if not len(best):
        what = "design has, in each of its environments," if has_environments(data) else "case has"
        return [f"no {what} {metric}"]
    first, value = int(best[0]), metric_values(data, metric)
    is_known = (data["status"] == status.OK) & np.isfinite(value)
    setting = ", ".join(
        f"{x} = {show.shown_value(data, x, first)} {show.unit_of_metric(data, x)}".rstrip()
        for x in swept_names(data)
    )
    quantity = partial(show.quantity, data, metric)
    text = f"best by {metric}: case {first} with {quantity(value[first])} ({setting})"
    if is_there(data, MARGIN) and np.isfinite(data[MARGIN][first]):
        text += f", gain margin {margin_in_db(float(data[MARGIN][first]))}"
    median = f"the median of the ok cases is {quantity(np.median(value[is_known]))}"
    idle, free = _idle_texts(data, metric, first), show.uncontrolled_text(data, metric)
    texts = ["; ".join(filter(None, (text, *idle, median, free)))]
    spread = np.ptp(value[best]) / max(abs(value[first]), 1e-300)
    if len(best) > 3 and spread < ALIKE:
        texts.append(
            f"**the {len(best)} best differ by only {100 * spread:.2g} %: {metric} does not "
            "distinguish them; rank by another metric**"
        )
    return texts + [f"**{warning}**" for warning in show.ranking_warnings(data, best, metric)]


def _idle_texts(data: SweepData, metric: str, case: int) -> list[str]:
    """Links that no case controls, and a metric of theirs, where it is one of links."""
    if "link" not in data.variables[metric.partition("[")[0]].dims or "link=" in metric:
        return []
    names = {k + 1: f"{metric}[link={k + 1}]" for k in np.flatnonzero(~counted_links(data))}
    return [
        f"link {link}, which no case controls: "
        f"{show.quantity(data, name, metric_values(data, name)[case])}"
        for link, name in names.items()
    ]


def _run_texts(data: SweepData, agreed: Agreement | None) -> list[str]:
    """How cases ended, what the linear model did, and how well it agrees with the full one."""
    counts = {name: count for name, count, _ in show.status_rows(data).rows}
    ended = f"{counts.pop('ok', 0)} of {count_text(data.n_cases, 'case')} ended ok"
    failures = "; ".join(f"{count}: {name}" for name, count in [*counts.items()][:3])
    texts = [f"{ended} ({failures})" if failures else ended]
    if data.spec.sweep.fidelity == "linear":
        texts.append(
            "**all runs are of the linear model** (`sweep.fidelity`); check the best cases with "
            "the full one"
        )
    if agreed is not None:
        texts.append(agreed.text + (", **too little to rank by**" if agreed.is_poor else ""))
    return texts


def _next_steps(data: SweepData, metric: str, best: np.ndarray, folder: str) -> str:
    if not len(best):
        return f"`studies show {folder} --failed` lists the failed cases, and what that depends on."
    condition = show.requirement(data, metric)
    subject = f' --subject-to "{condition}"' if condition else ""
    others = [x for x in OTHERS if x in data.variables and x != metric.partition("[")[0]]
    names = " or ".join(f"`--by {x}`" for x in others)
    alike = f"; check whether another metric ranks them alike ({names})" if others else ""
    case = f"{folder} --case {best[0]}"
    return f"""`studies best {folder} --by "{metric}"{subject}` for more of them, `studies simulate
    {case} --out run.h5 --report` for the trajectories of the best, `studies certify {case} --out
    certificate` for its safety on plants that differ from the model{alike}."""


def _best_cases(data: SweepData, metric: str, best: np.ndarray) -> Chapter | None:
    if not len(best):
        return None
    return chapter(
        f"Best cases by {metric}",
        _rival_text(data, metric, int(best[0])),
        environments_text(data),
        show.case_rows(data, best, [metric]),
        show.mark_note(data, best, metric),
        *_drawings(data, metric),
    )


def _drawings(data: SweepData, metric: str) -> list[Drawing]:
    """Those of the figures that these cases have."""
    drawn = []
    if has_axes(data, metric):
        drawn.append(drawing(plot, data, None, metric, name="cases"))
    if _has_front(data, metric):
        drawn.append(drawing(front, data, metric))
    return drawn


def _rival_text(data: SweepData, metric: str, first: int) -> str:
    """The case that is better but for its gain margin, in a sentence; "" if none is."""
    value, loose = metric_values(data, metric), show.requirement(data, metric, is_safe=False)
    free = int(show.ranked_cases(data, metric, loose, count=1)[0])
    if value[free] == value[first]:
        return ""
    return (
        f"Regardless of the margin, case {free} comes first, with "
        f"{show.quantity(data, metric, value[free])} at a margin of "
        f"{margin_in_db(float(data[MARGIN][free]), 3)}."
    )


def _has_front(data: SweepData, metric: str) -> bool:
    """Whether all cases with a metric have gain margins, which differ."""
    if not is_there(data, MARGIN):
        return False
    fine = data[MARGIN][(data["status"] == status.OK) & np.isfinite(metric_values(data, metric))]
    return len(fine) >= 3 and bool(np.isfinite(fine).all() and np.ptp(fine) > 0)


def _causes(data: SweepData) -> Chapter | None:
    causes = show.cause_rows(data)
    if not causes.rows:
        return None
    return chapter(
        "What the failures depend on",
        f"""Distance: between a parameter's distributions in failed cases and in those of status
        ok, 0 to 1. Failures: {show.SHARES}.""",
        causes,
    )


def _varied(data: SweepData, asked: SweepSpec) -> Chapter | None:
    sweep, table, axes = data.spec.sweep, data.table, _axes(asked.root)
    counts = count_text(data.n_cases, "case") + ", the best of them" * (asked is not data.spec)
    if sweep.repeats > 1:
        counts += f", including {sweep.repeats} runs of each with their own noise"
    if sweep.where:
        counts += f"; left out: {table.n_dropped} that do not fulfil {sweep.where}"
    if table.n_double:
        counts += f"; run only once: {count_text(table.n_double, 'duplicate')}"
    return chapter(
        "What varied",
        sentence(_method_text(asked.root) + (":" if axes else "")),
        Items(axes),
        f"{counts}. Seed of the design: {sweep.seed}.",
        axis_rows(table),
    )


def _method_text(node: BlockNode) -> str:
    """How a block combines its axes."""
    return METHODS[node.block.method].text.format(node.block.count or len(node.block.cases))


def _axes(node: BlockNode) -> list[str]:
    """The axes of a block with their values, and the further blocks in it."""
    texts = []
    for name, written in node.block.axes.items():
        field = f" (`{SHOWN_AS[name]}`)" if name in SHOWN_AS else ""
        texts.append(f"`{name}`{field}: {_values_text(written)}")
    return texts + [f"{_method_text(x)} {'; '.join(_axes(x))}" for x in node.children]


def _values_text(written: Any) -> str:
    """Values of an axis: a range as written, or each value in words."""
    if isinstance(written, list | tuple):
        texts = [value if isinstance(value, str) else shown(value) for value in written]
        more = f", ... ({len(texts)} values)" if len(texts) > MOST_VALUES else ""
        return ", ".join(texts[:MOST_VALUES]) + more
    if isinstance(written, str) or "from" not in written:
        return written if isinstance(written, str) else toml_value(written)
    count = f", {written['count']} values" if "count" in written else ""
    scale = ", log scale" if written.get("scale") == "log" else ""
    return f"{written['from']:g} to {written['to']:g}{count}{scale}"
