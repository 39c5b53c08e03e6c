"""What a single run tells: how it ended and what vibration is left, then links, platform, loop."""

from __future__ import annotations

import numpy as np

from jaxmodel import status
from jaxmodel.axial import euler_force
from jaxmodel.loop_figures import MARGIN_MODES
from studies.engine.poles import HEADER, difference, pole_rows
from studies.engine.runs import Run
from studies.show import units
from studies.show.listing import Rows
from studies.show.report import Chapter, Report, chapter, drawing, machine
from studies.show.units import headed, number
from studies.show.words import control_text, motion_text
from studies.single import plots
from studies.single.run import Simulation
from studies.study import margin
from studies.study.labels import describe, remedy
from studies.study.spec import AUTO

#: What a run means, by its situation.
VERDICTS = {
    "margin": "too little margin for a machine",
    "uncontrolled": "nothing is controlled",
    "alone": "not compared with a run without control",
    "calm": "hardly anything to suppress",
    "worse": "**control makes it worse**",
    "well": "control works",
    "limits": "what the run met decides, see its status",
}
#: Settling later than without control is pointed out from this share on [1].
LATER = 0.02
#: Residual vibration below which joints that rub decide [m].
STICKING = 2e-6


def say(found: Simulation) -> Report:
    """What a run tells; figures need its trajectories."""
    run, twin = found.run, found.free
    study, loop, case = run.study, run.loop, _situation(run, twin)
    advice = remedy(run.status)
    warnings = margin.caution(loop.gain_margin) if loop is not None else "", _limits(run)
    result = [
        f"status: **{describe(run.status)}**",
        advice and f"next step: {advice}",
        *_outcome(run, twin, case),
        *(f"**{text}**" for text in warnings if text),
        margin.hysteresis_text(study.patches.hysteresis),
        *found.notes,
        *machine_notes(run),
    ]
    return Report(
        title=f"{study.title or 'untitled study'}: one run",
        result=result,
        question=f"{motion_text(study)}; {control_text(study)}: how much vibration is left?",
        next_steps=_next_steps(run, case, found.name),
        top=[run.result.record and machine(study)],
        chapters=[_links(run, twin), _platform(run), _loop(run)],
        files={"Study file": study},
        caveat=margin.stretch_text(loop.by_stretch) if loop is not None else "",
    )


def _situation(run: Run, twin: Run | None) -> str:
    """The situation, one of VERDICTS or "stopped", that determines the recommended next step."""
    if run.status not in status.FINISHED:
        return "stopped"
    if run.loop is not None and run.loop.gain_margin < margin.ENOUGH:
        return "margin"
    if not run.study.is_controlled:
        return "uncontrolled"
    if twin is None:
        return "alone"
    if run.status != status.OK:
        return "limits"
    left, free = (x.result.metrics.residual_rms.max() for x in (run, twin))
    if free < run.study.metrics.settling_band:
        return "calm"
    return "worse" if left > 1.05 * free else "well"


def _outcome(run: Run, twin: Run | None, case: str) -> list[str]:
    """What is left of the vibration, and what the run took, in sentences."""
    if case == "stopped":
        return [f"the run stopped at {number(run.result.bad_time, 's')} ms"]
    metrics, record, loop = run.result.metrics, run.result.record, run.loop
    rms = metrics.residual_rms.max(axis=1)
    worst = int(np.argmax(np.nan_to_num(rms, nan=-1.0)))
    compared = "" if run.study.is_controlled else ", without control"
    before = later = away = ""
    if twin is not None and twin.status in status.FINISHED:
        free = twin.result.metrics.residual_rms.max(axis=1)[worst]
        change = f", {100 * (rms[worst] / free - 1):+.3g} %" if free > 0 else ""
        compared = f" ({number(free, 'm')} without control{change})"
        before = f" ({_settling(twin, worst)} without control)"
        later = _settling_delay(run, twin, worst)
    if record is not None:
        distance = np.linalg.norm(record.pose_error[:, :2], axis=1).max()
        angle = np.abs(record.pose_error[:, 2:]).max(initial=0.0)
        turn = f" and {number(angle, 'm')} µrad" if record.pose_error.shape[1] > 2 else ""
        away = f"by at most {number(distance, 'm')} µm{turn}"
    judged = f", gain margin {margin.margin_in_db(loop.gain_margin)}" if loop is not None else ""
    but = "; the link settles" if case == "margin" else ", but the link settles"
    return [
        f"residual {number(rms[worst], 'm')} µm rms on link {worst + 1}, the worst{compared}"
        f"{judged}: {VERDICTS[case]}{later and f'{but} {later} later than without control'}",
        f"settling time {_settling(run, worst)} ms{before}",
        f"peak voltage {metrics.peak_voltage.max():.4g} of "
        f"{run.study.electronics.voltage_limit:.6g} V",
        away and f"the platform leaves the reference trajectory {away}",
    ]


def _watched(run: Run) -> float:
    """From the end of the shaped reference to that of the run [s]."""
    return run.study.run.duration - float(run.result.command_end)


def _settling(run: Run, link: int) -> str:
    """Settling time of a link [ms], or that it was outside the band to the end."""
    return units.settling_text(float(run.result.metrics.settling_time[link]), _watched(run))


def _settling_delay(run: Run, free: Run, link: int) -> str:
    """By how much control delays settling, as a share; "" if it hardly does."""
    after, before = (float(x.result.metrics.settling_time[link]) for x in (run, free))
    least = "at least " if units.is_cut_off(after, _watched(run)) else ""
    is_later = after > (1 + LATER) * before > 0
    return f"{least}{100 * (after / before - 1):.3g} %" if is_later else ""


def _limits(run: Run) -> str:
    """Warning about converters and actuators at their limits in a run that ended ok, "" if none."""
    metrics = run.result.metrics
    shares = {
        "an ADC channel clipped": float(metrics.clipped_fraction),
        "an actuator at its limit": float(metrics.saturated_fraction),
        "a motor at its limit": float(metrics.motor_saturated_fraction),
    }
    warnings = [
        f"{100 * x:.2g} % of the samples have {what}" for what, x in shares.items() if x > 0
    ]
    return f"CAUTION: {'; '.join(warnings)}." if warnings and run.status == status.OK else ""


def machine_notes(run: Run) -> list[str]:
    """What a real machine would do beside: joints that decide how little is left, cracks."""
    metrics, notes = run.result.metrics, []
    if np.max(metrics.residual_rms) < STICKING and run.study.machine.joint_friction == 0:
        notes.append(
            "Less than 2 µm is left: joints that rub decide there, since they hold a link that "
            "hardly bends (machine.joint_friction, here 0; small ball bearings have 0.05 to 0.5 "
            "mN m)."
        )
    if (strain := np.max(metrics.patch_strain_peak)) > (limit := run.study.patches.strain_limit):
        notes.append(f"Ceramics strained up to {strain:.3g}, patches.strain_limit = {limit:g}.")
    return notes


def _next_steps(run: Run, case: str, name: str) -> str:
    well = f"""`studies certify {name} --out certificate` to see how far to trust the design,
    `studies tune SPEC` for a better one, `studies export {name} --target c --out dsp` for the
    controller."""
    drives = """, or leave `metrics.residual_delay` out: before the slider drive has settled it
    bends the links, and the loop responds to that"""
    return {
        "stopped": "lower the gains or slow the motion; the figures end where the run stopped.",
        "limits": f"{remedy(run.status) or 'lower the gains or slow the motion'}.",
        "margin": f"""lower `control.gain_factor`, or move the patches: a section `[sweep]` in this
        study's file, with the axes `gain` and `placement`, shows where margins are larger (`studies
        init --from placement` is an example, for the paper's machine). `studies certify {name}
        --out certificate` names what goes unstable first.""",
        "uncontrolled": "control the links (`[control]`) and compare.",
        "calm": f"""less than {number(run.study.metrics.settling_band, "m")} µm is left without
        control. A faster move, or a disturbance (`studies simulate disturbance`), shows what
        control does.""",
        "worse": f"""lower
        `control.gain_factor`{drives if run.study.metrics.residual_delay != AUTO else ""}.""",
    }.get(case, well)


def _links(run: Run, twin: Run | None) -> Chapter | None:
    metrics, windows = run.study.metrics, run.case.windows
    settled = ", when the drives have settled to 2 %" if metrics.residual_delay == AUTO else ""
    early = ""
    if twin is not None and twin.status not in status.FINISHED:
        early = f" Without control the run ends early: {describe(twin.status)}."
    return chapter(
        "Links",
        f"""Deflections: the largest of the stations at
        {", ".join(f"{100 * x:g}" for x in metrics.stations)} % of the link. Residual window:
        {number(windows.residual_length, "s")} ms, from {number(windows.residual_delay, "s")} ms
        after the reference trajectory at {number(run.result.command_end, "s")} ms{settled}.
        Settling time: until a link stays within {number(metrics.settling_band, "m")} µm; the run
        ends {number(_watched(run), "s")} ms after it.{early}""",
        _link_rows(run, twin),
        f"""Largest strain of the ceramics, at the centres of the pairs:
        {1e6 * run.result.metrics.patch_strain_peak.max():.4g} µm/m of
        {1e6 * run.study.patches.strain_limit:.4g} µm/m tolerated.""",
        run.result.record and drawing(plots.deflection, run, twin),
    )


def _link_rows(run: Run, twin: Run | None) -> Rows:
    """What each link did, at its worst station; twin: the same run without control."""
    metrics, record, links = run.result.metrics, run.result.record, range(run.study.n_links)

    def column(name: str, unit: str, values: np.ndarray) -> list[str]:
        return [headed(name, unit), *(number(np.max(x), unit) for x in values)]

    columns = [["link", *(str(k + 1) for k in links)]]
    columns.append(column("residual rms", "m", metrics.residual_rms))
    if twin is not None:
        free = twin.result.metrics.residual_rms
        columns.append(column("residual rms without control", "m", free))
    columns.append(column("residual peak", "m", metrics.residual_peak))
    if record is not None:
        largest = np.abs(record.chord_deflection_stations).max(axis=0)
        columns.append(column("peak of the run", "m", largest))
    columns.append([headed("settling time", "s"), *(_settling(run, k) for k in links)])
    columns.append(column("peak voltage", "V", metrics.peak_voltage))
    columns.append(column("peak motor force", "N", metrics.peak_force))
    heads, *rows = map(list, zip(*columns, strict=True))
    return Rows(heads, rows)


def _platform(run: Run) -> Chapter | None:
    record, metrics = run.result.record, run.result.metrics
    if record is None:
        return None
    buckling = np.asarray(euler_force(run.case.machine))
    first = f", link {buckling.argmin() + 1} as the first one"
    columns = (
        np.abs(record.pose_error).max(axis=0),
        metrics.pose_error_rms,
        metrics.stretch_error_peak,
    )
    heads = ["", "largest of the run", "rms in the residual window", "stretch of the links"]
    rows = [
        [name, *(number(x, "m") for x in own)]
        for name, *own in zip(plots.POSE, *columns, strict=False)
    ]
    return chapter(
        "Platform",
        f"""Pose minus reference trajectory. The last column is what links add that stretch by N
        L/(E A){"" if run.study.link.stretch else ", which those of the model do not"}. Largest
        tension in a link {metrics.peak_tension.max():.4g} N, largest compression
        {metrics.peak_compression.max():.4g} N (a bare link buckles at {buckling.min():.4g}
        N{first if buckling.max() > 1.001 * buckling.min() else ""}).""",
        Rows(heads, rows),
        drawing(plots.pose_error, run, name="error"),
    )


def _loop(run: Run) -> Chapter | None:
    metrics, poles = run.result.metrics, run.poles
    return chapter(
        "Control loop",
        f"""Samples with an actuator at its limit: {100 * metrics.saturated_fraction:.3g} %; with a
        clipped ADC channel: {100 * metrics.clipped_fraction:.3g} %; with a motor at its limit of
        {run.study.drive.force_limit:.6g} N: {100 * metrics.motor_saturated_fraction:.3g} %.""",
        *_margins(run),
        poles
        and f"""Poles: decay and frequency specified, of the nominal link's loop and of the
        assembled machine's. {difference(poles)}""",
        poles and Rows(HEADER, pole_rows(poles)),
        run.result.record and drawing(plots.voltage, run),
    )


def _margins(run: Run) -> tuple[str, Rows] | tuple[()]:
    """The judgement of the linearised loop, and its lowest modes; () if it is not judged."""
    loop, modes = run.loop, run.study.link.modes
    if loop is None:
        return ()
    grows = loop.gain_margin >= 1
    robust = loop.robustness and margin.robustness_text(loop.robustness)
    rows = [
        [str(k + 1), ", ".join(f"{f:.2f}" for f in frequency), ", ".join(f"{z:.4f}" for z in zeta)]
        for k, (frequency, zeta) in enumerate(
            zip(loop.frequency_hz, loop.damping_ratio, strict=True)
        )
    ]
    text = f"""Linearised at the first pose with {max(MARGIN_MODES, modes)} plant modes per link
    (the run has {modes}): gain margin {margin.margin_in_db(loop.gain_margin)}, the factor
    {"by" if grows else "to"} which the loop gain (`control.gain_factor`)
    {"can still grow" if grows else "must shrink"};
    {f"beyond it goes unstable: {loop.breaking};" if loop.breaking else ""} spectral radius
    {loop.spectral_radius:.6f}.
    {f"By frequency response: {robust}." if robust else ""}
    {_planned(run)} The lowest modes of the links with control, three of each order:"""
    return text, Rows(["order", "frequencies [Hz]", "damping ratios [1]"], rows)


def _planned(run: Run) -> str:
    """What the forces of the motion make of the margin, in sentences; "" if there are none."""
    planned = run.motion
    if planned is None or np.ptp(planned.axial_force) <= 1e-9:
        return ""
    force, low, high = planned.axial_force, planned.gain_margin.min(), planned.gain_margin.max()
    unstable = """ 0: at that instant the loop is unstable at any gain, for instance because a link
    buckles."""
    return f"""Under the axial forces of the planned motion ({force.min():.3g} to {force.max():.3g}
    N), the margin goes from {margin.margin_in_db(low)} to {margin.margin_in_db(high)}; vibration
    and impulses add to these forces.{unstable if low == 0 else ""}"""
