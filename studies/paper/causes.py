"""Sections of the paper's report on the platform, on other designs, and on why numbers differ."""

from __future__ import annotations

import numpy as np

from studies.paper.cases import HIGH_DAMPING, MOVES, OFF, TWO
from studies.paper.context import PLACES, Context, change, move_text, settings
from studies.show.markdown import table
from studies.study.labels import describe


def platform(context: Context) -> list[str]:
    runs, measures = context.runs, context.measures
    rows, verdicts = [], []
    for move, shaper in settings():
        off = context.find(move, shaper, 3, OFF)
        reference, whole = measures.late_pose_error[off], runs.result.metrics.pose_error_rms[off]
        errors = [f"{1e9 * x:.3g}" for x in (*reference, *whole)]
        rows.append([f"{move_text(move, shaper)}: no control", *errors])
        for links, text in PLACES:
            k = context.find(move, shaper, 3, links)
            late, both = measures.late_pose_error[k], runs.result.metrics.pose_error_rms[k]
            cells = [
                f"{1e9 * x:.3g} ({change(x, y)})"
                for x, y in zip((*late, *both), (*reference, *whole), strict=True)
            ]
            if np.all(context.measures.late_deflection[off] < runs.frame.adc_step):
                cells[:3] = [f"{cell} †" for cell in cells[:3]]
            rows.append([f"{move_text(move, shaper)}: {text}", *cells])
            if links == TWO:
                held = [n for n, x, y in zip("xyφ", late, reference, strict=True) if x < 0.5 * y]
                verdicts.append(f"{move_text(move, shaper)}: {', '.join(held) or 'none'}")
    axes = ("x [nm]", "y [nm]", "φ [nrad]")
    return [
        "## Platform error after the command",
        "",
        "Paper: with two links controlled the residual errors in x, y and φ fall by more than 50 "
        "%. Rms against the shaped command; first the late window, then the whole residual window. "
        "†: no link's vibration reaches one ADC step even without control.",
        "",
        *table(("", *(f"late {a}" for a in axes), *(f"whole {a}" for a in axes)), rows),
        "",
        "Directions in which two controlled links take away more than half in the late window: "
        + "; ".join(verdicts)
        + ". "
        + _platform_words(context),
    ]


def _platform_words(context: Context) -> str:
    measures, runs = context.measures, context.runs
    off, two = (context.find("fast", "none", 3, links) for links in (OFF, TWO))
    whole = runs.result.metrics.pose_error_rms
    factor = whole[off, 0] / measures.late_pose_error[off, 0]
    words = (
        f"On the fast unshaped move the x error of the whole window is {factor:.3g} times that of "
        f"the late one and changes by {change(whole[two, 0], whole[off, 0])}."
    )
    if factor > 10:
        words += " It is the slider drive's own decay, which no piezo control changes."
    grown = [
        f"{n} {change(x, y)}"
        for n, x, y in zip(
            "xyφ", measures.late_pose_error[two], measures.late_pose_error[off], strict=True
        )
        if x > y
    ]
    if grown:
        words += (
            f" In the late window it makes an error grow ({', '.join(grown)}): without control the "
            "links' forces on the platform cancel in part, and damping only some of them ends that."
        )
    largest = 1e9 * measures.late_pose_error[[off, two]].max(axis=0)
    return words + (
        f" The largest late errors of these two runs are {largest[0]:.3g} nm, {largest[1]:.3g} nm "
        f"and {largest[2]:.3g} nrad."
    )


def variants(context: Context) -> list[str]:
    runs, measures = context.runs, context.measures
    chosen = [
        k
        for k, case in enumerate(runs.cases)
        if case.is_controlled and (case.is_extra or case.name in runs.loops)
    ]
    rows = []
    for k in chosen:
        case = runs.cases[k]
        loop = runs.loops.get(case.name)
        margin, zeta = "not judged", "not judged"
        if loop is not None:
            margin = f"{loop.gain_margin:.3g}, {loop.spectral_radius:.5f}"
            zeta = ", ".join(f"{z:.3f}" for z in loop.damping_ratio.min(axis=1))
        rows.append(
            [
                f"`{case.name}`",
                case.feedback,
                case.estimator,
                f"{case.gain_factor:g}",
                case.ratio_from,
                describe(int(runs.status[k])),
                margin,
                zeta,
                ", ".join(context.drop(k, mode=1)),
                f"{1e6 * measures.late_deflection[k].max():.3g}",
                f"{runs.result.metrics.peak_voltage[k].max():.3g}",
            ]
        )
    return [
        "## Other designs: three links, three modes, fast move without shaper",
        "",
        *table(
            (
                "case",
                "feedback",
                "velocity",
                "factor",
                "ratios",
                "status",
                "gain margin, spectral radius",
                "damping of modes 1, 2, 3",
                "PSD peak of mode 1",
                "late rms [µm]",
                "peak voltage [V]",
            ),
            rows,
        ),
        "",
        "Margin, radius and damping are those of the linearised sampled loop at home. A loop that "
        "it finds unstable counts as unstable even where saturation keeps the run bounded; cases "
        "that are not judged have the status of their run.",
    ]


def differences(context: Context) -> list[str]:
    runs, measures = context.runs, context.measures
    slow, quick = (context.find(move, "none", 3, OFF) for move in ("paper", "fast"))
    bent = 1e6 * runs.result.metrics.structural_peak.max(axis=(1, 2))
    late = 1e6 * measures.late_deflection.max(axis=1)
    by_shaper = {
        shaper: np.array([late[context.find(move, shaper, 3, OFF)] for move in MOVES])
        for shaper in ("none", "ei")
    }
    shaped = [f"{factor:.3g}" for factor in by_shaper["none"] / by_shaper["ei"]]
    return [
        "## Why the numbers differ",
        "",
        "- **The smooth move excites little.** The links bend by up to "
        f"{bent[slow]:.3g} µm on the paper's move, but vibrate late with {late[slow]:.3g} µm rms "
        f"only; on the faster one {bent[quick]:.3g} µm and {late[quick]:.3g} µm. The EI shaper "
        f"alone divides the late vibration by {' and '.join(shaped)}. Vibration as large as in the "
        "paper's figures needs a disturbance or a drive of higher bandwidth than the paper "
        "describes.",
        *_gain_words(context),
        "- **Gain ratios** depend on what excites the links; see the first table.",
        "- **Units.** The paper gives no unit for its PSD, so only percentages compare. It prints "
        "gains in N s/m, its (20) to (23) make 1/s; N s/m is used here.",
        f"- **Structural damping** is not in the paper. {runs.study.link.damping_ratio:g} is "
        f"assumed; the rows with {HIGH_DAMPING:g} show how much of settling it decides.",
        "- **Platform.** The paper blames the residual error on the links alone; here the drive "
        "decides the first part of it. Its gains are not in the paper either.",
        "- **Coupling.** Links act on each other through the platform's motion; the matrix that "
        "the paper holds responsible has no terms between links. Hence uncontrolled links gain or "
        "lose with the move, not in a fixed direction.",
        "- **Not in the paper** and assumed: Young's modulus of the links, inertia of the "
        "platform, drive, converters, filters, delay.",
        *_loop_words(context),
    ]


def _gain_words(context: Context) -> list[str]:
    weak = context.named("weak")
    if weak is None:
        return []
    factor = context.runs.cases[weak].gain_factor
    gain = factor * context.runs.study.control.velocity_gain[0]
    return [
        f"- **The gains are large.** A first gain of {gain:.2g} N s/m (`weak`, factor {factor:g}) "
        f"changes the peak of mode 1 by {', '.join(context.drop(weak, mode=1))}; the paper prints "
        "-45 to -42 % for gains a hundred times that, with units that leave room for such a factor."
    ]


def _loop_words(context: Context) -> list[str]:
    runs, lines = context.runs, []
    k = context.named("difference")
    if k is not None and "difference" in runs.loops:
        lines.append(
            "- **Velocity estimate.** The same gains with a filtered difference instead of the "
            f"modal phase filter: {describe(int(runs.status[k]))}, gain margin "
            f"{runs.loops['difference'].gain_margin:.3g}, "
            f"{runs.result.metrics.peak_voltage[k].max():.3g} V at the actuators: modes beyond the "
            "controlled ones decide, and a model with few modes does not show them."
        )
    k = context.named("ideal")
    if k is not None:
        peak = 1e6 * context.measures.late_deflection[k].max()
        lines.append(
            "- **Ideal feedback**, as in the paper's simulation, has neither delay nor converter: "
            f"late vibration {peak:.2g} µm."
        )
    return lines
