"""Rows of the tables in the paper's report.

Our numbers come from the runs; the paper's are constants. In the comparing tables, each row is one
number of the paper, and COLUMNS say whose it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from studies.papers.zhang_2016.cases import (
    ALL,
    COMPARED,
    EXPERIMENT_RATIOS,
    MOVES,
    OFF,
    PAPER_RATIOS,
)
from studies.papers.zhang_2016.context import PLACES, Context, Machines, change, residual, residuals
from studies.show.units import count_text
from studies.study.labels import describe
from studies.study.margin import margin_text
from studies.study.printed import TABLE_1

#: Columns of every comparison with the paper.
COLUMNS = ("", "paper", "fitted machine", "nominal machine")


#: Frequencies of a link, measured [Hz].
FREQUENCIES = (92.5, 241.3)


#: Change of the PSD of mode 2 with three links controlled [%].
MODE_2 = (-48.33, -49.62, -52.21)


#: What the paper says of the platform's error after the command, by place.
PLATFORM = ("damped fast", "by more than -50 %", "limited effect")


def _row(
    name: str, paper: str, machines: Machines, number: Callable[..., str], *arguments: Any
) -> list[str]:
    """A row whose numbers are `number(context, *given)`."""
    return [name, paper, *(number(context, *arguments) for context in machines)]


def machine_rows(machines: Machines) -> list[list[str]]:
    """What the machines are, and how they move."""

    def cells(context: Context) -> list[str]:
        study = context.runs.study
        gains = study.control.gain_factor * np.array(study.control.velocity_gain)
        n_moves = len(study.motion.waypoints) - 1
        return [
            _join_numbers(study.each_link(study.link.youngs_modulus) / 1e9),
            f"{study.link.joint_inertia_c:.3g}",
            _join_numbers(np.atleast_1d(study.link.damping_ratio), ".2g"),
            f"{study.drive.kp:.3g}, {study.drive.kd:.3g}",
            f"{study.link.modes}, {study.link.basis}",
            study.control.basis,
            _join_numbers(gains, ".2g"),
            f"{count_text(n_moves, 'move')} of 10 mm in {MOVES[COMPARED[0]]:g} s, no shaper",
            str(len(context.runs.cases)),
        ]

    names = (
        "Young's modulus, links 1, 2, 3 [GPa]",
        "inertia at the platform's joints [kg m²]",
        "damping ratio, by mode (the last for all higher ones)",
        "slider drive, Kp [N/m], Kd [N s/m]",
        "modes per link, basis",
        "controller's basis",
        "gains of mode 1, links 1, 2, 3 [N s/m]",
        "compared motion",
        "runs",
    )
    return [list(row) for row in zip(names, *(cells(x) for x in machines), strict=True)]


def frequency_rows(machines: Machines) -> list[list[str]]:
    """Frequencies of the links between held ends."""

    def number(context: Context, mode: int) -> str:
        return _join_numbers(context.runs.link_hz[:, mode], ".1f")

    return [
        _row(f"mode {k + 1}, links 1, 2, 3 [Hz]", f"{hz:g}", machines, number, k)
        for k, hz in enumerate(FREQUENCIES)
    ]


def ratio_rows(machines: Machines) -> list[list[str]]:
    """Ratios (24) of modes 2 and 3, links 1, 2, 3."""
    printed = (
        ("(26), simulation: mode 2", PAPER_RATIOS, 1),
        ("(27), experiment: mode 2", EXPERIMENT_RATIOS, 1),
        ("(26), simulation: mode 3", PAPER_RATIOS, 2),
    )

    def number(context: Context, mode: int) -> str:
        return _join_numbers(energy_ratio(context)[:, mode])

    return [
        _row(
            f"{name}, links 1, 2, 3",
            _join_numbers([link[mode] for link in rows]),
            machines,
            number,
            mode,
        )
        for name, rows, mode in printed
    ]


def energy_ratio(context: Context) -> np.ndarray:
    """Ratios (24) of the compared move without control, (3, C)."""
    off = context.compared(3, OFF)
    return np.asarray(context.runs.result.metrics.energy_ratio[off])


def amplitude_change(context: Context, links: tuple[bool, ...], mode: int) -> np.ndarray:
    """Change of a mode's spectral peak, as an amplitude, on the compared move [%], (3,)."""
    peak = context.measures.spectral_peak[:, :, mode - 1]
    off, on = context.compared(2, OFF), context.compared(2, links)
    return 100 * (np.sqrt(peak[on] / peak[off]) - 1)


def printed_changes() -> list[tuple[str, tuple[bool, ...], int, np.ndarray]]:
    """Changes that the paper prints [%], (3,): heading, controlled links, mode."""
    table = np.array(TABLE_1)
    percent = 100 * (table[:, 1:] / table[:, :1] - 1)
    table_1 = [
        (f"mode 1, {text}", links, 1, percent[:, k]) for k, (links, text) in enumerate(PLACES)
    ]
    return [*table_1, ("mode 2, three links", ALL, 2, np.array(MODE_2))]


def table_1_rows(machines: Machines) -> list[list[str]]:
    """Changes of the spectral peaks by control, links 1 to 3; last those of mode 2."""

    def number(context: Context, links: tuple[bool, ...], mode: int, link: int) -> str:
        return f"{amplitude_change(context, links, mode)[link]:+.1f} %"

    return [
        _row(f"{text}: link {i + 1}", f"{printed[i]:+.2f} %", machines, number, links, mode, i)
        for text, links, mode, printed in printed_changes()
        for i in range(3)
    ]


def settling_rows(machines: Machines) -> list[list[str]]:
    """Settling times and residual vibration of links 1, 2, 3, with and without control."""

    def time(context: Context, links: tuple[bool, ...]) -> str:
        return _join_numbers(1e3 * context.measures.settling[context.compared(2, links)], ".0f")

    def rms(context: Context, links: tuple[bool, ...]) -> str:
        return residuals(context, context.measures.residual[context.compared(2, links)])

    return [
        _row("settling time, no control [ms]", "about 140", machines, time, OFF),
        _row("settling time, three links [ms]", "70", machines, time, ALL),
        _row("residual rms, no control [µm]", "not given", machines, rms, OFF),
        _row("residual rms, three links [µm]", "not given", machines, rms, ALL),
    ]


def platform_rows(machines: Machines) -> list[list[str]]:
    """Platform errors of the residual window without control, and their change by control."""

    def error(context: Context, links: tuple[bool, ...]) -> np.ndarray:
        return np.asarray(context.runs.result.metrics.pose_error_rms[context.compared(3, links)])

    def without(context: Context) -> str:
        return _join_numbers(1e9 * error(context, OFF))

    def changes(context: Context, links: tuple[bool, ...]) -> str:
        pairs = zip(error(context, links), error(context, OFF), strict=True)
        return ", ".join(change(x, y) for x, y in pairs)

    return [
        _row("no control: x [nm], y [nm], φ [nrad]", "not given", machines, without),
        *(
            _row(f"{text}: x, y, φ", paper, machines, changes, links)
            for (links, text), paper in zip(PLACES, PLATFORM, strict=True)
        ),
    ]


def motion_rows(context: Context) -> list[list[str]]:
    """What each motion of a machine leaves, with and without control, links 1, 2, 3."""

    def cells(k: int) -> list[str]:
        metrics = context.runs.result.metrics
        return [
            _join_numbers(1e6 * metrics.structural_peak[k].max(axis=-1)),
            residuals(context, context.measures.residual[k]),
            _join_numbers(1e3 * metrics.settling_time[k], ".0f"),
            _join_numbers(1e3 * context.measures.settling[k], ".0f"),
        ]

    return [
        [f"{text}: {control}", *cells(k)]
        for off, on, text in context.pairs()
        for k, control in ((off, "no control"), (on, "three links"))
    ]


def design_rows(context: Context) -> list[list[str]]:
    """Controlled cases outside the grid, and those whose loop was judged."""
    runs, rows = context.runs, []
    for k, case in enumerate(runs.cases):
        if not case.is_controlled or not (case.is_extra or case.name in runs.loops):
            continue
        loop = runs.loops.get(case.name)
        margin, zeta = "not judged", "not judged"
        if loop is not None:
            margin = f"{margin_text(loop.gain_margin, 3)}, {loop.spectral_radius:.5f}"
            zeta = ", ".join(f"{z:.3f}" for z in loop.damping_ratio.min(axis=1))
        rows.append(
            [
                case.name,
                case.feedback,
                case.estimator,
                f"{case.gain_factor:g}",
                case.ratio_from,
                describe(int(runs.status[k])),
                margin,
                zeta,
                context.peak_change(k, mode=1),
                residual(context, *_worst(context.measures.residual[k])),
                f"{runs.result.metrics.peak_voltage[k].max():.3g}",
            ]
        )
    return rows


def _worst(values: np.ndarray) -> tuple[float, int]:
    """The largest value and its place."""
    return float(values.max()), int(values.argmax())


def _join_numbers(values: np.ndarray | list[float], digits: str = ".3g") -> str:
    return ", ".join(f"{value:{digits}}" for value in values)
