"""The report of an export: what was exported and compared, and the results."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from jaxmodel.controller import channel_parts
from studies.engine.controller import FixedController
from studies.export.c_fixed import format_lines
from studies.export.firmware.boards import CLOCKS
from studies.export.firmware.on_target import OnTarget
from studies.export.firmware.project import STACK
from studies.export.fixed import MARGIN, FixedPoint
from studies.export.fixed_blocks import FixedBlocks
from studies.export.job import ExportResult
from studies.export.verify import AIM, Verification
from studies.show.pages import old_page as page
from studies.study.margin import caution

#: In place of "ok".
FAULT = Markup("<b>FAILED</b>")


def report(exported: FixedController, origin: list[str], result: ExportResult) -> str:
    """The page of an export that was verified.

    Args:
        exported: the controller.
        origin: lines that say where it came from.
        result: what was made and compared.
    """
    controller, verified = exported.controller, result.verified
    assert verified is not None
    loop, fixed = result.loop, result.fixed
    code = float(controller.adc_step / controller.adc_gain)
    return page(
        "export/report.html",
        None,
        exported.study,
        exported=exported,
        origin=origin,
        loop=loop,
        margin_db=20 * np.log10(loop.gain_margin),
        caution=caution(loop.gain_margin),
        verified=verified,
        kept=sum(check.is_met for check in verified.checks),
        checks=[
            [check.what, check.found, check.allowed, "ok" if check.is_met else FAULT]
            for check in verified.checks
        ],
        controllers=_controllers(exported, verified),
        code=code,
        deflection=code * np.abs(channel_parts(controller).filter[:, :1]).max(initial=0.0),
        fixed=fixed,
        cost=result.cost,
        target=result.on_target,
        **(_of_target(exported, result.on_target) if result.on_target is not None else {}),
        **(_of_fixed(exported, fixed, verified) if fixed is not None else {}),
    )


def _controllers(exported: FixedController, verified: Verification) -> list[list[str]]:
    """Row of each controller that ran in the loop; none if JAX's was the only one."""
    if len(verified.runs) == 1:
        return []
    rows = []
    for name, run in verified.runs.items():
        rms = " / ".join(f"{1e6 * x:.5f}" for x in np.max(run.result.metrics.residual_rms, axis=1))
        if name == "JAX":
            peak = np.abs(run.voltage).max()
            share = 100 * peak / float(exported.controller.voltage_limit)
            rows.append([name, rms, "", f"peak {peak:.4g} V, {share:.2g} % of the limit", "", ""])
            continue
        at = verified.deviation(name)
        apart = at.pose * np.array([1e9, 1e9, 1e6])[: len(at.pose)]
        rows.append(
            [
                name,
                rms,
                f"{100 * at.loss:+.3f} %",
                f"differs by {at.voltage:.2e} V",
                f"differs by {', '.join(f'{x:.2e}' for x in apart)}",
                "never" if at.first_code < 0 else str(at.first_code),
            ]
        )
    return rows


def _of_target(exported: FixedController, target: OnTarget) -> dict[str, Any]:
    """What the section on the processor needs."""
    rows = [
        [name, str(len(x)), str(x.min()), f"{np.median(x):.0f}", str(x.max())]
        for name, x in target.instructions.items()
    ]
    if not rows:
        return {"instruction_rows": [], "reserved": STACK}
    worst = target.instructions[target.costliest].max()
    rate = exported.study.electronics.sample_rate_hz
    shares = {clock: target.board.load(worst, rate, clock) for clock in CLOCKS}
    loads = [
        [f"{clock / 1e6:g} MHz", f"{100 * share:.0f} %{', cannot keep up' if share > 1 else ''}"]
        for clock, share in shares.items()
    ]
    return {"instruction_rows": rows, "worst": worst, "loads": loads, "reserved": STACK}


def _of_fixed(
    exported: FixedController, fixed: FixedPoint | FixedBlocks, verified: Verification
) -> dict[str, Any]:
    """What the section on fixed point needs."""
    loss, dac_loss = (verified.deviation(k).loss for k in ("C, fixed point", "JAX behind the DAC"))
    forms = [form for _, form, _ in fixed.formats]
    return {
        "loss": loss,
        "dac_loss": dac_loss,
        "aim": AIM,
        "is_bounded": bool(np.all(np.isfinite(fixed.error.total))),
        "margin": min(form.margin.min() for form in forms),
        "least_margin": MARGIN,
        "formats": format_lines(fixed, exported),
        "sequences": [
            [
                name,
                str(len(response.codes)),
                str(int(response.limited.sum())),
                str(int(np.sum(response.saturated > 0))),
                str(int(response.is_faulty.sum())),
            ]
            for name, response in verified.counts.items()
        ],
    }
