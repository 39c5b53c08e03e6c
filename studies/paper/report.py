"""The report of the paper's study: the paper's numbers and ours side by side, and why they differ.

Numbers of ours, and what is said of them, come from the runs; the paper's stand here as constants.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.engine.frame import EARLY_PART
from studies.paper.cases import ALL, MOVES, OFF, PAPER_RATIOS, PaperRuns
from studies.paper.causes import differences, platform, variants
from studies.paper.context import (
    PLACES,
    Context,
    change,
    move_text,
    residual,
    settings,
)
from studies.paper.figures import PAPER_FIGURES
from studies.paper.measures import PEAK_SPAN, SETTLED, Measures, middle_station
from studies.show.markdown import opening, picture, table
from studies.show.sketch import CAPTION
from studies.show.units import span
from studies.study.consistency import each_link
from studies.study.printed import TABLE_1

#: What everything here is held against.
CITATION = (
    "Q. Zhang et al., Active Vibration Control and Coupled Vibration Analysis of a Parallel "
    "Manipulator with Multiple Flexible Links, Shock and Vibration, 2016, article 7474085, "
    "[doi:10.1155/2016/7474085](https://doi.org/10.1155/2016/7474085)"
)


#: (27), experiment, two modes.
EXPERIMENT_RATIOS = ((1.0, 0.312), (1.0, 0.412), (1.0, 0.355))


#: Change of the PSD of mode 2 with three links controlled [%].
MODE_2 = (-48.33, -49.62, -52.21)


#: Settling of the residual vibration with control, which is said to be half of that without [s].
PAPER_SETTLING = 0.07


def report(runs: PaperRuns, measures: Measures) -> str:
    """Markdown text; its figures are PAPER_FIGURES."""
    context = Context(runs, measures)
    sections: tuple[tuple[Any, tuple[str, ...]], ...] = (
        (_head, ()),
        (_ratios, ("fig04",)),
        (_table_1, ("fig13", "fig14", "fig17", "fig18")),
        (_mode_2, ("fig15", "fig16")),
        (_settling, ("fig03", "fig07", "fig09", "fig12")),
        (platform, ("fig05", "fig06", "fig08", "fig10")),
        (variants, ("shapers",)),
        (differences, ()),
    )
    return "\n".join(
        line for section, names in sections for line in (*section(context), "", *_figures(names))
    )


def _head(context: Context) -> list[str]:
    study, runs = context.runs.study, context.runs
    loop, control = study.electronics, study.control
    bad = [c.name for c, code in zip(runs.cases, runs.status, strict=True) if code]
    note = f"Not ok: {', '.join(bad)}." if bad else "All of them ended with status ok."
    moves = ", ".join(f"{name} ({time:g} s a move)" for name, time in MOVES.items())
    return [
        "# The paper's study: its numbers and ours",
        "",
        *opening(
            f"what of sections 4 and 5 of {CITATION} comes out of this model, and where not.",
            _came_out(context),
            "`studies atlas` for who helps whom, `studies sweep placement` and `studies tune tune` "
            "for better designs than the paper's.",
        ),
        picture("machine.png", CAPTION),
        "",
        "## The runs",
        "",
        f"{len(runs.cases)} runs of {study.run.duration:g} s: {moves}; with the EI shaper and "
        "without; no control, three links, the first two, the first only; three controlled modes "
        "(the paper's section 4) and two (section 5, where the comparison cases control mode 1 "
        f"only). {note}",
        "",
        f"Plant: {study.link.modes} modes per link ({study.link.basis}), structural damping "
        f"{study.link.first_damping:g}, E = {span(each_link(study.link.youngs_modulus) / 1e9)} "
        f"GPa, slider drive Kp = {study.drive.kp:g} N/m, Kd = {study.drive.kd:g} N s/m. Control: "
        "sampled at "
        f"{loop.sample_rate_hz / 1e3:g} kHz, {loop.adc_bits} bit, one sample of delay, velocity by "
        f"{loop.estimator}, gains {', '.join(f'{k:g}' for k in control.velocity_gain)} N s/m of "
        f"the paper times {control.gain_factor:g}. One ADC step is "
        f"{span(1e6 * context.runs.frame.adc_step)} µm of mode 1; a residual smaller than that is "
        "marked †: the controller hardly sees it, and a percentage of it says nothing.",
        "",
        "*Late* window: the residual window (from the end of the shaped command, "
        f"{study.metrics.residual_length:g} s) without its first "
        f"{EARLY_PART * study.metrics.residual_length:g} s, in which the slider drive itself still "
        "settles. Data: `paper.h5`.",
        "",
        "Figures: `fig03` is the counterpart of the paper's figure 3, and so on. Of two columns "
        "the left one is the paper's move with its EI shaper, the right one the faster move "
        "without shaper. Each figure is also a PDF of its name.",
    ]


def _ratios(context: Context) -> list[str]:
    def cells(rows: Any) -> list[str]:
        return [" : ".join(f"{x:.3g}" for x in row) for row in rows]

    ours = context.runs.energy_ratio
    second = np.array([row.ratio[:, 1] for row in ours])
    paper = np.array([row[1] for row in (*PAPER_RATIOS, *EXPERIMENT_RATIOS)])
    return [
        "## Gain ratios of efficient modal control: (26) and (27)",
        "",
        "Ours by (24) from the time mean of E = ω²q² + q'² while moving, without control. A "
        "controlled run takes the ratios of its own uncontrolled counterpart (same move, same "
        "shaper).",
        "",
        *table(
            ("from", "link 1", "link 2", "link 3"),
            [
                ["paper (26), simulation", *cells(PAPER_RATIOS)],
                ["paper (27), experiment", *cells(EXPERIMENT_RATIOS)],
                *(
                    [f"ours, {move_text(row.move, row.shaper)}, {row.basis}", *cells(row.ratio)]
                    for row in ours
                ),
            ],
        ),
        "",
        f"Ours for mode 2: {span(second)}; the paper's: {span(paper)}, "
        f"{paper.min() / second.max():.3g} times as much or more. "
        "The ratios are no property of the links: they say what excites them. A smooth move bends "
        "the links quasi-statically, and the energy in mode j then falls with a high power of its "
        "frequency; a large share for mode 2 needs a drive or a disturbance with bandwidth up to "
        "that mode. Nothing was tuned towards the paper's values. The coordinates matter too: the "
        "paper's pinned-free modes are not decoupled on the assembled machine, so mode 1's motion "
        "appears in its modes 2 and 3.",
    ]


def _table_1(context: Context) -> list[str]:
    places = ("uncontrolled", *(text for _, text in PLACES))
    rows = [
        [f"paper, link {i + 1} (no unit)", f"{values[0]:.2f}"]
        + [f"{v:.2f} ({100 * (v / values[0] - 1):+.2f} %)" for v in values[1:]]
        + ["not given"]
        for i, values in enumerate(TABLE_1)
    ]
    for move, shaper in settings():
        off = context.find(move, shaper, 2, OFF)
        for i in range(3):
            reference = context.measures.spectral_peak[off, i, 0]
            row = [f"ours, {move_text(move, shaper)}: link {i + 1}", f"{reference:.3g}"]
            for links, _ in PLACES:
                on = context.measures.spectral_peak[context.find(move, shaper, 2, links), i, 0]
                row.append(f"{on:.3g} ({change(on, reference)})")
            rows.append([*row, residual(context, off, i)])
    return [
        "## Table 1: peak of the power spectral density of mode 1",
        "",
        f"Ours in m²/Hz: one-sided Hann periodogram of the whole run, largest value within "
        f"±{100 * PEAK_SPAN:g} % of the mode's frequency. Three links: two modes controlled; the "
        "other two columns: mode 1 only, as in the paper.",
        "",
        *table(("", *places, "late rms without control [µm]"), rows),
        "",
        *_table_1_words(context),
    ]


def _table_1_words(context: Context) -> list[str]:
    """What the faster unshaped move shows, where there is vibration to reduce."""
    off = context.measures.spectral_peak[context.find("fast", "none", 2, OFF), :, 0]
    controlled: list[float] = []
    others: list[float] = []
    for links, _ in PLACES:
        on = context.measures.spectral_peak[context.find("fast", "none", 2, links), :, 0]
        for i in range(3):
            (controlled if links[i] else others).append(100 * (on[i] / off[i] - 1))
    return [
        f"Fast move without shaper: the peak of a controlled link changes by "
        f"{span(controlled, '+.1f')} %, that of an uncontrolled one by {span(others, '+.1f')} % "
        "(the paper: -45 to -42 % and -1.8 to +0.9 %). A well damped mode has no peak left: what "
        "is compared then is the background of the motion's own spectrum, so the reduction of "
        "the mode itself is at least this much.",
        "",
        "The paper's own columns are not like for like: with three links it controls two modes, in "
        "the other cases one; and link 2 falls more with two links controlled (43.23 %) than with "
        "three (42.92 %), against the sentence that more controlled links do better.",
    ]


def _mode_2(context: Context) -> list[str]:
    rows = [["paper, three links", *(f"{value:+.2f} %" for value in MODE_2)]]
    for move, shaper in settings():
        off = context.measures.spectral_peak[context.find(move, shaper, 2, OFF), :, 1]
        on = context.measures.spectral_peak[context.find(move, shaper, 2, ALL), :, 1]
        cells = [f"{a:.3g} → {b:.3g} m²/Hz ({change(b, a)})" for a, b in zip(off, on, strict=True)]
        rows.append([f"ours, {move_text(move, shaper)}", *cells])
    peaks = context.measures.spectral_peak[context.find("fast", "none", 2, OFF)]
    ratio = context.runs.ratio[context.find("fast", "none", 2, ALL), :, 1]
    lines = [
        "## Power spectral density of mode 2, three links controlled",
        "",
        *table(("", "link 1", "link 2", "link 3"), rows),
        "",
        f"On the fast unshaped move the peak of mode 2 is {span(peaks[:, 1] / peaks[:, 0])} of "
        "that of mode 1. Efficient modal control spends its gain where the energy is: mode 2 gets "
        f"{span(ratio)} of the gain of mode 1 here, and 0.312 to 0.412 of it in the paper.",
    ]
    preset = context.named("paper-preset")
    if preset is not None:
        drops = ", ".join(context.drop(preset, mode=2))
        lines[-1] += f" With the paper's ratios (26) and full gains (`paper-preset`): {drops}."
    return lines


def _settling(context: Context) -> list[str]:
    runs, measures = context.runs, context.measures
    band = runs.study.metrics.settling_band

    def cells(k: int) -> list[str]:
        inside = ", ".join(f"{1e3 * t:.0f}" for t in runs.result.metrics.settling_time[k])
        relative = ", ".join(f"{1e3 * t:.0f}" for t in measures.settling[k])
        rms = runs.result.metrics.residual_rms[k][:, middle_station(runs)]
        whole = ", ".join(f"{1e6 * r:.3g}" for r in rms)
        late = ", ".join(residual(context, k, i) for i in range(3))
        return [inside, relative, whole, late]

    pairs = [
        (context.find(m, s, 3, OFF), context.find(m, s, 3, ALL), move_text(m, s))
        for m, s in settings()
    ]
    high = [k for k, c in enumerate(runs.cases) if c.damping_ratio != runs.study.link.first_damping]
    if len(high) == 2:
        zeta = runs.cases[high[0]].damping_ratio
        pairs.append((high[0], high[1], f"{move_text('fast', 'none')}, damping {zeta:g}"))
    rows = []
    for off, on, text in pairs:
        rows += [[f"{text}: no control", *cells(off)], [f"{text}: three links", *cells(on)]]
    off, on = context.find("fast", "none", 3, OFF), context.find("fast", "none", 3, ALL)
    with_, without = measures.settling[on].max(), measures.settling[off].max()
    return [
        "## Settling and residual vibration, per link 1, 2, 3",
        "",
        f"Paper: gone within {PAPER_SETTLING:g} s with control, about half the time without. "
        f"Settled here: deflection below {1e6 * band:g} µm, or below {100 * SETTLED:g} % of the "
        "residual peak without control, at every station; times from the end of the shaped "
        "command. Rms values are of mid-span.",
        "",
        *table(
            (
                "",
                f"to {1e6 * band:g} µm [ms]",
                f"to {100 * SETTLED:g} % [ms]",
                "residual rms [µm]",
                "late rms [µm]",
            ),
            rows,
        ),
        "",
        f"Fast move without shaper: the slowest link settles to {100 * SETTLED:g} % in "
        f"{1e3 * with_:.0f} ms with control and {1e3 * without:.0f} ms without: "
        f"{100 * with_ / max(without, 1e-9):.0f} % of the time (the paper: about 50 %). What is "
        "left of it with control is mainly the slider drive, which bends the links while it "
        "settles.",
        "",
        *_window_words(context, [(off, on, text) for off, on, text in pairs]),
    ]


def _window_words(context: Context, pairs: list[tuple[int, int, str]]) -> list[str]:
    """Where the rms of the whole window grows with control, against the late window."""
    runs, late = context.runs, context.measures.late_deflection
    whole = runs.result.metrics.residual_rms[:, :, middle_station(runs)]
    grown = [
        f"{text}, link {i + 1} ({change(whole[on, i], whole[off, i])}; late window "
        f"{change(late[on, i], late[off, i])})"
        for off, on, text in pairs
        for i in range(3)
        if whole[on, i] > whole[off, i]
    ]
    if not grown:
        return []
    return [
        "With control the rms of the whole residual window is larger in these cases: "
        + "; ".join(grown)
        + ". The whole window begins with the drive's own settling, at frequencies below mode 1: "
        "it bends the links quasi-statically, the loop answers to that bending too, and this "
        "outweighs the vibration that it removes. The late window shows the vibration alone.",
    ]


def _came_out(context: Context) -> str:
    """The paper's headline numbers beside ours."""
    runs, measures = context.runs, context.measures
    off, on = (context.find("fast", "none", 3, links) for links in (OFF, ALL))
    late = 1e6 * measures.late_deflection
    with_, without = (1e3 * measures.settling[k].max() for k in (on, off))
    smooth = late[context.find("paper", "ei", 3, OFF)].max()
    told = (
        f"the paper's own move with its shaper leaves {smooth:.2g} µm rms in the links, hardly "
        "anything to suppress. On a faster move without shaper control of three links takes the "
        f"vibration at mid-span from {late[off].max():.3g} to {late[on].max():.2g} µm rms (worst "
        "link, late window), "
        f"and settles it in {with_:.0f} instead of {without:.0f} ms (the paper: half the time). "
        "Its gain ratios for modes 2 and 3 do not come out: smooth moves hardly excite them."
    )
    bad = [c.name for c, code in zip(runs.cases, runs.status, strict=True) if code]
    return told + (f" Runs that did not end ok: {', '.join(bad)}." if bad else "")


def _figures(names: tuple[str, ...]) -> list[str]:
    return [
        line
        for name in names
        if name in PAPER_FIGURES
        for line in (picture(f"{name}.png", f"`{name}`: {PAPER_FIGURES[name].caption}"), "")
    ]
