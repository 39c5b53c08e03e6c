"""The report of an export: what was exported, what was compared, what came out."""

from __future__ import annotations

import numpy as np

from studies.engine.controller import FixedController
from studies.engine.stability import LoopReport
from studies.export.c_fixed import format_lines
from studies.export.cost import Cost
from studies.export.fixed import MARGIN, FixedPoint
from studies.export.verify import AIM, Verification
from studies.show.markdown import literal, opening
from studies.study.margin import caution, margin_text


def report(
    found: FixedController,
    origin: list[str],
    loop: LoopReport,
    verified: Verification,
    fixed: FixedPoint | None = None,
    cost: Cost | None = None,
) -> str:
    """Text of the report, in Markdown.

    Args:
        found: the controller.
        origin: lines that say where it comes from.
        loop: linearised sampled loop with the exported coefficients.
        verified: what was compared.
        fixed, cost: formats and cost in fixed point.
    """
    verdict = "passed" if verified.is_passed else "FAILED, no code was written"
    count = len(verified.checks)
    kept = sum(check.is_met for check in verified.checks)
    warning = caution(loop.gain_margin)
    lines = [
        f"# Verification: {verdict}",
        "",
        *opening(
            "does what was exported do what the simulated controller does, sample by sample, over "
            "the case's motion and against extreme inputs?",
            f"**{verdict}**; {kept} of {count} comparisons agree; gain margin "
            f"{margin_text(loop.gain_margin)}." + (f" **{literal(warning)}**" if warning else ""),
            "wiring, timing, start-up and sensor faults: `docs/export.md`. The amplifiers stay off "
            "until the channels have been checked one by one.",
        ),
        "## What was exported",
        "",
        *(f"- {literal(line)}" for line in origin),
        "",
    ]
    lines += [
        f"Linearised sampled loop with the exported coefficients: spectral radius "
        f"{loop.spectral_radius:.6f}, gain margin {loop.gain_margin:.3f} "
        f"({20 * np.log10(loop.gain_margin):.1f} dB).",
        "",
        "## Comparisons",
        "",
        "Relative differences are those of actuator voltages, over the largest one. Open loop: "
        "both controllers get the same sequence of ADC codes.",
        "",
        "| compared | found | allowed | |",
        "|---|---|---|---|",
    ]
    for check in verified.checks:
        mark = "ok" if check.is_met else "**FAILED**"
        lines.append(f"| {check.what} | {check.found} | {check.allowed} | {mark} |")
    lines += [*([""] if verified.notes else []), *verified.notes]
    if len(verified.runs) > 1:
        lines += _in_the_loop(found, verified)
    if fixed is not None and cost is not None:
        lines += _fixed(found, fixed, cost, verified)
    return "\n".join(lines) + "\n"


def _in_the_loop(found: FixedController, verified: Verification) -> list[str]:
    """Runs over the case's motion, each controller with the JAX plant."""
    lines = [
        "",
        "## In the loop",
        "",
        f"The case's motion ({found.structure.n_steps} samples), the plant in JAX. One ADC code "
        "that differs ends exact agreement: from there on both runs are right and different.",
        "",
        "| controller | residual rms of links 1, 2, 3 [um] | against JAX | actuator voltage | "
        "platform x, y [nm], phi [urad] | ADC codes differ from sample |",
        "|---|---|---|---|---|---|",
    ]
    for name, run in verified.runs.items():
        rms = " / ".join(f"{1e6 * x:.5f}" for x in np.max(run.result.metrics.residual_rms, axis=1))
        if name == "JAX":
            peak = np.abs(run.voltage).max()
            share = 100 * peak / float(found.controller.voltage_limit)
            lines.append(f"| JAX | {rms} | | peak {peak:.4g} V, {share:.2g} % of the limit | | |")
            continue
        at = verified.beside(name)
        x, y, phi = at.pose * (1e9, 1e9, 1e6)
        first = "never" if at.first_code < 0 else str(at.first_code)
        lines.append(
            f"| {name} | {rms} | {100 * at.loss:+.3f} % | differs by {at.voltage:.2e} V | "
            f"differs by {x:.2e}, {y:.2e}, {phi:.2e} | {first} |"
        )
    code = found.controller.adc_step / found.controller.adc_gain
    deflection = float(code) * np.abs(found.controller.filter[:, 0]).max()
    return [
        *lines,
        "",
        f"Against JAX: rms over the three links. One ADC code stands for {1e3 * code:.3g} mV at "
        f"a sensor, up to {1e6 * deflection:.2g} µm in the first controlled channel: residuals far "
        "below are decided by which code the noise falls on, and differ from run to run.",
    ]


def _fixed(
    found: FixedController,
    fixed: FixedPoint,
    cost: Cost,
    verified: Verification,
) -> list[str]:
    own, dac = (verified.beside(name).loss for name in ("C, fixed point", "JAX behind the DAC"))
    forms = (fixed.signal, fixed.high, fixed.inner, fixed.force)
    margin = min(form.margin.min() for form in forms)
    worst = (fixed.error.rounding.max(), fixed.error.coefficients.max())
    lines = [
        "",
        "## Fixed point",
        "",
        f"Residual vibration: {100 * own:+.3f} % against floating point (aim: below "
        f"{100 * AIM:g} %, {'met' if own < AIM else 'missed'}); {100 * dac:+.3f} % with the JAX "
        "controller behind the same DAC, so what the DAC costs without fixed point.",
        "",
        f"Bounds, open loop, for any ADC codes: rounding {worst[0]:.2e} V, coefficients "
        f"{worst[1]:.2e} V; one step of the DAC is {fixed.dac_step:.4g} V."
        + (
            ""
            if np.all(np.isfinite(fixed.error.total))
            else " With its feed-through the DAC's "
            "rounding comes back, and no bound holds for the whole."
        ),
        "",
        "Formats: value = base x integer / 2^Q, base = what the simulation shows. Room: the "
        "largest value of the word, in units of base; reach: the largest value that any sequence "
        "of ADC codes can produce, in the same. Smallest margin over the simulation: "
        f"{margin:.0f} (at least {MARGIN}).",
        "",
        "```",
        *format_lines(fixed, found),
        "```",
        "",
        f"Cost: {cost.text}; {cost.roundings} roundings with limit, {cost.words} words of 16 bits "
        "for both states. Cycles are counted generously from instructions, not measured.",
        "",
        "| sequence | samples | overflows inside | samples with an actuator at its limit | "
        "samples at rest by a fault |",
        "|---|---|---|---|---|",
    ]
    for name, response in verified.counts.items():
        lines.append(
            f"| {name} | {len(response.codes)} | {int(response.limited.sum())} | "
            f"{int(np.sum(response.saturated > 0))} | {int(response.is_faulty.sum())} |"
        )
    return lines
