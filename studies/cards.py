"""Results as notebooks show them: a title, a short table with units and one small picture.

What functions of `studies` return calls `card` from its `_repr_html_` (`studies.publish.shown`).
Rows, words and pictures are those of the reports.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from studies.show import figures, pages
from studies.show.pages import inline_image, render
from studies.show.units import count_text

#: Rows of a table, and width [inch] and resolution [1/inch] of a picture.
MOST, WIDTH, DPI = 6, 5.6, 90


class Card(NamedTuple):
    """What a notebook shows of a result; lines: sentences above the table."""

    title: str
    lines: Sequence[str]
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    figure: Figure | None = None


def card(result: Any) -> str:
    """A result as HTML, whose texts are shown as they are.

    Args:
        result: of a type in SAY or CARDS.
    """
    if (module := SAY.get(type(result).__name__)) is not None:
        return pages.card(import_module(module).say(result))
    with figures.styled():
        made = CARDS[type(result).__name__](result)
        image = inline_image(_png(made.figure), made.title) if made.figure is not None else ""
    parts = made._asdict() | {"title": made.title or "untitled", "image": image}
    return render("show/old_card.html", **parts)


def _png(figure: Figure) -> bytes:
    figure.set_figwidth(min(WIDTH, figure.get_figwidth()))
    image = BytesIO()
    figure.savefig(image, format="png", dpi=DPI)
    return image.getvalue()


def _sweep(outcome: Any) -> Card:
    """Of `run_sweep`."""
    from studies.engine.results import read_sweep
    from studies.errors import StudyError
    from studies.sweeps.plots import plot
    from studies.sweeps.show import case_rows, ranked_cases, ranking, status_rows

    data, figure = read_sweep(outcome.out), None
    listing, metric = status_rows(data), ranking(data)
    lines = [
        f"{outcome.n_done} of {count_text(len(outcome.table), 'case')} done, "
        f"{outcome.n_run} of them now, in {outcome.run_time:.3g} s."
    ]
    try:
        best = ranked_cases(data, metric, count=MOST)
        figure = plot(data, None, metric)
    except StudyError:  # no case is ok, or there is nothing to draw over
        best = np.array([], int)
    if len(best):
        lines.append(f"Best by {metric}:")
        listing = case_rows(data, best, [metric])
    return Card(data.spec.study.title, lines, listing.heads, listing.rows, figure=figure)


def _tuning(found: Any) -> Card:
    """Of `run_tuning`."""
    from studies.tuning.plots import descent
    from studies.tuning.report import file_name, summary

    spec, at = found.spec, found.at
    values = spec.free.values(at.best_place)
    winners = [at.winner(k) for k in range(len(spec.moving))]
    rows = [
        [name, *(f"{values[k][j]:.4g}" for k in winners)]
        for j, name in enumerate(spec.free.names[:MOST])
    ]
    files = [f"{family.name} ({file_name(spec, family)})" for family in spec.moving]
    return Card(
        spec.study.title,
        summary(spec, found),
        ["number", *files],
        rows,
        figure=descent(spec, found),
    )


def _fit(fitted: Any) -> Card:
    """Of `fit` and `run_fit`."""
    from studies.fitting.plots import drawings
    from studies.fitting.report import statements, value_rows

    heads = ["parameter", "value", "sigma", "unit", "95 %", ""]
    drawing = next(iter(drawings(fitted).values()), lambda: None)
    rows = value_rows(fitted)
    return Card(fitted.study.title, statements(fitted), heads, rows, figure=drawing())


def _laws(findings: Any) -> Card:
    """Of `run_laws`."""
    from studies.laws.findings import verdict
    from studies.laws.plots import comparison
    from studies.laws.report import HEADS, table_rows

    rows = table_rows(findings)[:MOST]
    return Card(findings.study.title, verdict(findings), HEADS, rows, figure=comparison(findings))


#: Module with the function `say`, by the name of the type.
SAY = {
    "Certificate": "studies.spillover.say",
    "ComparedVariants": "studies.export.comparison",
    "Exported": "studies.export.say",
    "NamedModes": "studies.single.modes",
    "Run": "studies.single.say",
}
#: By the name of the type.
CARDS: dict[str, Callable[[Any], Card]] = {
    "Outcome": _sweep,
    "TuneFindings": _tuning,
    "Fitted": _fit,
    "LawFindings": _laws,
}
