"""What a screen tells: the best designs, and what the others were like."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

import numpy as np

from jaxmodel import status
from studies.engine.results import ROUNDING
from studies.extensions import options
from studies.publish import publish
from studies.screen.plots import axis_head, described, entry_unit, influence, values
from studies.screen.run import ScreenOutcome, all_failed
from studies.screen.selection import Selection
from studies.screen.shards import CANDIDATES, ScreenRequest, axis_columns
from studies.screen.stored import BEST
from studies.screen.tally import LEFT_OUT, quantile
from studies.show.listing import Rows
from studies.show.pages import write_report
from studies.show.report import Chapter, Drawing, Report, chapter, drawing
from studies.show.units import count_text, headed, readable
from studies.study.margin import margin_text
from studies.study.template import toml_text
from studies.sweeps.show import counted_text, quantity, runs_text, short_value

#: What statuses of a screen do not say.
LATER = (
    " (what saturated or clipped may have an unstable loop: stability is judged later, of the best "
    "that are ok)"
)
#: Why designs did not run.
DROPPED = "left out by sweep.where, or the same as another"
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


def write_screen_report(folder: Path, done: ScreenOutcome) -> None:
    """Write `report.html` and its figures into a screen's folder.

    Raises:
        StudyError: a file cannot be written.
    """
    with publish(folder, stale=("values.png", "influence.png")) as staging:
        write_report(say(done, folder), staging)


def say(done: ScreenOutcome, folder: Path = Path()) -> Report:
    """What a screen tells; folder: its own, in commands."""
    spec, shards = done.screen.spec, count_text(done.screen.n_shards, "shard")
    lost = f"**Of {shards}, {len(done.lost)} left out; retry with `--resume`.**"
    return Report(
        title=f"{spec.study.title or 'untitled study'}: screen",
        result=summary_lines(done),
        question=_question(done.screen),
        next_steps=_next_steps(done, folder),
        top=[lost if done.lost else "", *_drawings(done)],
        chapters=[
            _best(done),
            chapter("What margin costs", margin_rows(done)),
            chapter("How the designs ended", ending_rows(done)),
            chapter("Quantiles", quantile_rows(done)),
        ],
        files={"Sweep file": toml_text(spec.data), "Study of all designs": spec.study},
    )


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


def quantile_rows(done: ScreenOutcome) -> Rows:
    """Quantiles of the metric over all designs that ended well, best first, exact within 1 %."""
    sketch, is_largest = done.tally.sketch[0], done.screen.ranking[1]
    bound = "more" if is_largest else "less"
    rows = []
    for share in SHARES:
        if share * sketch.sum() >= 1:
            value = _value(done, clipped_quantile(done, share))
            rows.append([f"{100 * share:g} %", f"{value} or {bound}"])
    which = "share of the designs that ended well, unstable ones included"
    return Rows([which, f"{done.screen.entry}, exact within 1 %"], rows)


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
        + "; ".join(f"{number} {reason}" for number, _, reason in ending_rows(done).rows)
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
    half = _value(done, clipped_quantile(done, 0.5))
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
            f"the best {done.n_kept:,}{which} by {screen.entry}: {_value(done, best)} to "
            f"{_value(done, last)}; median of those that are ok: {half}"
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
            "nothing is kept"
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


def margin_rows(done: ScreenOutcome) -> Rows:
    """What more margin costs: margins, how many judged candidates have them, and the best one."""
    rows: list[list[str]] = []
    if done.selection is None:
        return Rows([], rows)
    for least in LEAST_MARGINS:
        enough = np.flatnonzero(done.selection.margin >= least)
        if len(enough):
            best = _value(done, done.selection.value[enough[0]])
            rows.append([f"{least:g}", f"{len(enough):,}", best])
    heads = ["gain margin of at least", "candidates judged", f"best {done.screen.entry}"]
    return Rows(heads, rows)


def _uncontrolled_line(done: ScreenOutcome) -> list[str]:
    """How the best compare with no control at all."""
    if done.uncontrolled is None:
        return []
    sign = -1 if done.screen.ranking[1] else 1
    model = done.screen.spec.sweep.fidelity
    text = f"{done.screen.entry} of the baseline without control, by the {model} model: "
    text += _value(done, done.uncontrolled)
    assert done.selection is not None
    kept = done.selection.kept_value
    n_worse = int(np.sum(sign * (done.uncontrolled - kept) <= ROUNDING * abs(done.uncontrolled)))
    if n_worse:
        which = "no design that is kept is" if n_worse == len(kept) else f"{n_worse:,} kept are not"
        text += f"; {which} {'above' if sign < 0 else 'below'} it"
    return [text]


def _question(screen: ScreenRequest) -> str:
    which = "largest" if screen.by.startswith("-") else "best"
    by = " by the linear model" if screen.spec.sweep.fidelity == "linear" else ""
    margin = f", and a gain margin of at least {screen.margin:g}" if screen.margin else ""
    return f"""which of {screen.n_designs:,} designs have the {which} {screen.entry}
    ({counted_text(described(screen), screen.entry)}){by}{margin}? {runs_text(screen.spec.study)}
    Baseline: the study of the sweep file, without the values of the axes."""


def _next_steps(done: ScreenOutcome, folder: Path) -> str:
    command, screen = f"studies {options()}", done.screen
    if done.selection is None:
        return "look for axes along which designs end well."
    if not done.n_kept:
        return "ask for less with `--resume --margin`, or narrow the axes."
    has_all = bool(screen.margin) and not np.isnan(done.selection.margin).any()
    subject = f' --subject-to "gain_margin >= {screen.margin}"' if has_all else ""
    return f"""`{command}sweep {quote(str(folder / BEST))} --out DIR --report` runs the designs that
    were kept by the full model; `{command}best DIR --by '{screen.by}'{subject}` lists the best of
    them; `{command}spillover DIR --case K` asks whether the margin holds on machines that differ
    from the model. If it does not, ask this screen for more with `--resume --margin`: no design
    runs again."""


def _drawings(done: ScreenOutcome) -> list[Drawing]:
    """The figures, if there are values that a log scale has."""
    if not done.tally.sketch[0, 1:].any():
        return []
    drawn = [drawing(values, done)]
    if done.screen.axes.names:
        drawn.append(drawing(influence, done))
    return drawn


def _best(done: ScreenOutcome) -> Chapter | None:
    if done.selection is None:
        return None
    cases = "None of these is kept: they lack the margin."
    if done.n_kept:
        cases = f"""Cases are those of `{BEST}`, a sweep of all {done.n_kept:,} designs that were
        kept, with the same ids."""
    text = f"{cases} Designs are rows of the sweep that was screened. Both count from 0."
    return chapter("The best designs", text, _best_rows(done, done.selection))


def _best_rows(done: ScreenOutcome, selection: Selection) -> Rows:
    """The first cases that are kept; of all candidates, if none is."""
    screen, unit = done.screen, entry_unit(done.screen)
    is_shown = selection.is_kept if done.n_kept else np.ones(len(selection.value), bool)
    shown = np.flatnonzero(is_shown)[:SHOWN]
    table = selection.table.rows(shown)
    columns = axis_columns(table)
    rows = [
        [
            str(case) if done.n_kept else "",
            str(table.row[case]),
            f"{readable(unit)[0] * selection.value[k]:.4g}",
            margin_text(selection.margin[k]),
            *(short_value(columns[name][case]) for name in screen.axes.names),
        ]
        for case, k in enumerate(shown)
    ]
    heads = ["case", "design", headed(screen.entry, unit), "gain margin"]
    return Rows([*heads, *map(axis_head, screen.axes.names)], rows)
