"""What a commissioning found and chose, how sure that is, and what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from studies.commission.machines import Possible
from studies.commission.spec import MeasuredSpec
from studies.engine.fast_motion import LEAST_STEPS
from studies.fitting.spec import shown_unit
from studies.result import Result
from studies.results.labelled import Labelled, derived, told, unwritten
from studies.study.margin import margin_text
from studies.study.spec import Study


class CommissionFindings(Labelled, Result, command="commission"):
    """`commission.json`, by `studies commission`: whether there is firmware, and why not."""

    out: Path = unwritten()
    measured: MeasuredSpec = unwritten()  # what was asked for
    title: str = told("of the study")
    last_stage: str = told("fit, tune, certificate or firmware", default="")
    refusals: tuple[str, ...] = told("why there is no firmware to use", default=())
    fit: dict[str, Any] | None = unwritten(default=None)  # its document
    fitted: Study | None = unwritten(default=None)
    possible: Possible | None = unwritten(default=None)  # machines that the data leave
    tuned: Study | None = unwritten(default=None)
    is_fast: bool = unwritten(default=False)  # whether it was tuned on a faster motion than its own
    price: str = unwritten(default="")  # of gains that were lowered after the tuning
    margins: np.ndarray | None = unwritten(default=None)  # on machines left possible, (n,)
    verdict: str = unwritten(default="")  # of the certificate

    @property
    def chosen(self) -> Study:
        """The tuned study, for later stages."""
        assert self.tuned is not None
        return self.tuned

    @derived("", "whether there is firmware that can be used")
    def is_good(self) -> bool:
        return not self.refusals

    @derived("", "the answer in a few lines")
    def summary(self) -> list[str]:
        return [found_text(self), chosen_text(self), sure_text(self), *next_texts(self)]

    @derived("", "fitted, in the unit of their field")
    def numbers(self) -> list[dict[str, Any]]:
        return [] if self.fit is None else list(self.fit["numbers"])

    @derived("1", "least one on the machines that the data leave possible")
    def gain_margin(self) -> float | None:
        return None if self.margins is None else float(self.margins.min())

    @derived("", "how many these are")
    def machines(self) -> int:
        return 0 if self.margins is None else len(self.margins)


def found_text(outcome: CommissionFindings) -> str:
    """What the measurements say of the machine."""
    if outcome.fit is None:
        return "Found: nothing yet."
    numbers = "; ".join(map(_number_text, outcome.fit["numbers"]))
    is_explained = outcome.fit["is_explained"]
    how = "the model explains the data" if is_explained else "NOT TO BE USED, see below"
    return f"Found ({how}): {numbers}."


def _number_text(x: dict[str, Any]) -> str:
    factor, unit = shown_unit(x["name"])
    return f"{x['name']} {factor * x['value']:.5g} +- {factor * x['sigma']:.2g} {unit}".rstrip()


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
    if outcome.gain_margin is not None:
        least = margin_text(outcome.gain_margin, 3)
        where = f"on {outcome.machines} machines that the data leave possible"
        parts.append(f"gain margin {least} or more {where}")
    if outcome.verdict:
        parts.append(f"certificate, on plants of the same basis further off, {outcome.verdict}")
    if outcome.last_stage == "firmware" and not outcome.refusals:
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
