"""What the paper's study tells: its numbers next to those of two machines, and why they differ."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from jaxmodel.prepare import SPECTRUM_SPAN
from studies.papers.card import PaperCard, Verdict
from studies.papers.zhang_2016.cases import (
    ALL,
    EXPERIMENT_RATIOS,
    HIGH_DAMPING,
    MOVES,
    OFF,
    PAPER_RATIOS,
    TWO,
)
from studies.papers.zhang_2016.context import Context, Machines, change
from studies.papers.zhang_2016.figures import PAPER_FIGURES, PLATFORM_DELAY, VIEW_LENGTH
from studies.papers.zhang_2016.measures import SETTLED
from studies.papers.zhang_2016.tables import (
    COLUMNS,
    amplitude_change,
    design_rows,
    energy_ratio,
    frequency_rows,
    machine_rows,
    motion_rows,
    platform_rows,
    printed_changes,
    ratio_rows,
    settling_rows,
    table_1_rows,
)
from studies.show.listing import Rows
from studies.show.report import Chapter, Drawing, Items, Report, chapter, machine
from studies.show.units import number, span
from studies.study.labels import describe
from studies.study.window import residual_delay


def say(card: PaperCard, verdicts: list[Verdict], machines: Machines) -> Report:
    """What the study tells; verdicts: on the claims of the card."""
    study = machines.nominal.runs.study
    heads = ["claim", "quantity", "condition", "outcome", "found"]
    return Report(
        title="The paper's study: its numbers and ours",
        result=_result(machines),
        question=f"""which results of sections 4 and 5 of the paper does this model reproduce, on
        which machine, and which does it not? The paper: {card.source}.""",
        next_steps="""design on the fitted machine where numbers like the paper's matter (`studies
        simulate paper_fitted`); `studies atlas` for the coupling of the links, `studies sweep
        placement` and `studies tune tune` for better designs than the paper's.""",
        top=[machine(study)],
        chapters=[
            chapter("Claims", Rows(heads, [x.cells for x in verdicts])),
            chapter(
                "What the paper leaves open",
                f"Source: {card.source}. {card.read}",
                Items(card.left_open),
            ),
            _machines(machines),
            _table_1(machines),
            _settling(machines),
            _ratios(machines),
            _platform(machines),
            _moves(machines.nominal),
            _designs(machines.nominal),
            _reasons(machines),
        ],
        files={"Study file": study},
    )


def _beside(machines: Machines, *names: str) -> list[Drawing]:
    """Counterparts of figures of the paper."""
    drawn = [(name, *PAPER_FIGURES[name]) for name in names if name in PAPER_FIGURES]
    return [
        Drawing(name, f"`{name}`: {text}", partial(draw, machines)) for name, text, draw in drawn
    ]


def _result(machines: Machines) -> list[str]:
    fitted, nominal = map(_agreement, machines)
    context, step = machines.nominal, 1e6 * machines.nominal.runs.frame.adc_step.min()
    second = np.array([row[1] for row in (*PAPER_RATIOS, *EXPERIMENT_RATIOS)])
    smooth = 1e6 * context.measures.residual[context.find("paper", "ei", 3, OFF)].max()
    is_halved = any(len(_halved_directions(one)) == 3 for one in machines)
    half = "" if is_halved else "; and that two links more than halve the platform's error"

    def seen(rms: float) -> str:
        return f"{rms:.2g} µm" if rms >= step else f"less than one ADC step ({step:.2g} µm)"

    return [
        f"the measurements of section 5 are reproduced on the machine fitted to them: frequencies "
        f"of {span(fitted['frequency'][0], '.1f')} Hz and {span(fitted['frequency'][1], '.1f')} Hz "
        f"(the paper: 92.5 and 241.3), Table 1, read as amplitudes, within "
        f"{fitted['apart'][1]:.2g} percentage points (mode 2: {fitted['apart'][2]:.2g}), settling "
        f"in {span(fitted['held'], '.0f')} ms with control and {span(fitted['free'], '.0f')} ms "
        "without (the paper: 70, and about twice that)",
        f"not reproduced on either machine: the energy ratios, of which mode 2 has "
        f"{span(fitted['second'], '.2g')} on the fitted one instead of {span(second, 'g')}{half}",
        f"on the nominal machine, half of the paper's gains reduce the vibration after a fast move "
        f"from {nominal['residual'][0]:.2g} µm rms (worst link) to {seen(nominal['residual'][1])}; "
        f"the paper's own move with its shaper leaves {seen(smooth)} without control",
    ]


def _delays(machines: Machines) -> str:
    delays = sorted({1e3 * residual_delay(x.runs.study) for x in machines})
    return " and ".join(f"{delay:.3g}" for delay in delays)


def _machines(machines: Machines) -> Chapter | None:
    fitted, nominal = machines
    study, steps = nominal.runs.study, [1e6 * x.runs.frame.adc_step for x in machines]
    bad = [
        f"`{case.name}` ({context.name}): {describe(int(code))}"
        for context in machines
        for case, code in zip(context.runs.cases, context.runs.status, strict=True)
        if code
    ]
    electronics = study.electronics
    return chapter(
        "The machines and their runs",
        Rows(["", "fitted machine", "nominal machine"], machine_rows(machines)),
        f"""Control: sampled at {electronics.sample_rate_hz / 1e3:g} kHz, {electronics.adc_bits}
        bit, one sample of delay, velocity by {electronics.estimator}. Cases: no control, three
        links, the first two, the first only; three controlled modes (the paper's section 4) and two
        (section 5, ratios (27); the comparison cases control mode 1 only). One ADC step is
        {span(steps[1])} µm of mode 1 on the nominal machine, {span(steps[0])} µm on the fitted one:
        a residual below it is told as "<". {"Failed or unstable:" if bad else "All ended ok."}""",
        Items(bad),
        f"""Residual window: {number(study.metrics.residual_length, "s")} ms, from when the slider
        drive has settled to 2 % ({_delays(machines)} ms after the reference trajectory).
        `fig03` is the counterpart of the paper's figure 3, and so on; left column: the fitted
        machine, right column: the nominal one, both on the compared motion.""",
        Rows(list(COLUMNS), frequency_rows(machines)),
    )


def _table_1(machines: Machines) -> Chapter | None:
    fitted, nominal = map(_agreement, machines)
    return chapter(
        "Table 1: vibration of mode 1, and of mode 2, with control",
        f"""Changes of the peak of the power spectral density by control, read as amplitudes:
        Hann periodogram of the whole run, largest value within ±{100 * SPECTRUM_SPAN:g} % of the
        link's frequency between held ends. Three links: two modes controlled; otherwise mode 1
        only, as in the paper.""",
        Rows(list(COLUMNS), table_1_rows(machines)),
        f"""The fitted machine comes within {fitted["apart"][1]:.2g} percentage points of the
        entries of Table 1, and within {fitted["apart"][2]:.2g} of those of mode 2, where the
        rounding of the converter counts. On the nominal machine a controlled link changes by
        {span(nominal["controlled"], "+.1f")} %, an uncontrolled one by
        {span(nominal["uncontrolled"], "+.1f")} %. A well damped mode has no peak left: its
        reduction is at least this much.""",
        *_beside(machines, "fig13", "fig14", "fig15", "fig16", "fig17", "fig18"),
    )


def _settling(machines: Machines) -> Chapter | None:
    return chapter(
        "Settling and residual vibration, links 1, 2, 3",
        f"""Paper: the vibration is gone within 0.07 s with control, almost 50 % faster than
        without; read here as about 0.14 s without. Settled: mid-span deflection below
        {100 * SETTLED:g} % of its largest value after the move without control; times from the end
        of the move. Rms values are those of mid-span.""",
        Rows(list(COLUMNS), settling_rows(machines)),
        *_beside(machines, "fig03", "fig07", "fig09", "fig12"),
    )


def _ratios(machines: Machines) -> Chapter | None:
    largest = energy_ratio(machines.fitted)[:, 1].max()
    return chapter(
        "Gain ratios of efficient modal control: (26) and (27)",
        "Ours by (24) from the time mean of E = ω²q² + q'² while moving, without control.",
        Rows(list(COLUMNS), ratio_rows(machines)),
        f"""The ratios show what excites the links. The paper's may be of another quantity than
        energy: the root of {largest:.2g} is {largest**0.5:.2g}. Pinned-free modes, as the paper's,
        are not decoupled on the assembled machine: mode 1's motion appears in modes 2 and 3.""",
        *_beside(machines, "fig04"),
    )


def _platform(machines: Machines) -> Chapter | None:
    length = machines.nominal.runs.study.metrics.residual_length
    view = " to ".join(number(x, "s") for x in (PLATFORM_DELAY, VIEW_LENGTH))
    halved = "; ".join(
        f"{one.name}: {', '.join(_halved_directions(one)) or 'none'}" for one in machines
    )
    return chapter(
        "Platform error after the move",
        f"""Paper: with two links controlled the residual errors in x, y and φ fall by more than 50
        %. Rms against the reference trajectory in the residual window, {number(length, "s")} ms
        from {_delays(machines)} ms after it on; `fig06`, `fig08` and `fig10` show the error from
        {view} ms after it.""",
        Rows(list(COLUMNS), platform_rows(machines)),
        f"Directions in which control of two links more than halves the error: {halved}.",
        *_beside(machines, "fig05", "fig06", "fig08", "fig10"),
    )


def _moves(nominal: Context) -> Chapter | None:
    band = f"to {1e6 * nominal.runs.study.metrics.settling_band:g} µm [ms]"
    heads = ["", "bending while moving [µm]", "residual rms [µm]", band]
    return chapter(
        "Nominal machine: moves and shapers",
        f"The paper's section 4 has the move of {MOVES['paper']:.4g} s; three modes, three links.",
        Rows([*heads, f"to {100 * SETTLED:g} % [ms]"], motion_rows(nominal)),
        *_beside(Machines(nominal, nominal), "shapers"),
    )


def _designs(nominal: Context) -> Chapter | None:
    heads = ["case", "feedback", "velocity", "factor", "ratios", "status"]
    heads += ["gain margin, spectral radius", "damping of modes 1, 2, 3", "PSD peak of mode 1"]
    return chapter(
        "Nominal machine: other designs, three links, three modes, fast move without shaper",
        Rows([*heads, "residual rms [µm]", "peak voltage [V]"], design_rows(nominal)),
        """The factor multiplies the machine's gains, half of the paper's. A loop that is unstable
        at home counts as unstable even where saturation keeps the run bounded.""",
    )


def _reasons(machines: Machines) -> Chapter | None:
    fitted, nominal = machines
    study, runs = nominal.runs.study, nominal.runs
    cases = {case.name: k for k, case in enumerate(runs.cases)}
    residual = 1e6 * nominal.measures.residual
    bent = 1e6 * runs.result.metrics.structural_peak.max(axis=2)
    slow, free = nominal.find("paper", "none", 3, OFF), nominal.compared(3, OFF)
    shaped = _shaper_factors(nominal)
    damping = np.atleast_1d(fitted.runs.study.link.damping_ratio)
    texts = [
        f"""**The smooth move excites little.** The links of the nominal machine bend by up to
        {bent[slow].max():.3g} µm on the paper's move, but vibrate with only
        {residual[slow].max():.2g} µm rms in the residual window; on the faster one with
        {bent[free].max():.3g} µm and {residual[free].max():.3g} µm. The EI shaper alone reduces the
        residual vibration by a factor of {shaped[0]:.3g} on the paper's move and of
        {shaped[1]:.3g} on the faster one.""",
        f"""**Structural damping** is not in the paper. The fit finds
        {", ".join(f"{x:.2g}" for x in damping)} for modes 1 and 2, and {study.link.damping_ratio:g}
        is assumed on the nominal machine; the rows with {HIGH_DAMPING:g} show how much the settling
        depends on it.""",
    ]
    if "weak" in cases:
        weak = 0.02 * study.control.velocity_gain[0] * study.control.gain_factor
        texts.append(
            f"""**The gains are large.** A first gain of {weak:.2g} N s/m (`weak`) changes the peak
            of mode 1 of the nominal machine by {nominal.peak_change(cases["weak"], 1)}. The fitted
            machine needs {fitted.runs.study.control.gain_factor:.2g} of the paper's gains for the
            paper's reductions."""
        )
    if "difference" in cases and "difference" in runs.loops:
        k = cases["difference"]
        texts.append(
            f"""**Velocity estimate.** The same gains with a filtered difference instead of the
            modal phase filter: {describe(int(runs.status[k]))}, gain margin
            {runs.loops["difference"].gain_margin:.3g},
            {runs.result.metrics.peak_voltage[k].max():.3g} V at the actuators."""
        )
    return chapter("Why the numbers differ", Items(texts))


def _agreement(context: Context) -> dict[str, Any]:
    """How far a machine has the paper's numbers."""
    measures = context.measures
    settling = [1e3 * measures.settling[context.compared(2, links)] for links in (OFF, ALL)]
    changes = {
        is_controlled: [
            float(change)
            for _, links, mode, _ in printed_changes()
            for change, is_on in zip(amplitude_change(context, links, mode), links, strict=True)
            if is_on == is_controlled
        ]
        for is_controlled in (True, False)
    }
    apart = {
        mode: max(
            float(np.abs(amplitude_change(context, links, mode) - printed).max())
            for _, links, of, printed in printed_changes()
            if of == mode
        )
        for mode in (1, 2)
    }
    return {
        "frequency": context.runs.link_hz.T,
        "apart": apart,
        "controlled": changes[True],
        "uncontrolled": changes[False],
        "free": settling[0],
        "held": settling[1],
        "second": energy_ratio(context)[:, 1],
        "residual": [
            1e6 * measures.residual[context.compared(3, links)].max() for links in (OFF, ALL)
        ],
    }


def _halved_directions(context: Context) -> list[str]:
    """Directions in which two controlled links more than halve the residual error."""
    off, two = (
        context.runs.result.metrics.pose_error_rms[context.compared(3, links)]
        for links in (OFF, TWO)
    )
    return [f"{n} ({change(x, y)})" for n, x, y in zip("xyφ", two, off, strict=True) if x < 0.5 * y]


def _shaper_factors(context: Context) -> list[float]:
    """Factor by which the EI shaper reduces the residual vibration, per move."""
    left = context.measures.residual.max(axis=1)
    unshaped, shaped = (
        np.array([left[context.find(move, shaper, 3, OFF)] for move in MOVES])
        for shaper in ("none", "ei")
    )
    return (unshaped / shaped).tolist()
