"""The page of a screen, and its summary: the best designs, and what the others were like."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxmodel import status
from studies.engine.results import ROUNDING
from studies.extensions import options
from studies.publish import REPORT, publish
from studies.screen.plots import axis_head, described, entry_unit, influence, values
from studies.screen.run import ScreenOutcome, all_failed
from studies.screen.selection import Selection
from studies.screen.shards import CANDIDATES, ScreenRequest, axis_columns
from studies.screen.stored import BEST
from studies.screen.tally import LEFT_OUT, quantile
from studies.show.figures import styled
from studies.show.pages import old_page as page
from studies.show.units import count_text, headed, readable
from studies.show.words import motion_text
from studies.study.margin import margin_text
from studies.study.template import toml_text
from studies.sweeps.plots import save_plot
from studies.sweeps.show import counted_text

VALUES, INFLUENCE = "values.png", "influence.png"
#: What statuses of a screen do not say.
LATER = (
    " (what saturated or clipped may have an unstable loop: stability is judged later, of the best "
    "that are ok)"
)
#: Shares of the designs whose quantiles are shown.
SHARES = (0.0001, 0.01, 0.1, 0.5, 0.9)
#: Designs in the table.
SHOWN = 20
#: Kept designs count as alike if they differ by less than this share.
ALIKE = 0.02
#: Intervals an axis has at least where its ends are looked at.
LEAST_INTERVALS = 5
#: Gain margins for which the best design is shown [1].
LEAST_MARGINS = (0, 1, 1.5, 2, 3, 4, 6, 10)


def quantity(done: ScreenOutcome, value: float) -> str:
    """A value of the metric with its unit, as people read it."""
    factor, unit = readable(entry_unit(done.screen))
    return f"{factor * value:.4g}" + ("" if unit in ("", "1") else f" {unit}")


def ending_rows(done: ScreenOutcome) -> list[tuple[str, str, str]]:
    """How the designs ended: number, share and reason, most frequent first."""
    endings, rows = done.tally.endings, []
    for code in np.argsort(-endings, kind="stable"):
        if endings[code]:
            reason = (
                "left out by sweep.where, or the same as another"
                if code == LEFT_OUT
                else status.REASONS[code]
            )
            share = f"{100 * endings[code] / done.tally.n_designs:.3g} %"
            rows.append((f"{endings[code]:,}", share, reason))
    return rows


def quantile_rows(done: ScreenOutcome) -> list[tuple[str, str]]:
    """Quantiles of the metric over all designs that ended well, best first, exact within 1 %."""
    sketch, is_largest = done.tally.sketch[0], done.screen.ranking[1]
    bound = "more" if is_largest else "less"
    rows = []
    for share in SHARES:
        if share * sketch.sum() >= 1:
            value = quantity(done, clipped_quantile(done, share))
            rows.append((f"{100 * share:g} %", f"{value} or {bound}"))
    return rows


def clipped_quantile(done: ScreenOutcome, share: float) -> float:
    """A quantile counted from the best, which rounding in the sketch may not exceed."""
    sketch, best = done.tally.sketch[0], float(done.tally.value[0])
    if done.screen.ranking[1]:
        return min(quantile(sketch, 1 - share), best)
    return max(quantile(sketch, share), best)


def summary_lines(done: ScreenOutcome) -> list[str]:
    """What the screen found, in a few lines."""
    tally, screen = done.tally, done.screen
    lines = [
        f"{tally.n_designs:,} designs: "
        + "; ".join(f"{number} {reason}" for number, _, reason in ending_rows(done))
    ]
    if tally.endings[[status.SATURATED, status.CLIPPED]].any():
        lines[0] += LATER
    n_without = int(tally.endings[status.OK] - tally.sketch[0].sum())
    if n_without:
        lines.append(f"{n_without} of those that are ok have no finite {screen.entry}")
    if done.selection is None:
        if n_without:
            return [*lines, "nothing is kept"]
        advice = all_failed(tally)
        return [*lines, "no design ended well; nothing is kept" + (advice and f": {advice}")]
    half = quantity(done, clipped_quantile(done, 0.5))
    half += " or less" if tally.value.min() < 0 else ""  # negative values count as 0
    lines += _selection_lines(done, done.selection, half)
    agreed = [] if done.agreement is None else [done.agreement.text]
    return lines + _edge_lines(done, done.selection) + _uncontrolled_line(done) + agreed


def _selection_lines(done: ScreenOutcome, selection: Selection, half: str) -> list[str]:
    """Which designs are kept, what they are like, and what was passed over for them."""
    screen, margin = done.screen, selection.margin
    lines = []
    if done.n_kept:
        best, last = selection.kept_value[[0, -1]]
        which = f" with a gain margin of at least {screen.margin:g}" if screen.margin else ""
        lines.append(
            f"the best {done.n_kept:,}{which} by {screen.entry}: {quantity(done, best)} to "
            f"{quantity(done, last)}; median of those that are ok: {half}"
        )
        first = margin[selection.is_kept][0]
        what = "no sampled loop" if np.isnan(first) else f"a gain margin of {margin_text(first)}"
        lines.append(f"case 0 of {BEST} has {what}")
        if done.n_kept > 1 and abs(last - best) <= ALIKE * abs(best):
            lines.append(
                f"these differ by less than {100 * ALIKE:g} %: rank them by the full model, or by "
                "another metric"
            )
    passed = f"{count_text(len(margin), 'candidate')} judged, best first: "
    passed += f"{np.sum(margin < 1):,} unstable"
    if screen.margin > 1:
        passed += f", {np.sum((margin >= 1) & (margin < screen.margin)):,} more below that margin"
    if n_without := int(np.sum(np.isnan(margin))):
        passed += f", {n_without:,} without a sampled loop, and so without a margin"
    lines.append(passed)
    if not done.n_kept:
        largest = margin_text(np.nanmax(margin)) if np.isfinite(margin).any() else "none"
        lines.append(
            f"none has a gain margin of at least {screen.margin:g} (largest: {largest}), and "
            "nothing is kept; ask for less with --resume --margin, or narrow the axes"
        )
    if done.n_kept < screen.keep and screen.margin and len(done.tally.row) >= CANDIDATES:
        lines.append(
            f"{done.n_kept:,} of {screen.keep:,} are kept, as a screen judges no more than its "
            f"best {CANDIDATES:,}"
        )
    return lines


def _edge_lines(done: ScreenOutcome, selection: Selection) -> list[str]:
    """Axes at an end of which most of the kept designs are."""
    if not done.n_kept:
        return []
    axes, columns, ends = done.screen.axes, axis_columns(selection.kept), []
    for k, name in enumerate(axes.names):
        last = len(axes.bounds[k])
        if len(axes.labels[k]) or last + 1 < LEAST_INTERVALS:
            continue
        interval = axes.interval(k, columns[name])
        for place, end in ((0, "lower"), (last, "upper")):
            if np.mean(interval == place) > 0.5:
                ends.append(f"the {end} end of {name}")
    return [f"most of these are at {' and '.join(ends)}: widen it if you can"] if ends else []


def margin_rows(done: ScreenOutcome) -> list[tuple[str, str, str]]:
    """What more margin costs: margins, how many judged candidates have them, and the best one."""
    if done.selection is None:
        return []
    margin, value, rows = done.selection.margin, done.selection.value, []
    for least in LEAST_MARGINS:
        enough = np.flatnonzero(margin >= least)
        if len(enough):
            rows.append((f"{least:g}", f"{len(enough):,}", quantity(done, value[enough[0]])))
    return rows


def _uncontrolled_line(done: ScreenOutcome) -> list[str]:
    """How the best compare with no control at all."""
    if done.uncontrolled is None:
        return []
    sign = -1 if done.screen.ranking[1] else 1
    model = done.screen.spec.sweep.fidelity
    text = f"{done.screen.entry} of the baseline without control, by the {model} model: "
    text += quantity(done, done.uncontrolled)
    assert done.selection is not None
    kept = done.selection.kept_value
    n_worse = int(np.sum(sign * (done.uncontrolled - kept) <= ROUNDING * abs(done.uncontrolled)))
    if n_worse:
        which = "no design that is kept is" if n_worse == len(kept) else f"{n_worse:,} kept are not"
        text += f"; {which} {'above' if sign < 0 else 'below'} it"
    return [text]


def write_screen_report(folder: Path, done: ScreenOutcome) -> None:
    """Write `report.html` and its figures into a screen's folder.

    Raises:
        StudyError: a file cannot be written.
    """
    screen, tally = done.screen, done.tally
    drawings: dict[str, Callable[[ScreenOutcome], Figure]] = {}
    if tally.sketch[0, 1:].any():  # what is drawn on a log scale
        drawings[VALUES] = values
        if screen.axes.names:
            drawings[INFLUENCE] = influence
    rows = [] if done.selection is None else _best_rows(done)
    with publish(folder, stale=(VALUES, INFLUENCE)) as staging:
        with styled():
            for name, draw in drawings.items():
                save_plot(draw(done), staging / name)
        text = page(
            "screen/report.html",
            staging,
            {"Sweep file": toml_text(screen.spec.data), "Study of all designs": screen.spec.study},
            title=screen.spec.study.title,
            command=f"studies {options()}",
            path=quote(str(folder / BEST)),
            best=BEST,
            screen=screen,
            summary=[line[0].upper() + line[1:] for line in summary_lines(done)],
            drawn=list(drawings),
            endings=ending_rows(done),
            quantiles=quantile_rows(done),
            heads=_heads(screen),
            rows=rows,
            n_kept=done.n_kept,
            condition=_condition(done),
            margins=margin_rows(done),
            motion=motion_text(screen.spec.study),
            window=screen.spec.study.metrics,
            counted=counted_text(described(screen), screen.entry),
            is_compared=done.uncontrolled is not None,
            lost=done.lost,
        )
        (staging / REPORT).write_text(text, encoding="utf-8")


def _condition(done: ScreenOutcome) -> str:
    """What `studies best` asks of designs like these, "" for nothing."""
    if not done.screen.margin or done.selection is None or np.isnan(done.selection.margin).any():
        return ""
    return f"gain_margin >= {done.screen.margin}"


def _heads(screen: ScreenRequest) -> tuple[str, ...]:
    names = (axis_head(name) for name in screen.axes.names)
    return ("case", "design", headed(screen.entry, entry_unit(screen)), "gain margin", *names)


def _best_rows(done: ScreenOutcome) -> list[tuple[str, ...]]:
    """The first cases that are kept; of all candidates, if none is."""
    selection = done.selection
    assert selection is not None
    factor = readable(entry_unit(done.screen))[0]
    is_shown = selection.is_kept if done.n_kept else np.ones(len(selection.value), bool)
    shown = np.flatnonzero(is_shown)[:SHOWN]
    table = selection.table.rows(shown)
    columns = axis_columns(table)
    return [
        (
            str(case) if done.n_kept else "",
            str(table.row[case]),
            f"{factor * selection.value[k]:.4g}",
            margin_text(selection.margin[k]),
            *(_shown(columns[name][case]) for name in done.screen.axes.names),
        )
        for case, k in enumerate(shown)
    ]


def _shown(value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{value:.4g}"
