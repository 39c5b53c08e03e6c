"""Files of one run: its data, and its report with metrics, judgement of the loop and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel import status
from jaxmodel.axial import euler_force
from studies.engine.poles import HEADER, difference, pole_rows
from studies.engine.run_data import chord_deflection, run_attributes, run_variables
from studies.engine.runs import Run, uncontrolled_twin
from studies.errors import StudyError
from studies.publish import check_target, publish
from studies.show import figures, units
from studies.show.pages import page
from studies.show.sketch import CAPTION, sketch
from studies.show.units import number
from studies.show.words import control_text, motion_text
from studies.store import write_store
from studies.study.margin import ENOUGH, MARGIN_MODES, caution

#: Figures, by the end of the file name.
FIGURES = ("deflection", "error", "voltage", "machine")
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


def check_results(out: Path, has_report: bool) -> None:
    """Raise StudyError unless the files of a run can be written; call it before long work.

    Args:
        out: file of the run.
        has_report: whether its report will be written next to it.

    Raises:
        StudyError: a file cannot be written, or `out` has the name of one of the report.
    """
    if out.suffix == ".toml":
        raise StudyError(f"--out {out}: results are HDF5, not a study; name the file *.h5")
    check_target(out)
    names = [f"{out.stem}.html", *(f"{out.stem}-{name}.png" for name in FIGURES)]
    for name in names if has_report else []:
        if name == out.name:
            raise StudyError(f"--out {out}: --report writes a file of this name; name it *.h5")
        check_target(out.with_name(name))


def write_results(
    out: Path, run: Run, has_report: bool, notes: Sequence[str] = (), name: str = "STUDY"
) -> None:
    """Write a run to its file and, if requested, its report next to it.

    Args:
        out: file of the run.
        run: with trajectories.
        has_report: whether to write the report.
        notes: sentences that the report adds.
        name: of the study on the command line, for commands in the report.

    Raises:
        StudyError: a file cannot be written.
    """
    with publish(out.parent) as staging:
        write_store(staging / out.name, run_variables(run), run_attributes(run.study))
        if not has_report:
            return
        twin = uncontrolled_twin(run)
        with figures.styled():
            for kind, figure in {**draw(run, twin), "machine": sketch(run.study)}.items():
                figures.write_figure(figure, staging / f"{out.stem}-{kind}.png")
        text = report(out.stem, run, twin, notes, name, staging)
        (staging / f"{out.stem}.html").write_text(text, encoding="utf-8")


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
        notes=notes,
        name=name,
        motion=motion_text(study),
        control=control_text(study),
        is_finished=run.status in status.FINISHED,
        worst=worst,
        rms=result.metrics.residual_rms.max(axis=1),
        free_rms=free.result.metrics.residual_rms.max(axis=1) if free else None,
        settled=[settling_text(run, link) for link in range(3)],
        free_settled=[settling_text(free, link) for link in range(3)] if free else [],
        later=_later(run, free, worst) if free else "",
        verdict=VERDICTS,
        caution=caution(run.loop.gain_margin) if run.loop is not None else "",
        at_limit=limits_text(run),
        case=_situation(run, twin),
        band=study.metrics.settling_band,
        windows=run.case.windows,
        stations=", ".join(f"{100 * x:g}" for x in study.metrics.stations),
        watched=_watched(run),
        command_end=float(result.command_end),
        buckling=np.broadcast_to(euler_force(run.case.machine.beam), (3,)),
        n_modes=max(MARGIN_MODES, study.link.modes),
        links=_links(run, twin),
        platform=_platform(run),
        modes=_modes(run),
        pole_header=HEADER,
        pole_rows=pole_rows(run.poles) if run.poles is not None else [],
        pole_difference=difference(run.poles) if run.poles is not None else "",
        sketch_caption=CAPTION,
    )


def limits_text(run: Run) -> str:
    """Warning about converters and actuators at their limits in a run that ended ok, "" if none."""
    metrics = run.result.metrics
    shares = {
        "an ADC channel clipped": float(metrics.clipped_fraction),
        "an actuator at its limit": float(metrics.saturated_fraction),
        "a motor at its limit": float(metrics.motor_saturated_fraction),
    }
    told = [
        f"{100 * share:.2g} % of the samples have {what}"
        for what, share in shares.items()
        if share > 0
    ]
    return f"CAUTION: {'; '.join(told)}." if told and run.status == status.OK else ""


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


def _later(run: Run, free: Run, link: int) -> str:
    """By how much control delays settling, as a share; "" if it hardly does."""
    after, before = (float(x.result.metrics.settling_time[link]) for x in (run, free))
    return f"{100 * (after / before - 1):.3g} %" if after > (1 + LATER) * before > 0 else ""


def _links(run: Run, twin: Run | None) -> list[list[str]]:
    """Row of each link."""
    metrics = run.result.metrics
    record = run.result.record
    assert record is not None
    largest = np.abs(record.chord_deflection_stations).max(axis=0)
    lengths = [metrics.residual_rms, metrics.residual_peak, largest]
    if twin is not None:
        lengths.insert(1, twin.result.metrics.residual_rms)
    return [
        [
            str(i + 1),
            *(number(values[i].max(), "m") for values in lengths),
            settling_text(run, i),
            number(metrics.peak_voltage[i], "V"),
            number(metrics.peak_force[i], "N"),
        ]
        for i in range(3)
    ]


def _watched(run: Run) -> float:
    """From the end of the shaped command to that of the run [s]."""
    return run.study.run.duration - float(run.result.command_end)


def settling_text(run: Run, link: int) -> str:
    """Settling time of a link [ms], or that it was outside the band to the end."""
    return units.settling_text(float(run.result.metrics.settling_time[link]), _watched(run))


def _platform(run: Run) -> list[list[str]]:
    """Row of each coordinate."""
    metrics = run.result.metrics
    record = run.result.record
    assert record is not None
    largest = np.abs(record.pose_error).max(axis=0)
    errors = largest, metrics.pose_error_rms, metrics.stretch_error_peak
    return [[name, *(number(error[k], "m") for error in errors)] for k, name in enumerate(_POSE)]


def _modes(run: Run) -> list[list[str]]:
    """Row of each mode order, for a judged loop."""
    if run.loop is None:
        return []
    modes = zip(run.loop.frequency_hz, run.loop.damping_ratio, strict=True)
    return [
        [str(k + 1), ", ".join(f"{f:.2f}" for f in frequency), ", ".join(f"{z:.4f}" for z in zeta)]
        for k, (frequency, zeta) in enumerate(modes)
    ]


def draw(run: Run, twin: Run | None = None) -> dict[str, Figure]:
    """FIGURES of a run, three rows each, in the style of the caller; twin: without control."""
    record = run.result.record
    assert record is not None
    pairs = [f"pair {k + 1}" for k in range(record.actuator_voltage.shape[2])]
    error = [(label, 1e6 * record.pose_error[:, [k]]) for k, label in enumerate(_POSE)]
    voltage = [(f"link {i + 1} [V]", record.actuator_voltage[:, i]) for i in range(3)]
    return {
        "deflection": _deflection(run, twin),
        "error": _over_time(run, error, []),
        "voltage": _over_time(run, voltage, pairs),
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
    figure, axes = figures.new_figure(3, 1 + has_rest, 1.4)
    for link, row in enumerate(axes):
        for ax in row:
            for values, style in zip(bent, _styles(run, twin), strict=True):
                ax.plot(time, values[:, link], **style)
            ax.margins(x=0.01)
        row[0].axvline(end, color=GREY, linewidth=0.8, linestyle=":")
        row[0].set_ylabel(f"link {link + 1} [µm]")
        if has_rest:
            seen = (time >= window[0]) & (time <= window[1])
            _zoom(row[1], [x[seen, link] for x in bent], (end, time[-1]), window)
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
    ax: Axes, seen: list[np.ndarray], span: tuple[float, float], window: tuple[float, float]
) -> None:
    """Limit a panel to a span of time and to the size of what is seen in the residual window."""
    ax.axvspan(*window, color=GREY, alpha=0.12, linewidth=0)
    ax.set_xlim(span)
    size = max((float(np.abs(x).max()) for x in seen if len(x) and np.isfinite(x).all()), default=0)
    if size > 0:
        ax.set_ylim(-1.2 * size, 1.2 * size)
