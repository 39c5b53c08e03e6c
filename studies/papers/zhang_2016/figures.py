"""The counterparts of the paper's figures, and the data they show.

Left column: the machine fitted to the paper's measurements, on its own move. Right column: the
nominal one, on a move as fast. Neither has a shaper: the paper's own move with its shaper leaves
the nominal machine nothing to see.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel import shaper
from studies.engine.programs import kept_jit
from studies.papers.zhang_2016.cases import ALL, OFF, ONE, TWO, PaperRuns
from studies.papers.zhang_2016.context import Machines
from studies.show import figures

#: Length of the views after the move [s].
VIEW_LENGTH = 0.2
#: They begin when the bending by the drives' own transient is over [s],
LINKS_DELAY = 0.01
#: and those of the platform's error when the drives have settled [s].
PLATFORM_DELAY = 0.075
#: Shorter amplitudes than this share of a unit are shown in the next smaller one.
LEAST = 0.1
#: Units of axes by SI unit, the larger first, with their size.
UNITS = {
    "m": (("µm", 1e-6), ("nm", 1e-9)),
    "rad": (("µrad", 1e-6), ("nrad", 1e-9)),
    "V": (("V", 1.0), ("mV", 1e-3)),
}


class Row(NamedTuple):
    """One row of a figure: a signal of both machines, with and without control."""

    name: str
    unit: str  # key of UNITS
    signals: Callable[[PaperRuns], np.ndarray]  # (n, T, rows)
    place: int  # of the row's signal among these
    delay: float | None = LINKS_DELAY  # of the view after the move [s]; None: whole motion


def _responses(machines: Machines, rows: list[Row], links: tuple[bool, ...], modes: int) -> Figure:
    figure, axes = figures.new_figure(
        len(rows), 2, 1.9 if len(rows) <= 3 else 1.4, has_shared_abscissa=False
    )
    for column, context in enumerate(machines):
        pair = context.compared(modes, OFF), context.compared(modes, links)
        text = context.runs.cases[pair[1]].links_text
        axes[0, column].set_title(f"{context.name}\ncontrolled: links {text}")
    for k, row in enumerate(rows):
        _draw_row(machines, row, links, modes, axes[k])
        if k + 1 == len(rows) or rows[k + 1].delay != row.delay:
            for ax in axes[k]:
                ax.set_xlabel("time [ms]" if row.delay is None else "time after the move [ms]")
    figures.legend_above(figure, axes[0, 0])
    return figure


def _draw_row(
    machines: Machines, row: Row, links: tuple[bool, ...], modes: int, axes: np.ndarray
) -> None:
    curves = []
    for context in machines:
        runs, off = context.runs, context.compared(modes, OFF)
        time, end = runs.record.time[0], float(runs.result.command_end[off])
        signal = row.signals(runs)[..., row.place]
        zero = 0.0 if row.delay is None else end
        shown = (time >= zero + (row.delay or 0.0)) & (time <= end + VIEW_LENGTH)
        pair = (off, context.compared(modes, links))
        curves.append((time[shown] - zero, [signal[k, shown] for k in pair]))
    largest = max(float(np.abs(pair).max()) for _, pair in curves)
    large, small = UNITS[row.unit]
    unit, size = large if largest >= LEAST * large[1] else small
    for column, (time, (without, controlled)) in enumerate(curves):
        label = f"{row.name} [{unit}]" if column == 0 else ""
        figures.comparison(1e3 * time, without / size, controlled / size, label, axes[column])


def _station(runs: PaperRuns) -> int:
    """The station nearest to three quarters of the link."""
    return int(np.argmin(np.abs(np.array(runs.study.metrics.stations) - 0.75)))


def _deflections(runs: PaperRuns) -> np.ndarray:
    return np.asarray(runs.record.chord_deflection_stations[..., _station(runs)])


def _deflection(machines: Machines, links: tuple[bool, ...], is_whole: bool = False) -> Figure:
    """Deflections after the move; before that those of the whole motion."""
    rows = [
        Row(
            name=f"link {i + 1}: deflection\nat 150 mm",
            unit="m",
            signals=_deflections,
            place=i,
            delay=delay,
        )
        for delay in ((None, LINKS_DELAY) if is_whole else (LINKS_DELAY,))
        for i in range(3)
    ]
    return _responses(machines, rows, links, 3)


def _modes_of_link_1(runs: PaperRuns) -> np.ndarray:
    return runs.record.controlled_coordinate[:, :, 0] * runs.frame.mode_shape[0, _station(runs)]


def _modes(machines: Machines) -> Figure:
    names = (f"mode {j} of link 1\nat 150 mm" for j in (1, 2, 3))
    rows = [Row(name, "m", _modes_of_link_1, j) for j, name in enumerate(names)]
    return _responses(machines, rows, ALL, 3)


def _pose_errors(runs: PaperRuns) -> np.ndarray:
    return np.asarray(runs.record.pose_error)


def _pose(
    machines: Machines, links: tuple[bool, ...], delay: float | None = PLATFORM_DELAY
) -> Figure:
    rows = [
        Row(name=f"{name} error", unit=unit, signals=_pose_errors, place=k, delay=delay)
        for k, (name, unit) in enumerate((("x", "m"), ("y", "m"), ("φ", "rad")))
    ]
    return _responses(machines, rows, links, 3)


def _voltages(runs: PaperRuns) -> np.ndarray:
    return np.asarray(runs.record.sensor_voltage[..., -1])


def _sensor(machines: Machines) -> Figure:
    rows = [Row(f"link {i + 1}: sensor\nat 150 mm", "V", _voltages, i) for i in range(3)]
    return _responses(machines, rows, ALL, 2)


def _spectra(machines: Machines, mode: int, links: tuple[bool, ...] | None) -> Figure:
    """Spectra of one mode of the three links; links None: without control only."""
    figure, axes = figures.new_figure(3, 2)
    top = 400.0 if mode == 1 else 800.0
    for column, context in enumerate(machines):
        measures, on = context.measures, context.compared(2, links or ALL)
        off, shown = context.compared(2, OFF), measures.frequency <= top
        text = "" if links is None else f"\ncontrolled: links {context.runs.cases[on].links_text}"
        axes[0, column].set_title(context.name + text)
        axes[-1, column].set_xlabel("frequency [Hz]")
        for i in range(3):
            density = measures.spectral_density[:, i, mode - 1, shown]
            figures.spectrum(
                measures.frequency[shown],
                density[off],
                None if links is None else density[on],
                float(context.runs.link_hz[i, mode - 1]),
                f"link {i + 1}: PSD of\nmode {mode} [m²/Hz]" if column == 0 else "",
                axes[i, column],
            )
            _limit_decades(axes[i, column], density[[off, on], 2:])
    figures.legend_above(figure, axes[0, 0])
    return figure


def _limit_decades(ax: Axes, density: np.ndarray) -> None:
    """Same scale with and without control, at most 12 decades."""
    top = density.max()
    ax.set_ylim(max(density.min() / 3, 1e-12 * top), 5 * top)


@kept_jit()
def _sensitivity(kinds: Any, ratio: Any, omega: Any, zeta: Any, level: Any) -> Any:
    """Sensitivity curves of several kinds of shapers, (kinds, ratio)."""

    def of(kind: Any) -> Any:
        impulses = shaper.design_shaper(kind, omega, zeta, level)
        return shaper.sensitivity_curve(impulses, ratio, omega, zeta)

    return jax.vmap(of)(kinds)


def _shapers(machines: Machines) -> Figure:
    """Sensitivity curves, and the deflection of link 1 of the nominal machine after a fast move."""
    runs = machines.nominal.runs
    figure, axes = figures.new_figure(2, 1, 2.6, has_shared_abscissa=False)
    omega, zeta = runs.frame.modal_omega[0, 0], runs.study.shaper.damping_ratio
    level = runs.study.shaper.tolerance
    ratio = np.linspace(0.5, 1.5, 401)
    kinds = {"ZV": "zv", "ZVD": "zvd", "EI (the paper's)": "ei", "two-hump EI": "ei2"}
    indices = np.array([shaper.SHAPERS.position(kind) for kind in kinds.values()])
    curves = np.asarray(_sensitivity(indices, ratio, omega, zeta, level))
    figures.sensitivity(ratio, dict(zip(kinds, curves, strict=True)), level, axes[0, 0])
    axes[0, 0].set_ylim(0, 40)
    time = runs.record.time[0]
    station = _station(runs)
    for k, kind in enumerate(("none", "ei")):
        case = machines.nominal.find("fast", kind, 3, OFF)
        begin = float(runs.result.command_end[case])
        part = (time >= begin) & (time <= begin + VIEW_LENGTH)
        deflection = runs.record.chord_deflection_stations[case, part, 0, station]
        axes[1, 0].plot(
            1e3 * (time[part] - begin),
            deflection / 1e-6,
            color=figures.SERIES[1 - k],
            linewidth=1.5 - 0.5 * k,
            label={"none": "no shaper", "ei": "EI shaper"}[kind],
        )
    axes[1, 0].set_xlabel("time after the move [ms]")
    axes[1, 0].set_ylabel("link 1: deflection\nat 150 mm [µm]")
    axes[1, 0].legend()
    return figure


#: Figures by file name; captions are in `report.html`.
PAPER_FIGURES: dict[str, tuple[str, Callable[[Machines], Figure]]] = {
    "fig03": (
        "deflection at 150 mm, three links controlled: the motion, then after the move",
        partial(_deflection, links=ALL, is_whole=True),
    ),
    "fig04": ("modes 1 to 3 of link 1 after the move, three links controlled", _modes),
    "fig05": (
        "platform error during the motion, three links controlled",
        partial(_pose, links=ALL, delay=None),
    ),
    "fig06": (
        "platform error after the move, three links controlled",
        partial(_pose, links=ALL),
    ),
    "fig07": (
        "deflection at 150 mm after the move, link 1 controlled",
        partial(_deflection, links=ONE),
    ),
    "fig08": ("platform error after the move, link 1 controlled", partial(_pose, links=ONE)),
    "fig09": (
        "deflection at 150 mm after the move, links 1, 2 controlled",
        partial(_deflection, links=TWO),
    ),
    "fig10": ("platform error after the move, links 1, 2 controlled", partial(_pose, links=TWO)),
    "fig12": ("sensor voltage at 150 mm after the move, two modes controlled", _sensor),
    "fig13": ("PSD of mode 1 without control", partial(_spectra, mode=1, links=None)),
    "fig14": ("PSD of mode 1, three links controlled", partial(_spectra, mode=1, links=ALL)),
    "fig15": ("PSD of mode 2 without control", partial(_spectra, mode=2, links=None)),
    "fig16": ("PSD of mode 2, three links controlled", partial(_spectra, mode=2, links=ALL)),
    "fig17": ("PSD of mode 1, link 1 controlled", partial(_spectra, mode=1, links=ONE)),
    "fig18": ("PSD of mode 1, links 1, 2 controlled", partial(_spectra, mode=1, links=TWO)),
    "shapers": (
        "input shapers: sensitivity, and residual vibration with EI, nominal machine",
        _shapers,
    ),
}
