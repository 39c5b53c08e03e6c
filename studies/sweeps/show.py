"""Output of `studies show`, `studies best` and `studies sweep --dry-run`, and its tables."""

from __future__ import annotations

import warnings
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.columns import ON_DEMAND, PER_CASE
from studies.engine.results import (
    ROUNDING,
    SweepData,
    counted_links,
    direction,
    is_worse,
    meets,
    metric_values,
    swept_names,
    uncontrolled_value,
)
from studies.errors import ResolutionWarning, StudyError, field_error
from studies.show.listing import Rows
from studies.show.report import Part, Report, listed, sentence
from studies.show.units import count_text, headed, number, readable, settling_text
from studies.show.words import motion_text
from studies.space.methods import Analysis
from studies.study.entries import links_text
from studies.study.margin import ENOUGH, GUESSED, margin_text
from studies.study.resolution import is_deflection, least_step, resolution_text
from studies.study.spec import Study
from studies.study.window import residual_delay
from studies.sweeps.environments import (
    design_values,
    environments_text,
    has_environments,
    one_each,
    over_environments,
    over_text,
    whole_designs,
)
from studies.sweeps.records import (
    MARGIN,
    Record,
    case_records,
    failed_cases,
    failed_records,
    is_there,
    reason,
    status_records,
    watched,
    with_others,
)
from studies.sweeps.sensitivity import failure_causes, scalar_columns

if TYPE_CHECKING:
    import pandas

#: After a value that is worse than that of the baseline without control.
MARK = "*"


#: Digits of a case's id that tables show.
ID_DIGITS = 8


#: Rows of a table of failed cases.
LONGEST_TABLE = 100


#: What the last columns of `cause_rows` are.
SHARES = (
    "their share in the lowest and highest quarter of a number, and at the best and worst value of "
    "a choice"
)


def best_cases(data: SweepData, by: str, subject_to: str = "", count: int = 10) -> pandas.DataFrame:
    """The cases with the smallest metric, best first; for `LARGEST_FIRST`, the largest.

    For example `load("gains").best("residual_rms", "gain_margin > 2", count=5)`. Warns
    (`ResolutionWarning`) of deflections below one ADC step, which the controller cannot measure.

    Args:
        data: of the sweep.
        by: metric or entry of one; with "-" in front, in reverse order.
        subject_to: condition on metrics and axes.
        count: how many.

    Returns:
        A row per case, with its id, what varies, the metric, peak voltage, damping and gain margin,
        in SI units under their names in the sweep file. The index is the number of the case. With
        `sweep.environments`, a row per design with its metrics over them (`sweep.over`), under the
        case nearest to that.

    Raises:
        StudyError: an argument that is none, unknown metric, or no case left.
    """
    name = by.removeprefix("-")
    cases = ranked_cases(data, by, subject_to, count)
    text = resolution_warning(data, cases, name)
    if text:
        warnings.warn(text, ResolutionWarning, stacklevel=2)
    return _frame(data, {x: design_values(data, x) for x in with_others(data, [name])}, cases)


def table(data: SweepData) -> pandas.DataFrame:
    """All cases of a sweep, a row each.

    For example `load("gains").table().plot.scatter("control.gain_factor", "residual_rms")`, or
    `load("gains").table().status.value_counts()`.

    Args:
        data: of the sweep.

    Returns:
        By the number of the case: its id, what varies (of a list, such as a placement, a column per
        entry), how it ended in words, and each metric, margin and damping ratio that was kept, the
        worst over links, stations and modes, in SI units under their names in the sweep file.

    Raises:
        StudyError: no sweep there, a damaged file, or results of another version.
    """
    codes, which = np.unique(data["status"], return_inverse=True)
    words = np.array([reason(code) for code in codes.tolist()])[which]
    kept = [x for x in (MARGIN, "damping_ratio", *ON_DEMAND, *METRICS) if x in data.variables]
    varied = {"repeat": data["repeat"]} if data["repeat"].any() else {}
    values = {name: metric_values(data, name) for name in kept}
    return _frame(data, varied | {"status": words} | values, np.arange(data.n_cases))


def _frame(data: SweepData, columns: dict[str, np.ndarray], cases: np.ndarray) -> pandas.DataFrame:
    """Some cases with what varies, and these columns of all cases."""
    import pandas

    columns = {"case_id": data["case_id"], **dict(scalar_columns(data))} | columns
    rows = {name: column[cases] for name, column in columns.items()}
    return pandas.DataFrame(rows, index=pandas.Index(cases, name="case"))


def ranked_cases(data: SweepData, by: str, subject_to: str = "", count: int = 10) -> np.ndarray:
    """Numbers of the best cases; arguments and errors as `best_cases`, but no warning."""
    if count < 1:
        raise field_error("--count", count, "a whole number from 1")
    name, is_large = by.removeprefix("-"), direction(by) == "largest"
    value = metric_values(data, name)
    if value.dtype.kind not in "fiub":
        raise StudyError(f"--by {by}: a text, not a number")
    is_fine = (data["status"] == status.OK) & meets(data, subject_to, "--subject-to")
    chosen = np.flatnonzero(whole_designs(data, is_fine & np.isfinite(value)))
    of_all = "in each of its environments" if has_environments(data) else ""
    what = "design" if of_all else "case"
    if len(chosen) == 0 and subject_to:
        raise StudyError(
            f"--subject-to {subject_to!r}: no {what} with status ok meets it {of_all}".rstrip()
        )
    if len(chosen) == 0:
        raise StudyError(f"--by {by}: no {what} with status ok has this metric {of_all}".rstrip())
    if has_environments(data):
        chosen, value = one_each(data, by, chosen), over_environments(data, by)
    return chosen[np.argsort(-value[chosen] if is_large else value[chosen], kind="stable")][:count]


def overview(data: SweepData) -> Report:
    """How the cases ended, the best ones, and what the failures depend on."""
    by = ranking(data)
    best: list[Part] = []
    if is_ranked(data, by):
        condition = requirement(data, by)
        best = best_parts(data, by, condition, ranked_cases(data, by, condition))
    text = f"{data.spec.study.title}: {data.n_cases} cases, {', '.join(swept_names(data))}"
    return listed(text, status_rows(data), *best, *_cause_parts(data))


def best_report(
    data: SweepData, by: str, condition: str, cases: np.ndarray, agreed: str, changes: list[str]
) -> Report:
    """The best cases, how well a linear model ranks them, and what breaks each of them."""
    found = best_parts(data, by, condition, cases, agreed)
    return listed(*found, left_out(data), *changes)


def sensitivity_report(data: SweepData, by: str, analysis: Analysis) -> Report:
    """Which parameters matter for a metric."""
    text = f"{label(data, by)}, {len(data.table.origin)} rows of a {data.spec.sweep.method} design"
    rows = Rows(list(analysis.heads), [list(row) for row in analysis.rows])
    lost = f"left out because of failed cases: {analysis.n_left_out} {analysis.what}"
    return listed(text, *analysis.notes, rows, lost if analysis.n_left_out else "")


def _cause_parts(data: SweepData) -> list[Part]:
    causes = cause_rows(data)
    return [f"what the failures depend on ({SHARES}):", causes] if causes else []


def ranking_text(data: SweepData, by: str, condition: str = "") -> str:
    """Which cases are the best, in words."""
    name = by.removeprefix("-")
    met = f"of those with {condition}" if condition else ""
    parts = f"best cases by {name}", f"{direction(by)} first", counted_text(data, name), met
    return ", ".join(filter(None, parts))


def runs_text(study: Study) -> str:
    """What moves the machine and when vibration is residual, in sentences."""
    window, delay = study.metrics.residual_length, residual_delay(study)
    return (
        f"{sentence(motion_text(study))} Residual window: {number(window, 's')} ms, from "
        f"{number(delay, 's')} ms after the reference trajectory."
    )


def is_ranked(data: SweepData, metric: str) -> bool:
    """Whether some case that is ok, or design whose cases are, has a metric."""
    try:
        return bool(len(ranked_cases(data, metric, count=1)))
    except StudyError:
        return False


def status_rows(data: SweepData) -> Rows:
    """Number of cases by status."""
    rows = [
        [x.status_text, str(x.cases), f"{100 * x.cases / data.n_cases:.1f}"]
        for x in status_records(data)
    ]
    return Rows(["status", "cases", "share [%]"], rows)


def failed_report(data: SweepData) -> Report:
    """The failed cases one by one, and what the failures depend on."""
    failed = failed_cases(data)
    if not len(failed):
        return listed("no failed case")
    names = swept_names(data)
    rows = []
    for record in failed_records(data, failed[:LONGEST_TABLE]):
        time = "" if record["bad_time"] is None else f"{record['bad_time']:.4g}"
        cells = (short_value(record[name]) for name in names)
        rows.append([*_identity(record), record["status_text"], time, *cells])
    heads = ["case", "id", "status", "from [s]", *(label(data, name) for name in names)]
    more = f"and {len(failed) - LONGEST_TABLE} more; all of them: --json, or studies.load"
    is_long = len(failed) > LONGEST_TABLE
    return listed(Rows(heads, rows), more if is_long else "", *_cause_parts(data))


def best_parts(
    data: SweepData, by: str, condition: str, cases: np.ndarray, agreed: str = ""
) -> list[Part]:
    """The best cases, below what they compare with and how well a linear model ranks them."""
    name = by.removeprefix("-")
    ranked = f"{ranking_text(data, by, condition)}:"
    return [uncontrolled_text(data, name), agreed, ranked, *case_parts(data, cases, name)]


def case_parts(data: SweepData, cases: np.ndarray, by: str) -> list[Part]:
    """`case_rows`, and what is to be known of them."""
    return [
        environments_text(data),
        case_rows(data, cases, [by]),
        mark_note(data, cases, by),
        GUESSED if is_there(data, MARGIN) else "",
        *(f"**{warning}**" for warning in ranking_warnings(data, cases, by)),
    ]


def ranking_warnings(data: SweepData, cases: np.ndarray, by: str) -> list[str]:
    """What must be known before acting on the cases that a metric ranks first."""
    texts = margin_warning(data, cases), resolution_warning(data, cases, by)
    return [text for text in (*texts, unranked_text(data, by)) if text]


def uncontrolled_text(data: SweepData, by: str) -> str:
    """The ranking metric of the baseline without control, in a sentence; "" if it is not known."""
    if "status" in data.baseline and is_metric(by):
        code = int(data.baseline["status"].data)
        if code not in status.FINISHED:
            return f"the baseline without control: {reason(code)}"
    value = uncontrolled_value(data, by)
    if value is None:
        return ""
    cases = metric_values(data, by)[data["status"] == status.OK]
    is_beaten = (cases < value * (1 - ROUNDING)).any()
    text = f"{by} of the baseline without control: {quantity(data, by, value)}"
    return text if is_beaten else f"{text}; no case is below it"


def mark_note(data: SweepData, cases: np.ndarray, metric: str) -> str:
    """What `MARK` stands for, "" if no case has it."""
    value = uncontrolled_value(data, metric)
    if value is None or not is_worse(metric_values(data, metric)[cases], value).any():
        return ""
    return f"{MARK}: worse than the baseline without control, {quantity(data, metric, value)}"


def quantity(data: SweepData, metric: str, value: float) -> str:
    """A value of a metric in the unit that reports show."""
    factor, unit = readable(unit_of_metric(data, metric))
    return f"{factor * value:.4g} {unit}".rstrip()


def resolution_warning(data: SweepData, cases: np.ndarray, metric: str) -> str:
    """Warning if deflections of cases are below one step of their ADC, "" if none is."""
    if "adc_step" not in data.baseline or not is_deflection(metric) or not len(cases):
        return ""
    links = tuple(np.flatnonzero(counted_links(data)).tolist())
    step = least_step(metric, data.baseline["adc_step"].data, links) * _step_share(data)[cases]
    what = "design" if has_environments(data) else "case"
    return resolution_text(metric, design_values(data, metric)[cases], step, what)


def _step_share(data: SweepData) -> np.ndarray:
    """One ADC step at the sensor of each case over that of the baseline [1], (n,)."""
    own = data.spec.study.electronics
    bits, full, gain = (
        data.table.values(f"electronics.{name}").astype(float)
        for name in ("adc_bits", "adc_range", "conditioner_gain")
    )
    share = full / own.adc_range * 2.0 ** (own.adc_bits - bits) * own.conditioner_gain / gain
    return np.asarray(share)


def unranked_text(data: SweepData, by: str) -> str:
    """How many cases a ranking leaves out though they are ok, "" if none."""
    is_ok = data["status"] == status.OK
    missing = is_ok & ~np.isfinite(metric_values(data, by))
    if not missing.any():
        return ""
    count = count_text(int(missing.sum()), "case")
    return f"{count} of {is_ok.sum():,} with status ok without {by}: not ranked"


def margin_warning(data: SweepData, cases: np.ndarray) -> str:
    """Warning if cases have a gain margin below `ENOUGH`, "" if none has."""
    margin = design_values(data, MARGIN)[cases] if MARGIN in data.variables else np.array([])
    low = int(np.sum(margin < ENOUGH))
    if not low:
        return ""
    what = "design" if has_environments(data) else "case"
    which = f"this {what} has" if len(cases) == 1 else f"{low} of these {len(cases)} {what}s have"
    return (
        f"CAUTION: {which} a gain margin below {ENOUGH:g} (smallest {np.nanmin(margin):.3g}); such "
        f"loops may go unstable on the machine. Ask for --subject-to '{MARGIN} > {ENOUGH:g}'."
    )


def case_rows(data: SweepData, cases: np.ndarray, metrics: list[str]) -> Rows:
    """Cases with what varies, some metrics, and what else to look at before acting on them."""
    names, metrics = swept_names(data), with_others(data, metrics)
    free = uncontrolled_value(data, metrics[0])
    rows = []
    for record in case_records(data, cases, metrics):
        numbers = [_number_text(data, name, record) for name in metrics]
        if free is not None and is_worse(record[metrics[0]], free):
            numbers[0] += f" {MARK}"
        cells = (short_value(record[name]) for name in names)
        rows.append([*_identity(record), *cells, *numbers])
    how = f"{over_text(data)} " if has_environments(data) else ""
    measured = (f"{how}{label(data, x)}" for x in metrics)
    return Rows(["case", "id", *(label(data, x) for x in names), *measured], rows)


def _identity(record: Record) -> tuple[str, str]:
    """Number of a case, and the start of its id."""
    return str(record["case"]), record["case_id"][:ID_DIGITS]


def _number_text(data: SweepData, name: str, record: Record) -> str:
    """A metric of a case in the unit that it is shown in."""
    value = record[name]
    if name == MARGIN:
        return margin_text(value)
    if name.startswith("settling_time") and "command_end" in data.variables:
        return settling_text(float(value), float(watched(data)[record["case"]]))
    if is_metric(name) and value.dtype.kind == "f":
        value = readable(unit_of_metric(data, name))[0] * value
    return f"{value:.4g}"


def left_out(data: SweepData) -> str:
    """How many cases are not ok and hence left out, "" if none."""
    is_left = data["status"] != status.OK
    return f"left out: {left_out_text(data, is_left)}" if is_left.any() else ""


def left_out_text(data: SweepData, is_left: np.ndarray) -> str:
    """Why cases are left out: how many for which reason."""
    counts = Counter(data["status"][is_left].tolist()).most_common()
    words = (reason(code) if code != status.OK else "without a value" for code, _ in counts)
    return "; ".join(f"{n} {why}" for (_, n), why in zip(counts, words, strict=True))


def label(data: SweepData, name: str) -> str:
    """A name with its displayed unit: a metric's in µm or ms, an axis' as written."""
    unit = unit_of_metric(data, name)
    if is_metric(name):
        return headed(name, unit)
    return f"{name} [{unit}]" if unit else name


def ranking(data: SweepData) -> str:
    """What ranks the cases: the sweep's choice, or the first metric it keeps."""
    sweep = data.spec.sweep
    is_kept = sweep.by.partition("[")[0] in data.variables
    return sweep.by if is_kept else (sweep.metrics or tuple(METRICS))[0]


def counted_text(data: SweepData, by: str) -> str:
    """What a metric's largest value is taken over, in words; "" for what is no metric."""
    metric = by.partition("[")[0]
    if metric not in (*METRICS, *PER_CASE):
        return ""
    if metric not in data.variables:
        return "of no case"
    axes = list(data.variables[metric].dims[1:])
    parts = []
    if "link" in axes and "link=" not in by:
        counted = counted_links(data)
        parts.append(links_text(tuple(np.flatnonzero(counted).tolist()), len(counted)))
    rest = [axis for axis in axes if axis != "link" and f"{axis}=" not in by]
    parts += ["x and y" if axis == "pose_axis" else f"all {axis}s" for axis in rest]
    return f"largest of {' and '.join(parts)}" if parts else "one number"


def is_metric(name: str) -> bool:
    """Whether a name is a metric or an entry of one, and not an axis."""
    return name.partition("[")[0] in METRICS


def shown_metric(data: SweepData, name: str) -> np.ndarray:
    """Values of a metric in the unit it is shown in, or of an axis as written, (n,)."""
    values = metric_values(data, name)
    if values.dtype.kind != "f" or not is_metric(name):
        return values
    return readable(unit_of_metric(data, name))[0] * values


def recommended(data: SweepData, by: str, count: int = 10) -> np.ndarray:
    """The best cases that meet `requirement`; arguments and errors as `best_cases`."""
    return ranked_cases(data, by, requirement(data, by), count)


def requirement(data: SweepData, by: str, is_safe: bool = True) -> str:
    """What a case must meet to be recommended: a gain margin of `ENOUGH`, `sweep.subject_to`.

    Args:
        data: the sweep.
        by: metric or entry of one.
        is_safe: whether the gain margin counts, of which `sweep.subject_to` may say more.

    Returns:
        As much of that, as a condition, as any case with this metric meets; "" for nothing.
    """
    own = data.spec.sweep.subject_to
    is_safe = is_safe and is_there(data, MARGIN) and MARGIN not in own
    conditions = [x for x in (own, f"{MARGIN} >= {ENOUGH:g}" if is_safe else "") if x]
    for condition in dict.fromkeys((" and ".join(map(_bracket, conditions)), *conditions)):
        try:
            ranked_cases(data, by, condition, 1)
            return condition
        except StudyError:
            pass
    return ""


def _bracket(condition: str) -> str:
    return f"({condition})" if " or " in condition else condition


def shown_value(data: SweepData, name: str, case: int) -> str:
    """A value of one case, shortened."""
    return short_value(data[name][case])


def short_value(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return "[" + ", ".join(short_value(entry) for entry in value) + "]"
    if isinstance(value, (float, np.floating)):
        return f"{value:.4g}"
    return str(value)


def unit_of_metric(data: SweepData, name: str) -> str:
    """Unit of a metric or axis, "" if it has none."""
    variable = data.variables.get(name) or data.variables.get(name.split("[")[0])
    if variable is not None and "pose_axis" in variable.dims:
        return "rad" if name.endswith(("[2]", "[pose_axis=3]")) else "m"
    return "" if variable is None or variable.units == "1" else variable.units


def cause_rows(data: SweepData) -> Rows:
    """Which parameters correlate with the failures; no rows if none or all failed."""
    rows = []
    for cause in failure_causes(data)[:8]:
        low, high = (f"{100 * x.share:.0f} % ({x.where})" for x in (cause.low, cause.high))
        rows.append([cause.name, f"{cause.distance:.2f}", f"{cause.p_value:.1g}", low, high])
    return Rows(["parameter", "distance", "p", "failures, lowest quarter", "highest quarter"], rows)
