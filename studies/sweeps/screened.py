"""What a sweep that keeps its best designs tells of all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxmodel import status
from studies.engine.fidelity import alike
from studies.engine.results import SweepData, metric_values, uncontrolled_value
from studies.screen.run import ScreenOutcome, chosen
from studies.screen.shards import ScreenRequest, axis_columns
from studies.screen.tally import LEFT_OUT, quantile
from studies.show.listing import Rows
from studies.show.report import Drawing, Report, chapter, drawing
from studies.show.units import count_text
from studies.space.spec import CANDIDATES
from studies.study.template import toml_text
from studies.sweeps.screened_plots import described, influence, values
from studies.sweeps.show import counted_text, quantity, runs_text

#: What statuses of a screen do not say.
LATER = (
    " (what saturated or clipped may have an unstable loop: stability is judged later, of the best "
    "that are ok)"
)
#: Why designs did not run.
DROPPED = "left out by sweep.where, or the same as another"
#: Intervals an axis has at least where its ends are looked at.
LEAST_INTERVALS = 5
#: Gain margins for which the best design is shown [1].
LEAST_MARGINS = (0, 1, 1.5, 2, 3, 4, 6, 10)


def with_screen(report: Report, done: ScreenOutcome, data: SweepData) -> Report:
    """The report of the designs that are kept, with how they were found among all.

    Args:
        report: of a sweep of them.
        done: how the screen of all designs ended.
        data: of the designs that are kept, in their order, and perhaps of more.
    """
    shards = count_text(done.screen.n_shards, "shard")
    lost = f"**Of {shards}, {len(done.lost)} left out; retry with `--resume`.**"
    return replace(
        report,
        result=[*report.result, *screen_lines(done), *_compared(done, data)],
        question=_question(done.screen),
        top=[lost if done.lost else "", *report.top, *_drawings(done, data)],
        chapters=[
            *report.chapters,
            chapter("What margin costs", margin_rows(done)),
            chapter("How the designs ended", ending_rows(done)),
        ],
        files={**report.files, "Sweep file": toml_text(done.screen.spec.data)},
    )


def _compared(done: ScreenOutcome, data: SweepData) -> list[str]:
    """How alike both models rank random designs and those that are kept, if both ran."""
    if done.agreement is None:
        return []
    entry, found = done.screen.entry, chosen(done).kept_value
    value = np.where(data["status"] == status.OK, metric_values(data, entry), np.nan)
    kept = alike(done.screen.spec.sweep.by, found, value[: len(found)])
    return [done.agreement.text, kept.told("kept")]


def _value(done: ScreenOutcome, value: float) -> str:
    """A value of the metric with its unit, as people read it."""
    return quantity(described(done.screen), done.screen.entry, value)


def ending_rows(done: ScreenOutcome) -> Rows:
    """How the designs ended: number, share and reason, most frequent first."""
    endings, reasons = done.tally.endings, {**status.REASONS, LEFT_OUT: DROPPED}
    rows = [
        [f"{endings[k]:,}", f"{100 * endings[k] / done.tally.n_designs:.3g} %", reasons[int(k)]]
        for k in np.argsort(-endings, kind="stable")
        if endings[k]
    ]
    return Rows(["designs", "share", "ending"], rows)


def screen_lines(done: ScreenOutcome) -> list[str]:
    """How all designs ended and which are kept, in a few lines."""
    tally, screen, selection = done.tally, done.screen, chosen(done)
    margin, keep, least = selection.margin, screen.spec.sweep.keep, screen.spec.sweep.margin
    lines = [
        f"{tally.n_designs:,} designs: "
        + "; ".join(f"{number} {reason}" for number, _, reason in ending_rows(done).rows)
    ]
    if tally.endings[[status.SATURATED, status.CLIPPED]].any():
        lines[0] += LATER
    if n_without := int(tally.endings[status.OK] - tally.sketch[0].sum()):
        lines.append(f"{n_without} of those that are ok have no finite {screen.entry}")
    best, last, half = selection.kept_value[0], selection.kept_value[-1], _median(done)
    which = f" with a gain margin of at least {least:g}" if least else ""
    lines.append(
        f"the best {done.n_kept:,}{which} by {screen.entry} of the {screen.spec.sweep.fidelity} "
        f"model: {_value(done, best)} to {_value(done, last)}; median of those that are ok: {half}"
    )
    passed = f"{count_text(len(margin), 'candidate')} judged, best first: "
    passed += f"{np.sum(margin < 1):,} unstable"
    if least > 1:
        passed += f", {np.sum((margin >= 1) & (margin < least)):,} more below that margin"
    if n_without := int(np.sum(np.isnan(margin))):
        passed += f", {n_without:,} without a sampled loop, and so without a margin"
    lines.append(passed)
    if done.n_kept < keep and least and len(tally.row) >= CANDIDATES:
        lines.append(
            f"{done.n_kept:,} of {keep:,} are kept, as no more than the best {CANDIDATES:,} are "
            "judged"
        )
    return lines + _edge_lines(done)


def _median(done: ScreenOutcome) -> str:
    """Of the designs that are ok, whose best one rounding in the sketch may not exceed."""
    half, best = quantile(done.tally.sketch[0], 0.5), float(done.tally.value[0])
    text = _value(done, min(half, best) if done.screen.ranking[1] else max(half, best))
    return text + (" or less" if done.tally.value.min() < 0 else "")  # negative values count as 0


def _edge_lines(done: ScreenOutcome) -> list[str]:
    """Axes at an end of which most of the kept designs are."""
    axes, columns, ends = done.screen.axes, axis_columns(chosen(done).kept), []
    for k, name in enumerate(axes.names):
        last = len(axes.bounds[k])
        if len(axes.labels[k]) or last + 1 < LEAST_INTERVALS:
            continue
        interval = axes.interval(k, columns[name])
        for place, end in ((0, "lower"), (last, "upper")):
            if np.mean(interval == place) > 0.5:
                ends.append(f"the {end} end of {name}")
    return [f"most of these are at {' and '.join(ends)}: widen it if you can"] if ends else []


def margin_rows(done: ScreenOutcome) -> Rows:
    """What more margin costs: margins, how many judged candidates have them, and the best one."""
    rows, selection = [], chosen(done)
    for least in LEAST_MARGINS:
        enough = np.flatnonzero(selection.margin >= least)
        if len(enough):
            best = _value(done, selection.value[enough[0]])
            rows.append([f"{least:g}", f"{len(enough):,}", best])
    heads = ["gain margin of at least", "candidates judged", f"best {done.screen.entry}"]
    return Rows(heads, rows)


def _question(screen: ScreenRequest) -> str:
    sweep = screen.spec.sweep
    which = "largest" if sweep.by.startswith("-") else "best"
    by = f"by the {sweep.fidelity} model"
    by += f", and a gain margin of at least {sweep.margin:g}" if sweep.margin else ""
    by += f"; do {sweep.keep:,} of them meet {sweep.subject_to}" if sweep.subject_to else ""
    counted = counted_text(described(screen), screen.entry)
    return f"""which of {screen.n_designs:,} designs have the {which} {screen.entry} ({counted})
    {by}? {runs_text(screen.spec.study)} Baseline: the study of the sweep file,
    without the values of the axes."""


def _drawings(done: ScreenOutcome, data: SweepData) -> list[Drawing]:
    """The figures, if there are values that a log scale has."""
    if not done.tally.sketch[0, 1:].any():
        return []
    drawn = [drawing(values, done, uncontrolled_value(data, done.screen.entry))]
    if done.screen.axes.names:
        drawn.append(drawing(influence, done))
    return drawn
