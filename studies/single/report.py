"""Files of one run: its data, and its report with metrics, judgement of the loop and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel import status
from jaxmodel.axial import euler_force
from jaxmodel.loop_figures import MARGIN_MODES
from studies.engine.poles import HEADER, difference, pole_rows
from studies.engine.run_data import chord_deflection
from studies.engine.runs import Run
from studies.show import figures
from studies.show.pages import old_page as page
from studies.show.sketch import CAPTION
from studies.show.units import is_cut_off, number
from studies.show.words import control_text, motion_text
from studies.single.summary import limits_text, link_rows, machine_notes, settling_text, watched
from studies.study.margin import ENOUGH, caution, hysteresis_text, stretch_text

#: Figures, by the end of the file name.
#: What a run means, by its situation.
VERDICTS = {
    "stopped": "the run stopped",
    "margin": "too little margin for a machine",
    "uncontrolled": "nothing is controlled",
    "calm": "hardly anything to suppress",
    "worse": Markup("<b>control makes it worse</b>"),
    "well": "control works",
}
#: Settling later than without control is pointed out from this share on [1].
LATER = 0.02
#: Grey of the residual window and of markers.
GREY = "#888888"
_POSE = ("x [µm]", "y [µm]", "φ [µrad]")


def report(
    stem: str,
    run: Run,
    twin: Run | None,
    notes: Sequence[str],
    name: str,
    folder: Path | None = None,
) -> str:
    """The page of a run.

    Args:
        stem: with which the names of its figures begin.
        run: with trajectories.
        twin: the same run without control.
        notes: sentences to add.
        name: of the study on the command line.
        folder: with the figures; None: a page without.
    """
    result, study = run.result, run.study
    worst = int(np.argmax(np.nan_to_num(result.metrics.residual_rms.max(axis=1), nan=-1.0)))
    free = twin if twin is not None and twin.status in status.FINISHED else None
    links = range(study.n_links)
    return page(
        "single/report.html",
        folder,
        study,
        stem=stem,
        run=run,
        study=study,
        twin=twin,
        metrics=result.metrics,
        loop=run.loop,
        planned=run.motion,
        notes=[*notes, *machine_notes(run)],
        name=name,
        motion=motion_text(study),
        control=control_text(study),
        is_finished=run.status in status.FINISHED,
        worst=worst,
        rms=result.metrics.residual_rms.max(axis=1),
        free_rms=free.result.metrics.residual_rms.max(axis=1) if free else None,
        settled=[settling_text(run, link) for link in links],
        free_settled=[settling_text(free, link) for link in links] if free else [],
        later=_settling_delay(run, free, worst) if free else "",
        verdict=VERDICTS,
        caution=caution(run.loop.gain_margin) if run.loop is not None else "",
        by_stretch=stretch_text(run.loop.by_stretch) if run.loop is not None else "",
        at_limit=limits_text(run),
        hysteresis=hysteresis_text(study.patches.hysteresis),
        case=_situation(run, twin),
        band=study.metrics.settling_band,
        windows=run.case.windows,
        stations=", ".join(f"{100 * x:g}" for x in study.metrics.stations),
        watched=watched(run),
        command_end=float(result.command_end),
        buckling=np.asarray(euler_force(run.case.machine)),
        n_modes=max(MARGIN_MODES, study.link.modes),
        links=link_rows(run, twin),
        platform=_platform(run),
        away=_largest_deviation(run),
        modes=_modes(run),
        pole_header=HEADER,
        pole_rows=pole_rows(run.poles) if run.poles is not None else [],
        pole_difference=difference(run.poles) if run.poles is not None else "",
        sketch_caption=CAPTION,
    )


def _situation(run: Run, twin: Run | None) -> str:
    """The situation, one of VERDICTS, that determines the recommended next step."""
    if run.status not in status.FINISHED:
        return "stopped"
    if run.loop is not None and run.loop.gain_margin < ENOUGH:
        return "margin"
    if not run.study.is_controlled:
        return "uncontrolled"
    if twin is None:
        return "well"
    left, free = (x.result.metrics.residual_rms.max() for x in (run, twin))
    if free < run.study.metrics.settling_band:
        return "calm"
    return "worse" if left > 1.05 * free else "well"


def _settling_delay(run: Run, free: Run, link: int) -> str:
    """By how much control delays settling, as a share; "" if it hardly does."""
    after, before = (float(x.result.metrics.settling_time[link]) for x in (run, free))
    least = "at least " if is_cut_off(after, watched(run)) else ""
    is_later = after > (1 + LATER) * before > 0
    return f"{least}{100 * (after / before - 1):.3g} %" if is_later else ""


def _platform(run: Run) -> list[list[str]]:
    """Row of each coordinate."""
    metrics = run.result.metrics
    record = run.result.record
    assert record is not None
    largest = np.abs(record.pose_error).max(axis=0)
    errors = zip(largest, metrics.pose_error_rms, metrics.stretch_error_peak, strict=True)
    rows = zip(_POSE, errors, strict=False)
    return [[name, *(number(error, "m") for error in own)] for name, own in rows]


def _largest_deviation(run: Run) -> tuple[float, float]:
    """Of the platform from the reference trajectory at any time: distance [m], angle [rad]."""
    record = run.result.record
    assert record is not None
    error = record.pose_error
    return float(np.hypot(error[:, 0], error[:, 1]).max()), float(
        np.abs(error[:, 2:]).max(initial=0.0)
    )


def _modes(run: Run) -> list[list[str]]:
    """Row of each mode order, for a judged loop."""
    if run.loop is None:
        return []
    modes = zip(run.loop.frequency_hz, run.loop.damping_ratio, strict=True)
    return [
        [str(k + 1), ", ".join(f"{f:.2f}" for f in frequency), ", ".join(f"{z:.4f}" for z in zeta)]
        for k, (frequency, zeta) in enumerate(modes)
    ]


def drawings(run: Run, twin: Run | None = None) -> dict[str, Callable[[], Figure]]:
    """What draws figures of a run, three rows each; twin: without control."""
    record = run.result.record
    assert record is not None
    pairs = [f"pair {k + 1}" for k in range(record.actuator_voltage.shape[2])]
    error = [
        (label, 1e6 * x[:, None]) for label, x in zip(_POSE, record.pose_error.T, strict=False)
    ]
    voltage = [
        (f"link {i + 1} [V]", record.actuator_voltage[:, i]) for i in range(run.study.n_links)
    ]
    return {
        "deflection": partial(_deflection, run, twin),
        "error": partial(_over_time, run, error, []),
        "voltage": partial(_over_time, run, voltage, pairs),
    }


def _over_time(run: Run, rows: list[tuple[str, np.ndarray]], names: list[str]) -> Figure:
    """A panel of each quantity, (T, n) with its label; names: of the n curves, [] for one."""
    assert run.result.record is not None
    figure, axes = figures.new_figure(len(rows), 1, 1.3)
    for ax, (label, values) in zip(axes[:, 0], rows, strict=True):
        figures.traces(1e3 * run.result.record.time, values, names, label, ax)
        ax.axvline(1e3 * float(run.result.command_end), color=GREY, linewidth=0.8, linestyle=":")
    axes[-1, 0].set_xlabel("time [ms]")
    if names:
        figures.legend_above(figure, axes[0, 0])
    return figure


def _deflection(run: Run, twin: Run | None) -> Figure:
    """Deflection of each link: the run, and beside it what the reference trajectory leaves."""
    assert run.result.record is not None
    time, end = 1e3 * run.result.record.time, 1e3 * float(run.result.command_end)
    windows = run.case.windows
    start = end + 1e3 * float(windows.residual_delay)
    window = (start, start + 1e3 * float(windows.residual_length))
    bent = [1e6 * chord_deflection(x) for x in (twin, run) if x is not None]
    has_rest = time[-1] > end
    figure, axes = figures.new_figure(run.study.n_links, 1 + has_rest, 1.4)
    for link, row in enumerate(axes):
        for ax in row:
            for values, style in zip(bent, _styles(run, twin), strict=True):
                ax.plot(time, values[:, link], **style)
            ax.margins(x=0.01)
        row[0].axvline(end, color=GREY, linewidth=0.8, linestyle=":")
        row[0].set_ylabel(f"link {link + 1} [µm]")
        if has_rest:
            is_shown = (time >= window[0]) & (time <= window[1])
            _zoom(row[1], [x[is_shown, link] for x in bent], (end, time[-1]), window)
    for ax in axes[-1]:
        ax.set_xlabel("time [ms]")
    if twin is not None:
        figures.legend_above(figure, axes[0, 0])
    return figure


def _styles(run: Run, twin: Run | None) -> list[dict[str, Any]]:
    """Of the curves without and with control, or of the only one."""
    if twin is None:
        return [figures.CONTROLLED if run.study.control.feedback != "none" else figures.WITHOUT]
    return [figures.WITHOUT, figures.CONTROLLED]


def _zoom(
    ax: Axes, curves: list[np.ndarray], span: tuple[float, float], window: tuple[float, float]
) -> None:
    """Limit a panel to a span of time and to the size of what is seen in the residual window."""
    ax.axvspan(*window, color=GREY, alpha=0.12, linewidth=0)
    ax.set_xlim(span)
    size = max(
        (float(np.abs(x).max()) for x in curves if len(x) and np.isfinite(x).all()), default=0
    )
    if size > 0:
        ax.set_ylim(-1.2 * size, 1.2 * size)
