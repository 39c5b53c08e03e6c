"""What an export tells: whether the code does what the simulated controller does, and its cost."""

from __future__ import annotations

import numpy as np

from jaxmodel.controller import channel_parts
from studies.engine.controller import FixedController
from studies.export.c_fixed import format_rows
from studies.export.firmware.boards import CLOCKS
from studies.export.firmware.project import STACK
from studies.export.fixed import MARGIN
from studies.export.request import Exported
from studies.export.verify import AIM, Verification
from studies.publish import REPORT, working_folder
from studies.show.listing import Rows
from studies.show.pages import write_report
from studies.show.report import Chapter, Items, Report, chapter, machine
from studies.study.margin import caution, margin_in_db

_NOTHING = Verification(checks=[], notes=[], runs={}, exchanges={}, counts={})


def whole_page(report: Report) -> str:
    """A report as a web page, of whose figures no files are kept."""
    with working_folder() as folder:
        write_report(report, folder)
        return (folder / REPORT).read_text(encoding="utf-8")


def say(exported: Exported) -> Report:
    """What an export tells."""
    study, loop = exported.controller.study, exported.result.loop
    verified = exported.verified or _NOTHING
    failed = [x for x in verified.checks if not x.is_met]
    verdict = "passed" if verified.checks else "nothing was compared"
    verdict = "FAILED, no code was written" if failed else verdict
    count = f" of {len(verified.checks)}" if failed else ""
    agree = f"{len(verified.checks) - len(failed)}{count} comparisons agree"
    margin, warning = margin_in_db(loop.gain_margin), caution(loop.gain_margin)
    _, package, law, *wiring = exported.origin
    checks = [[x.what, x.found, x.allowed, "ok" if x.is_met else "FAILED"] for x in verified.checks]
    return Report(
        title=f"Verification: {verdict}: {study.title or 'untitled study'}",
        result=[
            *(f"**FAILED: {x.what}: {x.found}, allowed {x.allowed}**" for x in failed),
            f"verified: {agree}" if exported.is_good else f"**{verdict}**: {agree}",
            f"gain margin {margin}" + (f"; **{warning}**" if warning else ""),
            *verified.notes,
            *(_difference(verified, name) for name in verified.runs if name != "JAX"),
        ],
        question="does the exported controller do what the simulated one does, sample by sample?",
        next_steps="""wiring, timing, start-up and sensor faults: `docs/reference/export.md`. Keep
        the amplifiers off until the channels have been checked one by one.""",
        top=[machine(study)],
        chapters=[
            chapter(
                "What was exported",
                Items([package, law]),
                " ".join(wiring),
                f"""Linearised sampled loop with the exported coefficients: spectral radius
                {loop.spectral_radius:.6f}, gain margin {margin}.""",
            ),
            chapter(
                "Comparisons",
                "Differences of actuator voltages are relative to the largest voltage.",
                Rows(["compared", "found", "allowed", ""], checks),
            ),
            _in_the_loop(exported.controller, verified),
            _on_the_processor(exported),
            _fixed_point(exported, verified),
        ],
        files={"Study file": study},
    )


def _difference(verified: Verification, name: str) -> str:
    """What becomes of the motion with a controller instead of JAX's, in a sentence."""
    at = verified.deviation(name)
    return (
        f"in the loop, {name}: voltage differs by {at.voltage:.2g} V, platform by "
        f"{1e9 * at.pose[:2].max():.2g} nm, residual vibration by {100 * at.loss:+.2g} %"
    )


def _in_the_loop(exported: FixedController, verified: Verification) -> Chapter | None:
    if len(verified.runs) < 2:  # JAX alone
        return None
    controller, rows = exported.controller, []
    heads = "platform against JAX: x, y [nm], φ [µrad]", "ADC codes differ from sample"
    for name, run in verified.runs.items():
        rms = " / ".join(f"{1e6 * x:.5f}" for x in np.max(run.result.metrics.residual_rms, axis=1))
        at = verified.deviation(name)
        apart = at.pose * np.array([1e9, 1e9, 1e6])[: len(at.pose)]
        first = "never" if at.first_code < 0 else str(at.first_code)
        rows.append([name, rms, ", ".join(f"{x:.2e}" for x in apart), first])
    peak = np.abs(verified.runs["JAX"].voltage).max()
    code = float(controller.adc_step / controller.adc_gain)
    bent = 1e6 * code * np.abs(channel_parts(controller).filter[:, :1]).max(initial=0.0)
    seen = f", up to {bent:.2g} µm in the first controlled channel, whose filter weighs all sensors"
    return chapter(
        "In the loop",
        f"""The case's motion ({exported.structure.n_steps} samples), the plant in JAX, whose
        controller takes up to {peak:.4g} V, {100 * peak / controller.voltage_limit:.2g} % of the
        limit.""",
        Rows(["controller", "residual rms by link [µm]", *heads], rows),
        f"""One ADC code stands for {1e3 * code:.3g} mV at a sensor{seen if bent else ""}: residuals
        far below that depend on which code the noise falls on, and differ from run to run.""",
    )


def _on_the_processor(exported: Exported) -> Chapter | None:
    target, rate = exported.result.on_target, exported.controller.study.electronics.sample_rate_hz
    if target is None:
        return None
    built, board, ram, loads = target.built, target.board, "", []
    counts = [
        [name, str(len(x)), str(x.min()), f"{np.median(x):.0f}", str(x.max())]
        for name, x in target.instructions.items()
    ]
    start = "The program did not run to its end."
    if counts:
        worst = target.instructions[target.costliest].max()
        start = f"At most **{worst} instructions a sample** ({target.costliest}), not cycles."
        for clock in CLOCKS:
            load = board.load(worst, rate, clock)
            slow = ", cannot keep up" if load > 1 else ""
            loads.append([f"{clock / 1e6:g} MHz", f"{100 * load:.0f} %{slow}"])
    if target.sizes is not None:
        ram = f"""; RAM: {target.sizes.state} bytes for the controller and {target.sizes.shaper} for
        the shaper. Stack of a sample: {target.depth} bytes measured"""
    share = f"share of a sample at {rate:.6g} Hz, with {board.cycles:.3g} cycles an instruction"
    return chapter(
        "On the processor",
        f"{board.text}, emulated; {built.version}, -O2. {start}",
        Rows(["sequence", "samples", "instructions: least", "median", "most"], counts),
        Rows(["clock", share], loads),
        f"""Flash: {built.flash} bytes of code and constants, {built.firmware} with start-up, main
        program and the compiler's library{ram}, {built.stack} by the compiler's bound for its own
        functions, {STACK} reserved. Functions of the compiler's library:
        {", ".join(built.library) or "none"}.""",
        "The project next to this page builds the same program: see its `README.md`.",
    )


def _fixed_point(exported: Exported, verified: Verification) -> Chapter | None:
    fixed, cost = exported.result.fixed, exported.result.cost
    if fixed is None or cost is None or not verified.runs:
        return None
    loss, of_dac = (verified.deviation(k).loss for k in ("C, fixed point", "JAX behind the DAC"))
    unbound = "The DAC's rounding returns through the feed-through: no bound holds for the total."
    heads, *formats = format_rows(fixed, exported.controller)
    at_limit = "samples with an actuator at its limit", "samples at rest after a fault"
    sequences = []
    for name, x in verified.counts.items():
        counts = len(x.codes), x.limited.sum(), np.sum(x.saturated > 0), x.is_faulty.sum()
        sequences.append([name, *(f"{count:.0f}" for count in counts)])
    return chapter(
        "Fixed point",
        f"""Residual vibration: {100 * loss:+.3f} % against floating point (aim: below
        {100 * AIM:.6g} %, {"met" if loss < AIM else "missed"}); {100 * of_dac:+.3f} % with the JAX
        controller behind the same DAC, the effect of the DAC alone.""",
        f"""Bounds, open loop, for any ADC codes: rounding {fixed.error.rounding.max():.2e} V,
        coefficients {fixed.error.coefficients.max():.2e} V; one step of the DAC is
        {fixed.wires.dac_step:.4g} V. {"" if np.isfinite(fixed.error.total).all() else unbound}""",
        f"""Formats: value = base x integer / 2^Q, base = largest value in the simulation. Room: the
        largest value of the word; reach: that of any sequence of ADC codes; both in units of the
        base. Smallest margin over the simulation:
        {min(form.margin.min() for _, form, _ in fixed.formats):.0f} (at least {MARGIN}).""",
        Rows(heads, formats),
        f"""Cost: {cost.text}; {cost.roundings} roundings with limit, {cost.words} words of 16 bits
        for both states.""",
        Rows(["sequence", "samples", "internal overflows", *at_limit], sequences),
    )
