"""The report of a sweep: what varied, how cases ended, the best ones, what failed and why."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxmodel import status
from studies.engine.fidelity import agreement
from studies.engine.results import (
    SweepData,
    as_sweep,
    counted_links,
    direction,
    metric_values,
    swept_names,
)
from studies.errors import StudyError, shown
from studies.publish import REPORT, publish
from studies.show.figures import styled
from studies.show.pages import old_page as page
from studies.show.sketch import CAPTION, sketch
from studies.show.units import readable
from studies.show.words import motion_text
from studies.space.axes import SHOWN_AS
from studies.space.methods import METHODS
from studies.space.spec import Block
from studies.space.table import case_study
from studies.study.spec import Study
from studies.study.template import toml_text, toml_value
from studies.sweeps.dry_run import axis_rows
from studies.sweeps.plots import front, plot, save_plot
from studies.sweeps.records import MARGIN
from studies.sweeps.screening import check_screen, draw_screen
from studies.sweeps.show import (
    SHARES,
    case_rows,
    cause_rows,
    counted_text,
    is_ranked,
    margin_warning,
    mark_note,
    ranked_cases,
    ranking,
    recommended,
    requirement,
    resolution_warning,
    shown_metric,
    shown_value,
    status_rows,
    uncontrolled_text,
    unit_of_metric,
)

FIGURE, FRONT, SCREEN, MACHINE = "cases.png", "front.png", "screen.png", "machine.png"
#: Other metrics to check.
OTHERS = ("settling_time", "peak_voltage")
#: The best cases count as equal if they differ by less than this share.
ALIKE = 0.02


def write_sweep_report(folder: str | Path) -> None:
    """Write `report.html` of a sweep, with its figures, into its folder.

    Args:
        folder: of a finished sweep.

    Raises:
        StudyError: no sweep there, or a file cannot be written.
    """
    folder = Path(folder)
    data = as_sweep(folder)
    metric = ranking(data)
    drawn = [MACHINE]
    drawings: dict[str, Callable[[], Figure]] = {
        FIGURE: lambda: plot(data, None, metric, None),
        FRONT: lambda: _front(data, metric),
        SCREEN: lambda: draw_screen(data),
    }
    with publish(folder, stale=drawings) as staging:
        for name, draw in drawings.items():
            try:
                figure = draw()
            except StudyError:  # no case is ok, or nothing to draw over
                continue
            save_plot(figure, staging / name)
            drawn.append(name)
        with styled():
            save_plot(sketch(_best_study(data, metric)), staging / MACHINE)
        text = report(data, metric, drawn, str(folder), staging)
        (staging / REPORT).write_text(text, encoding="utf-8")


def _front(data: SweepData, metric: str) -> Figure:
    fine = _margins(data)[(data["status"] == status.OK) & np.isfinite(metric_values(data, metric))]
    if len(fine) < 3 or not np.isfinite(fine).all() or np.ptp(fine) <= 0:
        raise StudyError("too few gain margins to draw over")
    return front(data, metric)


def _margins(data: SweepData) -> np.ndarray:
    """Gain margins, nan if unknown, (n,)."""
    return data[MARGIN] if MARGIN in data.variables else np.full(data.n_cases, np.nan)


def _best_study(data: SweepData, metric: str) -> Study:
    """Study of the best case; of the sweep itself if no case is ok."""
    try:
        return case_study(data.table, int(recommended(data, metric, 1)[0]))
    except StudyError:
        return data.spec.study


def report(
    data: SweepData,
    metric: str,
    drawn: list[str],
    folder: str = "DIR",
    images: Path | None = None,
) -> str:
    """The page of a sweep.

    Args:
        data: the sweep.
        metric: ranks the cases.
        drawn: existing figures among `FIGURE`, `FRONT`, `SCREEN` and `MACHINE`.
        folder: of the sweep, for commands.
        images: folder with the figures; None: a page without.
    """
    endings = status_rows(data)
    spec = data.spec
    return page(
        "sweeps/report.html",
        images,
        {"Sweep file": toml_text(spec.data), "Study of all cases": spec.study},
        title=spec.study.title,
        folder=folder,
        first=direction(metric),
        motion=motion_text(spec.study),
        window=spec.study.metrics,
        sweep=spec.sweep,
        cases=data.table,
        metric=metric,
        others=[x for x in OTHERS if x in data.variables and x != metric.partition("[")[0]],
        counted=counted_text(data, metric),
        axes=swept_names(data),
        n_ok=int(np.sum(data["status"] == status.OK)),
        failures=[f"{count}: {name}" for name, count, _ in endings.rows if name != "ok"][:3],
        endings=endings,
        best=_best(data, metric),
        uncontrolled=uncontrolled_text(data, metric),
        screen=check_screen(data),
        agreed=agreement(spec, data.table, metric) if spec.sweep.fidelity == "linear" else None,
        root=spec.root,
        method_text=_method_text,
        shown_as=SHOWN_AS,
        axis_values=_values,
        columns=axis_rows(data.table),
        causes=cause_rows(data),
        shares=SHARES,
        sketch_caption=CAPTION,
        drawn=drawn,
    )


def _best(data: SweepData, metric: str) -> dict[str, Any] | None:
    """The best cases; None if no case of status ok has the metric."""
    if not is_ranked(data, metric):
        return None
    value, margin = metric_values(data, metric), _margins(data)
    is_known = (data["status"] == status.OK) & np.isfinite(value)
    condition = requirement(data, metric)
    best = ranked_cases(data, metric, condition)
    loose = requirement(data, metric, is_safe=False)
    first, free = int(best[0]), int(ranked_cases(data, metric, loose, count=1)[0])
    warning = margin_warning(data, best)
    is_safe = not warning and bool(np.isfinite(margin[best]).any())
    is_beaten = is_safe and value[free] < value[first]
    readings, names = shown_metric(data, metric), swept_names(data)
    unit = readable(unit_of_metric(data, metric))[1]
    spread = float(np.ptp(readings[best]) / max(abs(readings[first]), 1e-300))

    def with_unit(number: float) -> str:
        return f"{number:.4g} {unit}".rstrip()

    return {
        "case": first,
        "value": with_unit(readings[first]),
        "setting": ", ".join(
            f"{x} = {shown_value(data, x, first)} {unit_of_metric(data, x)}".rstrip() for x in names
        ),
        "margin": float(margin[first]) if np.isfinite(margin[first]) else None,
        "median": with_unit(np.median(readings[is_known])),
        "spread": spread if len(best) > 3 and spread < ALIKE else None,
        "warning": warning,
        "is_safe": is_safe,
        "condition": condition,
        "idle": _uncontrolled_links(data, metric, first),
        # better than the best one, but with a smaller gain margin
        "rival": (free, with_unit(readings[free]), margin[free]) if is_beaten else None,
        "table": case_rows(data, best, [metric]),
        "note": mark_note(data, best, metric),
        "unmeasured": resolution_warning(data, best, metric),
    }


def _uncontrolled_links(data: SweepData, metric: str, case: int) -> list[tuple[str, str]]:
    """Links that no case controls, and a metric of theirs, where it is one of links."""
    dims = data.variables[metric.partition("[")[0]].dims
    if "link" not in dims or "link=" in metric:
        return []
    idle = set(np.flatnonzero(~counted_links(data)).tolist())
    unit = readable(unit_of_metric(data, metric))[1]
    names = [(str(link + 1), f"{metric}[link={link + 1}]") for link in sorted(idle)]
    return [(k, f"{shown_metric(data, name)[case]:.4g} {unit}".rstrip()) for k, name in names]


def _method_text(block: Block) -> str:
    """How a block combines its axes."""
    return METHODS[block.method].text.format(block.count or len(block.cases))


def _values(written: Any) -> Mapping[str, Any] | list[str]:
    """Values of an axis: a range as written, or each value in words."""
    if isinstance(written, str):
        return [written]
    if isinstance(written, list):
        return [value if isinstance(value, str) else shown(value) for value in written]
    return written if "from" in written else [toml_value(written)]
