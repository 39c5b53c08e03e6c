"""The page of a commissioning: what was found and chosen, how sure that is, what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from studies.commission.spec import MeasuredSpec
from studies.commission.stages import STAGES
from studies.engine.fast_motion import LEAST_STEPS
from studies.fitting.spec import number_unit
from studies.show.document import json_text
from studies.show.pages import page
from studies.study.margin import margin_text
from studies.study.spec import Study


class CommissionFindings(NamedTuple):
    """What the stages answered, as far as they went."""

    out: Path
    done: str = ""  # the last stage
    refusals: tuple[str, ...] = ()  # why there is no firmware to use; none if there is
    fit: dict[str, Any] | None = None
    tuned: Study | None = None
    is_fast: bool = False  # whether it was tuned on a faster motion than its own
    price: str = ""  # of gains that were lowered after the tuning
    margins: np.ndarray | None = None  # on machines that the data leave possible [1], (n,)
    certificate: dict[str, Any] | None = None


def summary(outcome: CommissionFindings) -> list[str]:
    """The answer in a few lines."""
    return [found_text(outcome), chosen_text(outcome), sure_text(outcome), *next_texts(outcome)]


def found_text(outcome: CommissionFindings) -> str:
    """What the measurements say of the machine."""
    if outcome.fit is None:
        return "Found: nothing yet."
    numbers = "; ".join(map(_number_text, outcome.fit["numbers"]))
    is_explained = outcome.fit["is_explained"]
    how = "the model explains the data" if is_explained else "NOT TO BE USED, see below"
    return f"Found ({how}): {numbers}."


def _number_text(x: dict[str, Any]) -> str:
    text = f"{x['name']} {x['value']:.5g} +- {x['sigma']:.2g} {number_unit(x['name'])}"
    return text.removesuffix(" 1")


def chosen_text(outcome: CommissionFindings) -> str:
    """Which controller was chosen."""
    if outcome.tuned is None:
        return "Chosen: no controller yet."
    control, rate = outcome.tuned.control, outcome.tuned.electronics.sample_rate_hz
    price = f" ({outcome.price})" if outcome.price else ""
    gain = f"gain factor {control.gain_factor:.4g}{price}, {rate:g} Hz"
    if outcome.is_fast:
        gain += (
            f", tuned on a fast first move without shaper, because the motion of the file leaves "
            f"less than {LEAST_STEPS:g} ADC step under control"
        )
    if outcome.refusals:
        return f"Chosen, but not to be used: {control.law}, {gain}."
    return f"Chosen: {control.law}, {gain}; the code is in {outcome.out / 'firmware'}."


def sure_text(outcome: CommissionFindings) -> str:
    """How sure it is that the controller does on the machine what it was designed for."""
    parts = []
    if outcome.margins is not None:
        least = margin_text(float(outcome.margins.min()), 3)
        parts.append(
            f"gain margin {least} or more on {len(outcome.margins)} machines that the data leave "
            "possible"
        )
    if outcome.certificate is not None:
        verdict = outcome.certificate["verdict"]
        parts.append(f"certificate, on plants of the same basis further off, {verdict}")
    if outcome.done == "firmware" and not outcome.refusals:
        parts.append("the exported code agrees with the design")
    return f"How sure: {'; '.join(parts) or 'not judged'}."


def next_texts(outcome: CommissionFindings) -> list[str]:
    """Why there is no firmware, and what to measure."""
    texts = [f"REFUSED: {text}" for text in outcome.refusals]
    fit = outcome.fit
    if fit is None:
        return texts
    open_questions = [text for text in fit["messages"] if text not in outcome.refusals]
    texts += [f"Left open by the data: {text}" for text in open_questions]
    if (open_questions or outcome.refusals) and fit["experiments"]:
        best = fit["experiments"][0]
        pose = ", ".join(f"{x:.3g}" for x in best["pose"])
        texts.append(f"To measure next: {best['text']} at the pose ({pose}).")
    return texts


def document(measured: MeasuredSpec, outcome: CommissionFindings) -> str:
    """JSON text of the answer."""
    margins = outcome.margins
    whole = {
        "title": measured.study.title,
        "is_good": not outcome.refusals,
        "last_stage": outcome.done,
        "refusals": list(outcome.refusals),
        "summary": summary(outcome),
        "numbers": [] if outcome.fit is None else outcome.fit["numbers"],
        "gain_margin": None if margins is None else float(margins.min()),
        "machines": 0 if margins is None else len(margins),
    }
    return json_text("commission", whole)


def report(measured: MeasuredSpec, outcome: CommissionFindings) -> str:
    """The page.

    Args:
        measured: what was asked for.
        outcome: how far it went.
    """
    pages = [f"{stage.name}/{stage.page}" for stage in STAGES]
    return page(
        "commission/report.html",
        None,
        outcome.tuned or measured.study,
        outcome=outcome,
        measured=measured,
        wanted=measured.commission,
        lines=summary(outcome),
        pages=[file for file in pages if (outcome.out / file).is_file()],
        rows=_numbers(outcome),
        margins=_margins(outcome),
    )


def _numbers(outcome: CommissionFindings) -> list[list[str]]:
    """Row of each fitted number."""
    if outcome.fit is None:
        return []
    rows = []
    for x in outcome.fit["numbers"]:
        low, high = x["interval_95"]
        span = f"{low:.5g} to {high:.5g}"
        rows.append([x["name"], number_unit(x["name"]), f"{x['value']:.5g}", span])
    return rows


def _margins(outcome: CommissionFindings) -> list[list[str]]:
    """Row of quantiles of the gain margin."""
    if outcome.margins is None:
        return []
    quantiles = np.quantile(outcome.margins, [0.0, 0.1, 0.5, 0.9, 1.0])
    return [[margin_text(float(x), 3) for x in quantiles]]
