"""The page of a screen, and its summary: the best designs, and what the others were like."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.results import ROUNDING
from studies.extensions import options
from studies.publish import REPORT, publish
from studies.screen.plots import influence, values
from studies.screen.run import ScreenOutcome
from studies.screen.shards import axis_columns
from studies.screen.stored import BEST
from studies.screen.tally import LEFT_OUT, quantile
from studies.show.figures import styled
from studies.show.pages import page
from studies.show.units import headed, readable
from studies.study.margin import ENOUGH, margin_text
from studies.study.template import toml_text
from studies.sweeps.plots import save_plot

VALUES, INFLUENCE = "values.png", "influence.png"
#: Shares of the designs whose quantiles are shown.
SHARES = (0.0001, 0.01, 0.1, 0.5, 0.9)
#: Designs in the table.
SHOWN = 20


def unit_of(done: ScreenOutcome) -> str:
    """Unit of what the designs are ranked by."""
    return METRICS[done.screen.metric].unit


def quantity(done: ScreenOutcome, value: float) -> str:
    """A value of the metric with its unit, as people read it."""
    factor, unit = readable(unit_of(done))
    return f"{factor * value:.4g}" + ("" if unit in ("", "1") else f" {unit}")


def ending_rows(done: ScreenOutcome) -> list[tuple[str, str, str]]:
    """How the designs ended: number, share and reason, most frequent first."""
    endings, rows = done.tally.endings, []
    for code in np.argsort(-endings, kind="stable"):
        if endings[code]:
            reason = "left out by where, or twice" if code == LEFT_OUT else status.REASONS[code]
            share = f"{100 * endings[code] / done.tally.n_designs:.3g} %"
            rows.append((f"{endings[code]:,}", share, reason))
    return rows


def quantile_rows(done: ScreenOutcome) -> list[tuple[str, str]]:
    """Quantiles of the metric over all designs that ended well, best first, exact within 1 %."""
    sketch, is_largest = done.tally.sketch[0], done.screen.ranking[1]
    bound = "more" if is_largest else "less"
    return [
        (
            f"{100 * share:g} %",
            f"{quantity(done, quantile(sketch, 1 - share if is_largest else share))} or {bound}",
        )
        for share in SHARES
        if share * sketch.sum() >= 1
    ]


def summary_lines(done: ScreenOutcome) -> list[str]:
    """What the screen found, in a few lines."""
    tally, screen = done.tally, done.screen
    lines = [
        f"{tally.n_designs:,} designs: "
        + "; ".join(f"{number} {reason}" for number, _, reason in ending_rows(done))
    ]
    n_without = int(tally.endings[status.OK] - tally.sketch[0].sum())
    if n_without:
        lines.append(f"{n_without} of those that are ok have no finite {screen.entry}")
    if not len(tally.row):
        return [*lines, "nothing is kept" if n_without else "no design ended well; nothing is kept"]
    best, last = (quantity(done, tally.value[k]) for k in (0, -1))
    half = quantity(done, quantile(tally.sketch[0], 0.5))
    half += " or less" if tally.value.min() < 0 else ""  # negative values count as 0
    lines.append(
        f"the best {len(tally.row)} by {screen.entry}: {best} to {last}; "
        f"median of those that are ok: {half}"
    )
    lines += _uncontrolled_line(done)
    margin = done.margin[~np.isnan(done.margin)]
    if not margin.size:
        return lines
    unstable, safe = np.sum(margin < 1), np.sum(margin > ENOUGH)
    lines.append(
        f"of the best {margin.size}, {unstable} are unstable and {safe} have a gain margin above "
        f"{ENOUGH:g}"
    )
    if safe:
        case = int(np.argmax(done.margin[done.place] > ENOUGH))
        first = done.place[case]
        value, text = quantity(done, tally.value[first]), margin_text(done.margin[first])
        lines.append(f"the best of these: case {case} of {BEST} with {value}, margin {text}")
    return lines


def _uncontrolled_line(done: ScreenOutcome) -> list[str]:
    """How the best compare with no control at all."""
    if done.uncontrolled is None:
        return []
    sign = -1 if done.screen.ranking[1] else 1
    lead = sign * (done.uncontrolled - done.tally.value[0])
    text = f"{done.screen.entry} of the baseline without control: "
    text += quantity(done, done.uncontrolled)
    if lead <= ROUNDING * abs(done.uncontrolled):
        text += f"; no design is {'above' if sign < 0 else 'below'} it"
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
    rows = _best_rows(done) if len(tally.row) else []
    with publish(folder, stale=(VALUES, INFLUENCE)) as staging:
        with styled():
            for name, draw in drawings.items():
                save_plot(draw(done), staging / name)
        text = page(
            "screen/report.html",
            staging,
            {"Sweep file": toml_text(screen.spec.data)},
            about=screen.spec.study,
            title=screen.spec.study.title,
            command=f"studies {options()}",
            path=quote(str(folder / BEST)),
            best=BEST,
            screen=screen,
            summary=[line[0].upper() + line[1:] for line in summary_lines(done)],
            drawn=list(drawings),
            endings=ending_rows(done),
            quantiles=quantile_rows(done),
            heads=(
                "case",
                "design",
                headed(screen.entry, unit_of(done)),
                "gain margin",
                *screen.axes.names,
            ),
            rows=rows,
            is_robust=bool(np.any(done.margin > ENOUGH)),
            enough=ENOUGH,
            is_compared=done.uncontrolled is not None,
            lost=done.lost,
        )
        (staging / REPORT).write_text(text, encoding="utf-8")


def _best_rows(done: ScreenOutcome) -> list[tuple[str, ...]]:
    """Of the best designs, those with margin enough; of all, if there are none."""
    assert done.kept is not None
    factor, place = readable(unit_of(done))[0], done.place
    robust = np.flatnonzero(done.margin[place] > ENOUGH)
    cases = (robust if len(robust) else np.arange(len(place)))[:SHOWN]
    table = done.kept.rows(cases)
    columns = axis_columns(table)
    return [
        (
            str(case),
            str(table.row[k]),
            f"{factor * done.tally.value[place[case]]:.4g}",
            margin_text(done.margin[place[case]]),
            *(_shown(columns[name][k]) for name in done.screen.axes.names),
        )
        for k, case in enumerate(cases)
    ]


def _shown(value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{value:.4g}"
