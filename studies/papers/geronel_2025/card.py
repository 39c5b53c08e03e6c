"""The card: claims, tables and figure."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from studies.engine.batches import BATCH, ProgressCallback
from studies.papers.card import (
    CardResult,
    Claim,
    PaperCard,
    Verdict,
    depends_on,
    outcome_of,
)
from studies.papers.geronel_2025.comparison import (
    MODULI,
    MOVE,
    NOISE,
    SEEDS,
    SensorComparison,
    compare,
    noise_limit,
)
from studies.show import figures
from studies.show.listing import Rows
from studies.show.pages import page
from studies.show.sketch import CAPTION
from studies.show.units import span

#: Residual vibration with gauges over that with piezo sensors up to which both do equally well [1].
EQUAL = 1.1
#: Residual vibration over that without control that counts as compensated [1].
COMPENSATED = 0.5
#: Noise of a low-noise instrumentation amplifier at its input [V/Hz^1/2], and bandwidth of a
#: Butterworth filter of 2nd order for noise over its corner [1].
AMPLIFIER, NOISE_BANDWIDTH = 5e-9, 1.11

CLAIMS = (
    Claim(
        "Strain gauges as sensors and PZT patches as actuators compensate the links' flexibility.",
        "residual rms bending over that without control, gauges of the least noise [1]",
        f"at most {COMPENSATED:g} at every link frequency",
    ),
    Claim(
        "Where one takes strain gauges and another piezo sensors, either does equally well.",
        "residual rms bending with gauges over that with piezo sensors [1]",
        f"at most {EQUAL:g}",
    ),
)
LEFT_OPEN = (
    "noise of the bridges' amplifiers, and of the digital filters behind them",
    "gain of the bridges, gauge factor and number of active arms",
    "frequencies of the links, and how much the motion leaves",
    "phase that the digital filters cost at these frequencies",
    "input resistance of a charge or voltage amplifier for piezo sensors, which drains them",
)


def limits(found: SensorComparison) -> np.ndarray:
    """Noise up to which gauges do equally well, by link frequency and seed [V], (m, s)."""
    ratio = found.gauge / found.piezo[:, None]
    return np.array([[noise_limit(found.noise, one, EQUAL) for one in each.T] for each in ratio])


def judge(found: SensorComparison) -> list[Verdict]:
    """Outcomes of `CLAIMS`, in their order."""
    left = found.gauge[:, 0].mean(axis=1) / found.free
    outcomes = outcome_of(bool(np.all(left <= COMPENSATED))), _equally(found)
    ratio = (found.gauge / found.piezo[:, None]).mean(axis=-1)
    numbers = span(left, ".2g"), f"{span(ratio[:, 0], '.2f')} with the least noise"
    return [
        Verdict(claim, outcome, text)
        for claim, outcome, text in zip(CLAIMS, outcomes, numbers, strict=True)
    ]


def _equally(found: SensorComparison) -> str:
    is_equal = found.gauge <= EQUAL * found.piezo[:, None]
    if is_equal.all() or not is_equal.any():
        return outcome_of(bool(is_equal.all()))
    parts = [
        f"{1e6 * np.nanmean(one):.2g} µV at {hz:.0f} Hz"
        for one, hz in zip(limits(found), found.frequency, strict=True)
        if np.isfinite(one).any()
    ]
    quantity = "the noise at the inputs of the gauges' amplifiers and the links' frequency"
    return depends_on(quantity, f"holds below {', '.join(parts)}")


def evaluate(
    noise: tuple[float, ...], seeds: tuple[int, ...], on_progress: ProgressCallback
) -> CardResult:
    """Run the study with given noise [V] and seeds."""
    found = compare(noise, seeds, on_progress)
    verdicts, tables = judge(found), _tables(found)

    def report(folder: Path) -> str:
        return page(
            "papers/geronel_2025/report.html",
            folder,
            found.study,
            card=CARD,
            verdicts=verdicts,
            tables=tables,
            equal=EQUAL,
            gain=found.gain,
            move=MOVE,
            seeds=len(seeds),
            amplifier=AMPLIFIER,
            typical=AMPLIFIER * (NOISE_BANDWIDTH * found.study.electronics.antialias_hz) ** 0.5,
            sketch_caption=CAPTION,
        )

    return CardResult(
        study=found.study,
        verdicts=verdicts,
        tables=tables,
        figures={"noise": partial(draw, found)},
        page=report,
    )


def _tables(found: SensorComparison) -> dict[str, Rows]:
    heads = [
        "links [Hz]",
        "without control [µm]",
        "piezo sensors [µm]",
        "gauges without noise [µm]",
        "gauges do equally well up to [µV]",
        "all runs [µV]",
        "that noise over what piezo sensors leave [µV/µm]",
    ]
    rows = []
    for k, one in enumerate(limits(found)):
        is_known = np.isfinite(one).any()
        limit = 1e6 * np.nanmean(one) if is_known else np.nan
        left = 1e6 * found.piezo[k].mean()
        rows.append(
            [
                f"{found.frequency[k]:.1f}",
                f"{1e6 * found.free[k]:.3g}",
                f"{left:.3g}",
                f"{1e6 * found.quiet[k].mean():.3g}",
                f"{limit:.2g}" if is_known else "not in the range",
                span(1e6 * one[np.isfinite(one)], ".2g") if is_known else "-",
                f"{limit / left:.2g}" if is_known else "-",
            ]
        )
    runs = [
        [f"{hz:.6g}", f"{noise:.6g}", str(seed + 1), f"{found.gauge[k, n, seed]:.6g}"]
        for k, hz in enumerate(found.frequency)
        for n, noise in enumerate(found.noise)
        for seed in range(found.gauge.shape[-1])
    ]
    return {
        "limits": Rows(heads, rows),
        "runs": Rows(["links [Hz]", "noise [V]", "run", "residual rms [m]"], runs),
    }


def draw(found: SensorComparison) -> Figure:
    """Residual vibration with gauges over that with piezo sensors, by noise and link frequency."""
    figure, ax = figures.one_panel(3.0)
    ratio = (found.gauge / found.piezo[:, None]).mean(axis=-1)
    for k, hz in enumerate(found.frequency):
        color = figures.SERIES[k % len(figures.SERIES)]
        ax.plot(1e6 * found.noise, ratio[k], "o-", color=color, markersize=3, label=f"{hz:.0f} Hz")
    ax.axhline(EQUAL, color="#888888", linewidth=0.8, linestyle=":")
    for which in "xy":
        figures.log_scale(ax, which)
    ax.set_xlabel("rms noise at the inputs of the gauges' amplifiers [µV]")
    ax.set_ylabel("residual, gauges over piezo [1]")
    figures.legend_beside(ax)
    return figure


CARD = PaperCard(
    name="geronel_2025",
    title="do strain gauges do as well as piezo sensors?",
    source=(
        "R. S. Geronel, G. C. de Oliveira, G. K. Rodrigues and M. M. da Silva, Active vibration "
        "control of a flexible parallel manipulator 3RRR, Robotica, 2025"
    ),
    read=(
        "Read: the abstract. It does not compare sensors; the second claim is what follows if its "
        "result and those of papers with piezo sensors stand side by side. Not read: the rest."
    ),
    claims=CLAIMS,
    left_open=LEFT_OPEN,
    work=float(-(-len(MODULI) * (1 + (2 + len(NOISE)) * len(SEEDS)) // BATCH)),
    run=partial(evaluate, NOISE, SEEDS),
)
