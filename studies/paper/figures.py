"""The counterparts of the paper's figures, and the data they show.

Left column: the paper's move with its EI shaper. Right column: the faster move without shaper,
which leaves vibration for the controller.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmodel import shaper
from studies.paper.cases import ALL, OFF, ONE, TWO, PaperRuns
from studies.paper.measures import Measures
from studies.show import figures

COLUMNS = (("paper", "ei"), ("fast", "none"))
TITLES = (r"paper's move, $t_f$ = 0.1 s, EI shaper", r"faster move, $t_f$ = 0.05 s, no shaper")
#: Duration of the magnified views, from the end of the command [s].
VIEW_LENGTH = 0.2
#: They are scaled to the vibration this long after the command, when the drive's transient is
#: over [s].
SCALE_DELAY = 0.05


#: (uncontrolled, controlled) case of each column.
Pairs = list[tuple[int, int]]


def draw_figure(
    name: str, runs: PaperRuns, measures: Measures, folder: Path, has_pdf: bool
) -> None:
    """Write one of PAPER_FIGURES into a folder."""
    with figures.styled():
        figures.save(PAPER_FIGURES[name](runs, measures), folder, name, has_pdf)


def _pairs(runs: PaperRuns, links: tuple[bool, ...], modes: int) -> Pairs:
    rows = []
    for move, kind in COLUMNS:
        wanted: dict[str, Any] = {"move": move, "shaper": kind, "modes": modes}
        rows.append((runs.where(**wanted, links=OFF), runs.where(**wanted, links=links)))
    return rows


def _responses(
    runs: PaperRuns, pairs: Pairs, signal: np.ndarray, labels: list[str], unit: float
) -> tuple[Figure, np.ndarray]:
    """Rows of comparisons of signal (n, T, rows), in a unit of this many SI units."""
    figure, axes = figures.new_figure(len(labels), 2)
    time = runs.record.time[0]
    for column, (off, on) in enumerate(pairs):
        title = TITLES[column] + f"\ncontrolled: links {runs.cases[on].links_text}"
        axes[0, column].set_title(title)
        axes[-1, column].set_xlabel("time [s]")
        for row, label in enumerate(labels):
            figures.comparison(
                time,
                signal[off, :, row] / unit,
                signal[on, :, row] / unit,
                label if column == 0 else "",
                axes[row, column],
            )
    figures.legend_above(figure, axes[0, 0])
    return figure, axes


def _with_views(
    runs: PaperRuns, pairs: Pairs, signal: np.ndarray, labels: list[str], unit: float
) -> Figure:
    """`_responses` with a magnified view after the command in each of the axes."""
    figure, axes = _responses(runs, pairs, signal, labels, unit)
    time = runs.record.time[0]
    for column, (off, on) in enumerate(pairs):
        begin = float(runs.result.command_end[off])
        for row in range(len(labels)):
            limit = 1.5 * _left_over(runs, (off, on), signal[..., row]) / unit
            figures.magnified(
                time,
                signal[off, :, row] / unit,
                signal[on, :, row] / unit,
                (begin, begin + VIEW_LENGTH),
                limit,
                axes[row, column],
            )
    return figure


def _left_over(runs: PaperRuns, pair: tuple[int, int], signal: np.ndarray) -> float:
    """Peak of a signal (n, T) of two cases from SCALE_DELAY after the command on."""
    time = runs.record.time[0]
    begin = float(runs.result.command_end[pair[0]]) + SCALE_DELAY
    return max(float(np.abs(signal[case, time >= begin]).max()) for case in pair)


def _deflection(runs: PaperRuns, measures: Measures, links: tuple[bool, ...]) -> Figure:
    signal = runs.record.chord_deflection_stations[..., _station(runs)]
    labels = [f"link {i}: deflection\nat 150 mm [µm]" for i in (1, 2, 3)]
    return _with_views(runs, _pairs(runs, links, 3), signal, labels, 1e-6)


def _station(runs: PaperRuns) -> int:
    """The station nearest to three quarters of the link."""
    return int(np.argmin(np.abs(np.array(runs.study.metrics.stations) - 0.75)))


def _modes(runs: PaperRuns, measures: Measures) -> Figure:
    q = runs.record.controlled_coordinate[:, :, 0]
    signal = q * runs.frame.mode_shape[0, _station(runs)]
    labels = [f"mode {j} of link 1\nat 150 mm [µm]" for j in (1, 2, 3)]
    return _with_views(runs, _pairs(runs, ALL, 3), signal, labels, 1e-6)


_POSE_LABELS = ["x error [µm]", "y error [µm]", "φ error [µrad]"]


def _pose(runs: PaperRuns, measures: Measures) -> Figure:
    signal = runs.record.pose_error
    return _responses(runs, _pairs(runs, ALL, 3), signal, _POSE_LABELS, 1e-6)[0]


def _pose_after(runs: PaperRuns, measures: Measures, links: tuple[bool, ...]) -> Figure:
    """Pose after the command, scaled to the vibration left once the drive has settled."""
    signal = runs.record.pose_error
    pairs = _pairs(runs, links, 3)
    labels = [label.replace("[µ", "[n") for label in _POSE_LABELS]
    figure, axes = _responses(runs, pairs, signal, labels, 1e-9)
    for column, pair in enumerate(pairs):
        begin = float(runs.result.command_end[pair[0]])
        for row in range(3):
            top = 1.3 * _left_over(runs, pair, signal[..., row]) / 1e-9
            axes[row, column].set_ylim(-top, top)
            axes[row, column].set_xlim(begin, begin + 2 * VIEW_LENGTH)
    return figure


def _sensor(runs: PaperRuns, measures: Measures) -> Figure:
    signal = runs.record.sensor_voltage[..., -1]
    labels = [f"link {i}: sensor at\n150 mm [V]" for i in (1, 2, 3)]
    return _with_views(runs, _pairs(runs, ALL, 2), signal, labels, 1.0)


def _spectra(
    runs: PaperRuns, measures: Measures, mode: int, links: tuple[bool, ...] | None
) -> Figure:
    """Spectra of one mode of the three links; links None: without control only."""
    figure, axes = figures.new_figure(3, 2)
    top = 400.0 if mode == 1 else 800.0
    shown = measures.frequency <= top
    for column, (off, on) in enumerate(_pairs(runs, links or ALL, 2)):
        axes[0, column].set_title(TITLES[column])
        axes[-1, column].set_xlabel("frequency [Hz]")
        for i in range(3):
            density = measures.spectral_density[:, i, mode - 1, shown]
            figures.spectrum(
                measures.frequency[shown],
                density[off],
                None if links is None else density[on],
                float(runs.frame.modal_omega[i, mode - 1] / (2 * np.pi)),
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


@jax.jit
def _sensitivity(kinds: Any, ratio: Any, omega: Any, zeta: Any, level: Any) -> Any:
    """Sensitivity curves of several kinds of shapers, (kinds, ratio)."""

    def of(kind: Any) -> Any:
        impulses = shaper.design_shaper(kind, omega, zeta, level)
        return shaper.sensitivity_curve(impulses, ratio, omega, zeta)

    return jax.vmap(of)(kinds)


def _shapers(runs: PaperRuns, measures: Measures) -> Figure:
    """Sensitivity curves, and the deflection of link 1 after the faster move."""
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
        case = runs.where(move="fast", shaper=kind, modes=3, links=OFF)
        begin = float(runs.result.command_end[case])
        part = (time >= begin) & (time <= begin + VIEW_LENGTH)
        deflection = runs.record.chord_deflection_stations[case, part, 0, station]
        axes[1, 0].plot(
            time[part] - begin,
            deflection / 1e-6,
            color=figures.SERIES[1 - k],
            linewidth=1.5 - 0.5 * k,
            label={"none": "no shaper", "ei": "EI shaper"}[kind],
        )
    axes[1, 0].set_xlabel("time after the command [s]")
    axes[1, 0].set_ylabel("link 1: deflection\nat 150 mm [µm]")
    axes[1, 0].legend()
    return figure


#: Figures by file name; captions are in `report.md`.
PAPER_FIGURES: dict[str, Callable[[PaperRuns, Measures], Figure]] = {
    "fig03": partial(_deflection, links=ALL),
    "fig04": _modes,
    "fig05": _pose,
    "fig06": partial(_pose_after, links=ALL),
    "fig07": partial(_deflection, links=ONE),
    "fig08": partial(_pose_after, links=ONE),
    "fig09": partial(_deflection, links=TWO),
    "fig10": partial(_pose_after, links=TWO),
    "fig12": _sensor,
    "fig13": partial(_spectra, mode=1, links=None),
    "fig14": partial(_spectra, mode=1, links=ALL),
    "fig15": partial(_spectra, mode=2, links=None),
    "fig16": partial(_spectra, mode=2, links=ALL),
    "fig17": partial(_spectra, mode=1, links=ONE),
    "fig18": partial(_spectra, mode=1, links=TWO),
    "shapers": _shapers,
}
