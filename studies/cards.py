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
from studies.study.labels import describe
from studies.study.margin import margin_in_db, stretch_text

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
        result: of a type in CARDS.
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


def _run(run: Any) -> Card:
    """Of `run_study`."""
    from studies.engine.run_data import chord_deflection
    from studies.single.summary import limits_text, link_rows

    loop = run.loop
    lines = [f"Status: {describe(run.status)}.", limits_text(run)]
    if loop is not None:
        lines += [f"Gain margin {margin_in_db(loop.gain_margin)}.", stretch_text(loop.by_stretch)]
    figure = None
    if run.result.record is not None:
        figure, ax = figures.one_panel(2.2)
        names = [f"link {i + 1}" for i in range(run.study.n_links)]
        bent, time = 1e6 * chord_deflection(run), 1e3 * run.result.record.time
        figures.traces(time, bent, names, "mid-span deflection [µm]", ax)
        ax.axvline(1e3 * float(run.result.command_end), color="#888888", linestyle=":")
        ax.set_xlabel("time [ms]")
        figures.legend_above(figure, ax)
    table = link_rows(run)
    return Card(run.study.title, [x for x in lines if x], table.heads, table.rows, figure=figure)


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


def _laws(findings: Any) -> Card:
    """Of `run_laws`."""
    from studies.laws.findings import verdict
    from studies.laws.plots import comparison
    from studies.laws.report import HEADS, table_rows

    rows = table_rows(findings)[:MOST]
    return Card(findings.study.title, verdict(findings), HEADS, rows, figure=comparison(findings))


def _export(export: Any) -> Card:
    """Of `export_design`."""
    from studies.show.sketch import sketch

    checks = [] if export.verified is None else export.verified.checks
    rows = [[x.what, x.found, x.allowed, "ok" if x.is_met else "FAILED"] for x in checks]
    verdict = "FAILED, not written" if export.has_failed else "verified"
    lines = [
        f"{export.target}: {verdict if checks else 'not verified'}",
        f"Files: {', '.join(map(str, export.files))}",
    ]
    study = export.controller.study
    return Card(
        study.title, lines, ["compared", "found", "allowed", ""], rows, figure=sketch(study)
    )


def _modes(modes: Any) -> Card:
    """Of `machine_modes`."""
    shown = slice(0, 2 * MOST)
    table = zip(modes.frequency[shown], modes.damping_ratio[shown], modes.names, strict=False)
    rows = [[f"{f:.2f}", f"{z:.4f}", name] for f, z, name in table]
    figure, ax = figures.one_panel(2.0)
    parts = [*modes.link_share.sum(axis=2).T[:, shown], modes.drive_share[shown]]
    place, base = np.arange(len(rows)), np.zeros(len(rows))
    for part, color, label in zip(
        parts, figures.SERIES, ("link 1", "link 2", "link 3", "drive"), strict=False
    ):
        ax.bar(place, 100 * part, bottom=base, color=color, label=label)
        base = base + 100 * np.nan_to_num(part)
    ax.set_xticks(place, [f"{f:.0f}" for f in modes.frequency[shown]])
    ax.set(xlabel="frequency [Hz]", ylabel="energy [%]")
    figures.legend_above(figure, ax)
    heads = ["frequency [Hz]", "damping ratio [1]", "what moves"]
    return Card("Natural modes of the machine", [], heads, rows, figure=figure)


#: Module with the function `say`, by the name of the type.
SAY = {
    "Certificate": "studies.spillover.say",
    "Fitted": "studies.fitting.say",
    "TuneFindings": "studies.tuning.say",
}
#: By the name of the type.
CARDS: dict[str, Callable[[Any], Card]] = {
    "Run": _run,
    "Outcome": _sweep,
    "LawFindings": _laws,
    "Exported": _export,
    "NamedModes": _modes,
}
