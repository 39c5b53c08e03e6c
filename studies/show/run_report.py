"""Files of one run: its data, and its report with metrics, judgement of the loop and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel import status
from jaxmodel.axial import euler_force
from jaxmodel.laws import LAWS
from studies.engine.runs import (
    Run,
    chord_deflection,
    run_attributes,
    run_variables,
    uncontrolled_twin,
)
from studies.errors import StudyError
from studies.show import figures
from studies.show.pages import literal, opening, picture, table, write_report
from studies.show.sketch import CAPTION, sketch
from studies.store import check_target, write_store
from studies.study.labels import describe
from studies.study.margin import ENOUGH, caution, margin_text
from studies.study.spec import Study

#: Captions of what is drawn, by the end of the file's name.
FIGURES = {
    "deflection": "Deflection of the links' middle from the chord between their ends",
    "error": "Platform: pose minus shaped command",
    "voltage": "Voltages of the actuators, numbered from the slider on",
    "machine": CAPTION,
}
_FREE = "without control"
_POSE = ("x [µm]", "y [µm]", "φ [µrad]")


def check_results(out: Path, has_report: bool) -> None:
    """Raise StudyError unless the files of a run can be written; call it before long work.

    Args:
        out: file of the run.
        has_report: whether its report is to be written beside it.

    Raises:
        StudyError: a file cannot be written, or `out` has the name of one of the report.
    """
    if out.suffix == ".toml":
        raise StudyError(f"--out {out}: results are HDF5, not a study; name the file *.h5")
    check_target(out)
    names = [f"{out.stem}.html", f"{out.stem}.md", *(_figure(out, name) for name in FIGURES)]
    for name in names if has_report else []:
        if name == out.name:
            raise StudyError(f"--out {out}: --report writes a file of this name; name it *.h5")
        check_target(out.with_name(name))


def write_results(out: Path, run: Run, has_report: bool, notes: Sequence[str] = ()) -> str:
    """Write a run to its file and, if asked for, its report beside it.

    Args:
        out: file of the run.
        run: with trajectories.
        has_report: whether to write the report.
        notes: sentences that it adds to what it says of the run's status.

    Returns:
        What has been written, in words.

    Raises:
        StudyError: a file cannot be written.
    """
    write_store(out, run_variables(run), run_attributes(run.study))
    if not has_report:
        return f"written: {out}"
    twin = uncontrolled_twin(run)
    with figures.styled():
        for name, figure in {**draw(run, twin), "machine": sketch(run.study)}.items():
            figures.write_figure(figure, out.with_name(_figure(out, name)))
    write_report(out.parent, report(out, run, twin, notes), run.study, out.stem)
    return f"written: {out}\nreport: {out.with_name(out.stem)}.html"


def _figure(out: Path, name: str) -> str:
    """File of one of FIGURES."""
    return f"{out.stem}-{name}.png"


def report(out: Path, run: Run, twin: Run | None, notes: Sequence[str]) -> str:
    """Markdown text; arguments of `write_results`, and the same run without control."""

    end = float(run.result.command_end)

    def shown(name: str) -> list[str]:
        return [picture(_figure(out, name), FIGURES[name]), ""]

    lines = [
        f"# {literal(run.study.title) or 'study'}: one run",
        "",
        *opening(_asked(run), _came_out(run, twin, notes), _next(run, twin)),
        *shown("machine"),
        "## Links",
        "",
        *_links(run, twin),
        "",
        f"Over time; dotted: the end of the shaped command at {round(end, 9):.4g} s.",
        "",
        *shown("deflection"),
        "## Platform",
        "",
        *_platform(run),
        "",
        *shown("error"),
        "## Control loop",
        "",
        *_loop(run),
        "",
        *shown("voltage"),
    ]
    return "\n".join(lines)


def _asked(run: Run) -> str:
    return f"{motion_text(run.study)}; {control_text(run.study)}."


def motion_text(study: Study) -> str:
    """What moves the machine, in words."""
    motion, load, drive = study.motion, study.load, study.drive
    points = np.array(motion.waypoints, float)[:, :2]
    count = len(points) - 1
    told = "the platform at rest"
    if count:
        longest = 1e3 * np.linalg.norm(np.diff(points, axis=0), axis=1).max()
        times = np.atleast_1d(motion.move_time)
        span = f"{1e3 * times.min():.4g}" + (
            f" to {1e3 * times.max():.4g}" if np.ptp(times) else ""
        )
        shaper = "no shaper" if study.shaper.kind == "none" else f"shaper {study.shaper.kind}"
        moves = f"{count} move{'s' if count > 1 else ''} of {'up to ' if count > 1 else ''}"
        told = f"{moves}{longest:.4g} mm in {span} ms{' each' if count > 1 else ''}, {shaper}"
    blows = [
        f"a pulse of {max(map(abs, force)):.4g} {unit} on the {where}"
        for force, unit, where in (
            (drive.pulse_force, "N", "sliders"),
            (load.pulse, "N or N m", "platform"),
        )
        if any(force)
    ]
    if drive.ripple:
        blows.append(f"force ripple of {drive.ripple:g} N rms")
    if any(study.initial.load_deflection) or any(map(any, study.initial.modal)):
        blows.append("links bent at the start")
    return ", ".join([told, *blows])


def control_text(study: Study) -> str:
    """Who is controlled and how, in words."""
    control = study.control
    links = [str(i + 1) for i in range(3) if control.links[i]]
    if control.feedback == "none" or not links:
        return "no link controlled"
    law = LAWS[control.law]
    what = f"{law.text} of {control.modes} modes" if law.channel == "mode" else law.text
    return (
        f"{what} on link{'s' if len(links) > 1 else ''} {', '.join(links)}, "
        f"{control.feedback} feedback, gain factor {control.gain_factor:g}"
    )


def _came_out(run: Run, twin: Run | None, notes: Sequence[str]) -> str:
    metrics, worst = run.result.metrics, _worst_link(run)
    told = [_status(run, [f"{note.rstrip('.')}." for note in notes])]
    if run.status in status.FINISHED:
        rms = 1e6 * metrics.residual_rms[worst].max()
        without = ""
        if twin is not None and twin.status in status.FINISHED:
            without = (
                f" ({1e6 * twin.result.metrics.residual_rms[worst].max():.4g} without control)"
            )
        told.append(
            f"Link {worst + 1} vibrates most: {rms:.4g} µm rms{without}, settled: "
            f"{settling_text(run, worst)} ms after the command; peak voltage "
            f"{metrics.peak_voltage.max():.4g} of "
            f"{run.study.electronics.voltage_limit:g} V."
        )
    if run.loop is not None:
        told.append(f"Gain margin {margin_text(run.loop.gain_margin)}.")
        warning = caution(run.loop.gain_margin)
        told += [f"**{literal(warning)}**"] if warning else []
    return " ".join(told)


def _is_worse(run: Run, twin: Run) -> bool:
    mine, theirs = (x.result.metrics.residual_rms.max() for x in (run, twin))
    return bool(mine > 1.05 * theirs)


def _worst_link(run: Run) -> int:
    return int(np.argmax(np.nan_to_num(run.result.metrics.residual_rms.max(axis=1), nan=-1.0)))


def _next(run: Run, twin: Run | None) -> str:
    if run.loop is not None and run.loop.gain_margin < ENOUGH:
        return (
            "lower `control.gain_factor`, or move the patches: a sweep over `gain` and `placement` "
            "(`studies sweep placement`) shows where margins are."
        )
    if run.study.control.feedback == "none" or not any(run.study.control.links):
        return "control the links (`[control]`) and compare."
    band = run.study.metrics.settling_band
    if twin is not None and twin.result.metrics.residual_rms.max() < band:
        return (
            f"there is hardly anything to suppress, without control less than {1e6 * band:g} µm "
            "is left: a faster move, or a disturbance (`studies simulate disturbance`), shows what "
            "control does."
        )
    if twin is not None and _is_worse(run, twin):
        return (
            "control leaves more than no control does: the window begins with the slider drive's "
            "own settling, which bends the links too, and the loop answers to it. "
            "`metrics.residual_delay = 0.04` looks at the links' own vibration."
        )
    return (
        "`studies spillover STUDY --out certificate` for how far the design may be trusted, "
        "`studies tune SPEC` for better numbers, `studies export STUDY` for the controller."
    )


def _status(run: Run, notes: Sequence[str]) -> str:
    bad = float(run.result.bad_time)
    since = f" from {bad:.4g} s on" if bad > 0 else ""
    return " ".join([f"Status: **{describe(run.status)}**{since}.", *map(literal, notes)])


def _links(run: Run, twin: Run | None) -> list[str]:
    metrics, own = run.result.metrics, run.study.metrics
    rows = [
        [
            str(i + 1),
            f"{1e6 * metrics.residual_rms[i].max():.4g}",
            f"{1e6 * metrics.residual_peak[i].max():.4g}",
            f"{1e6 * metrics.structural_peak[i].max():.4g}",
            settling_text(run, i),
            f"{metrics.peak_voltage[i]:.4g}",
            f"{metrics.peak_force[i]:.4g}",
        ]
        for i in range(3)
    ]
    more: tuple[str, ...] = ()
    told = ""
    if twin is not None:
        more = ("residual rms without control [µm]",)
        for row, rms in zip(rows, twin.result.metrics.residual_rms, strict=True):
            row.insert(2, f"{1e6 * rms.max():.4g}")
        if twin.status not in status.FINISHED:
            told = f" Without control the run ends early: {describe(twin.status)}."
    stations = ", ".join(f"{1e3 * x:g}" for x in own.stations)
    heads = (
        "link",
        "residual rms [µm]",
        *more,
        "residual peak [µm]",
        "peak while moving [µm]",
        "settling time [ms]",
        "peak voltage [V]",
        "peak motor force [N]",
    )
    return [
        f"Deflections: the largest of the stations at {stations} mm. Residual window: "
        f"{own.residual_length:g} s, from {own.residual_delay:g} s after the shaped command. "
        f"Settled: within {1e6 * own.settling_band:g} µm from then to the end of the run, "
        f"{1e3 * _watched(run):.4g} ms after the shaped command.{told}",
        "",
        *table(heads, rows),
    ]


def _watched(run: Run) -> float:
    """From the end of the shaped command to that of the run [s]."""
    return run.study.run.duration - float(run.result.command_end)


def settling_text(run: Run, link: int) -> str:
    """Settling time of a link [ms], or that it was outside the band to the end."""
    seconds = float(run.result.metrics.settling_time[link])
    last = _watched(run)
    if seconds >= last - 1.5 / run.study.electronics.sample_rate_hz > 0:
        return f"not within {1e3 * last:.4g}"
    return f"{1e3 * seconds:.4g}"


def _platform(run: Run) -> list[str]:
    metrics, critical = run.result.metrics, euler_force(run.case.machine.beam)
    errors = metrics.pose_error_peak, metrics.pose_error_rms, metrics.stretch_error_peak
    rows = [[name, *(f"{1e6 * error[k]:.4g}" for error in errors)] for k, name in enumerate(_POSE)]
    return [
        "Pose minus shaped command. The links of the model do not stretch; the last column is what "
        "stretching by N L/(E A) would add. "
        f"Largest tension in a link {np.max(metrics.peak_tension):.4g} N, largest compression "
        f"{np.max(metrics.peak_compression):.4g} N (a bare link buckles at {np.min(critical):.4g} "
        "N).",
        "",
        *table(
            ("", "largest while moving", "rms in the residual window", "stretch of the links"), rows
        ),
    ]


def _loop(run: Run) -> list[str]:
    metrics = run.result.metrics
    lines = [
        f"Samples with an actuator at its limit: {100 * metrics.saturated_fraction:.3g} %; with an "
        f"ADC channel at its end: {100 * metrics.clipped_fraction:.3g} %; with a motor at its "
        f"limit of {run.study.drive.force_limit:g} N: "
        f"{100 * metrics.motor_saturated_fraction:.3g} %.",
    ]
    if run.loop is None:
        return lines
    modes = zip(run.loop.frequency_hz, run.loop.damping_ratio, strict=True)
    rows = [
        [str(k + 1), ", ".join(f"{f:.2f}" for f in frequency), ", ".join(f"{z:.4f}" for z in zeta)]
        for k, (frequency, zeta) in enumerate(modes)
    ]
    return [
        *lines,
        "",
        f"Linearised at the first pose: gain margin {margin_text(run.loop.gain_margin)}, spectral "
        f"radius {run.loop.spectral_radius:.6f}. {_motion(run)}The lowest modes of the links with "
        "control, three of each order:",
        "",
        *table(("order", "frequencies [Hz]", "damping ratios [1]"), rows),
    ]


def _motion(run: Run) -> str:
    if run.motion is None:
        return ""
    margin, force = run.motion.gain_margin, run.motion.axial_force
    told = (
        f"With the forces that the planned motion puts on the links ({force.min():.3g} to "
        f"{force.max():.3g} N; the drive's own ringing and pulses come on top, see the table) the "
        f"margin goes from {margin_text(margin.min())} to {margin_text(margin.max())}. "
    )
    if margin.min() == 0:
        told += "0: at that instant the loop is unstable at any gain, as of a link that buckles. "
    return told


def draw(run: Run, twin: Run | None = None) -> dict[str, Figure]:
    """FIGURES of a run, three panels each, in the style of the caller; twin: without control."""
    record, end = run.result.record, float(run.result.command_end)
    assert record is not None
    pairs = [f"pair {k + 1}" for k in range(record.actuator_voltage.shape[2])]
    bent, error, links = 1e6 * chord_deflection(run), 1e6 * record.pose_error, range(3)
    panels: dict[str, list[tuple[np.ndarray, list[str], str]]] = {
        "deflection": [(bent[:, [i]], [], f"link {i + 1} [µm]") for i in links],
        "error": [(error[:, [k]], [], label) for k, label in enumerate(_POSE)],
        "voltage": [(record.actuator_voltage[:, i], pairs, f"link {i + 1} [V]") for i in links],
    }
    drawn = {}
    for name, rows in panels.items():
        figure, axes = figures.new_figure(3, 1, 1.3)
        done: list[Axes] = []
        for ax, (values, names, label) in zip(axes[:, 0], rows, strict=True):
            if name == "deflection" and twin is not None:
                figures.traces(record.time, values, ["with control"], label, ax)
                without = 1e6 * chord_deflection(twin)[:, len(done)]
                ax.plot(record.time, without, color="#999999", linewidth=0.7, zorder=1, label=_FREE)
            else:
                figures.traces(record.time, values, names, label, ax)
            done.append(ax)
            ax.axvline(end, color="#888888", linewidth=0.8, linestyle=":")
        axes[-1, 0].set_xlabel("time [s]")
        if name == "voltage" or (name == "deflection" and twin is not None):
            figures.legend_above(figure, axes[0, 0])
        drawn[name] = figure
    return drawn
