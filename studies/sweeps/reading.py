"""The commands that read a sweep, as verbs: show, best, plot, sensitivity."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from studies.config import start
from studies.errors import StudyError
from studies.result import Result
from studies.verbs import check_file, verb

if TYPE_CHECKING:
    from studies.engine.results import SweepData
    from studies.results.labelled import Labelled
    from studies.show.report import Report

#: Replaced in names of files: the brackets of entries.
_NO_NAME = r"[^\w.-]+"


class Reading(Result):
    """What a command says of a sweep: tells and makes its report and its document, if asked."""

    def __init__(self, tells: Callable[[], Report], makes: Callable[[], Labelled]) -> None:
        self._tells, self._makes = tells, makes

    def report(self) -> Report:
        return self._tells()

    def document(self) -> Labelled:
        return self._makes()


def _read(what: str | Path) -> SweepData:
    """A sweep; says what of its folder is not shown."""
    from studies.engine.results import read_sweep

    data = read_sweep(what)
    for note in data.notes:
        print(f"studies: {note}", file=sys.stderr)
    return data


@verb
def show(what: str | Path, *, failed: bool = False) -> Reading:
    """Show statuses and best cases of a sweep, or its failed cases.

    Args:
        what: folder of a sweep.
        failed: list failed cases.
    """
    from studies.sweeps import show as told
    from studies.sweeps.documents import show_document

    data = _read(what)
    report = told.failed_report if failed else told.overview
    return Reading(lambda: report(data), lambda: show_document(data, failed))


@verb
def best(
    what: str | Path,
    *,
    by: str,
    subject_to: str = "",
    count: int = 10,
    breaks: bool = False,
    tolerance: Mapping[str, float] | None = None,
) -> Reading:
    """List the best cases of a sweep by a metric.

    Args:
        what: folder of a sweep.
        by: metric; the best come first, after - the worst.
        subject_to: condition on metrics and axes.
        count: number of cases.
        breaks: also name the smallest change that breaks each of them.
        tolerance: NAME=VALUE, of --breaks, as in `studies certify`.
    """
    if tolerance and not breaks:
        raise StudyError("--tolerance: for --breaks only; give both")
    if breaks:
        start()
    from studies.sweeps.documents import best_document
    from studies.sweeps.show import best_report, ranked_cases

    data, agreed = _read(what), ""
    if data.spec.sweep.fidelity == "linear":
        start()
        from studies.engine.fidelity import agreement

        if found := agreement(data.spec, data.table, by):
            found.check('Rank by another metric, or run the sweep with fidelity = "full".')
            agreed = found.text
    cases, changes = ranked_cases(data, by, subject_to, count), None
    if breaks:
        from studies.sweeps.breaking import breaking_changes

        changes = list(breaking_changes(Path(what), cases.tolist(), tolerance or {}))
    told = [f"case {one.case}: {one.text}" for one in changes or ()]
    return Reading(
        lambda: best_report(data, by, subject_to, cases, agreed, told),
        lambda: best_document(data, by, cases, subject_to).replace(smallest_changes=changes),
    )


@verb
def plot(
    what: str | Path,
    out: str | Path | None = None,
    *,
    y: str = "",
    x: str | None = None,
    hue: str | None = None,
) -> Reading:
    """Plot a sweep; the axes determine the kind of figure.

    Args:
        what: folder of a sweep.
        out: PNG, PDF or SVG; default: in the folder.
        y: metric or axis; default: the ranking metric.
        x: axis or metric; default: all axes.
        hue: axis or metric for the colour.
    """
    from studies.result import Summary
    from studies.show.report import listed
    from studies.sweeps.plots import FORMATS, save_plot
    from studies.sweeps.plots import plot as draw
    from studies.sweeps.show import left_out, ranking

    check_file(out, *FORMATS)
    data = _read(what)
    y = y or ranking(data)
    parts = (("", y), ("-over-", x), ("-by-", hue))
    name = "".join(f"{word}{part}" for word, part in parts if part)
    path = Path(out or Path(what) / f"{re.sub(_NO_NAME, '_', name).strip('_')}.png")
    save_plot(draw(data, x, y, hue), path)
    said = f"written: {path}"
    return Reading(lambda: listed(left_out(data), said), lambda: Summary(name, [], True, [said]))


@verb
def sensitivity(what: str | Path, *, by: str = "residual_rms") -> Reading:
    """Show which parameters matter, from a sweep with method morris or saltelli.

    Args:
        what: folder of a sweep.
        by: metric.
    """
    from studies.sweeps.documents import sensitivity_document
    from studies.sweeps.sensitivity import analyse
    from studies.sweeps.show import sensitivity_report

    data = _read(what)
    analysis = analyse(data, by)
    return Reading(
        lambda: sensitivity_report(data, by, analysis),
        lambda: sensitivity_document(data, by, analysis),
    )
