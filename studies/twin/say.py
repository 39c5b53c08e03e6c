"""What a twin tells: tables, document and page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from studies.results.labelled import Labelled, labelled, told
from studies.show.listing import Rows
from studies.show.report import Report, chapter, drawing
from studies.show.words import control_text, motion_text
from studies.study.margin import margin_text
from studies.study.spec import Study
from studies.twin.compare import ChangedRun, Gap, deflection, gap, place, turn, voltage
from studies.twin.margin import GrowthMargin
from studies.twin.plots import side_by_side
from studies.twin.result import FIGURE, TwinResult

GAP_HEAD = ("after the motion, rms", "this model", "twin", "difference", "of the twin's")
CAUSE_HEAD = (
    "what is changed",
    "mid-span without control",
    "mid-span with control",
    "voltages",
)
POLE_HEAD = ("linearised loop", "this model", "twin", "difference")


class ComparedQuantity(Labelled):
    """A quantity of both models."""

    name: str = told("of the quantity")
    unit: str = told("SI symbol")
    is_controlled: bool = told("with control")
    gap: Gap = told("in that window, rms in that unit")
    entries: tuple[str, ...] = told("what the numbers of each list belong to")


class TwinDocument(Labelled, command="twin", version=2):
    """What `studies twin --json` prints and `twin.json` holds: a run by this model beside its twin
    in Exudyn.
    """

    title: str = told("of the study")
    verdict: str = told("the comparison in a sentence")
    exudyn: str = told("version of Exudyn")
    elements_per_link: int = told("at least")
    steps_per_sample: int = told("of the twin")
    command_end: float = labelled("s", "end of the reference trajectory")
    window_length: float = labelled("s", "of the samples after it that are compared")
    compared: list[ComparedQuantity] = told("in that window")
    changes: list[ChangedRun] = told("with one thing changed; the first entry: nothing")
    damping_ratio: np.ndarray = labelled("1", "of the first modes, linearised loop", "mode")
    twin_damping_ratio: np.ndarray = labelled("1", "the same of the twin, by decay", "mode")
    gain_margin: float = labelled("1", "factor on control.gain_factor, of the linearised loop")
    growth: GrowthMargin = told("the same of the twin, by growth")
    study: Study = told("the study compared, complete")


def compared(result: TwinResult) -> list[ComparedQuantity]:
    """Everything that is compared after the motion."""
    n_links, n_pose = result.plan.rho.shape[1], len(result.plan.pose)
    links, own = tuple(f"link {i + 1}" for i in range(n_links)), []

    def add(
        name: str, unit: str, quantity: Callable[[Any], np.ndarray], entries: tuple[str, ...]
    ) -> None:
        for is_controlled, both in ((False, result.runs.free), (True, result.runs.controlled)):
            if name != "voltage" or is_controlled:
                apart = gap(both, quantity, result.window)
                own.append(ComparedQuantity(name, unit, is_controlled, apart, entries))

    add("mid-span deflection", "m", deflection, links)
    add("voltage", "V", voltage, links)
    add("platform, error of place", "m", place, ("x", "y"))
    if n_pose == 3:
        add("platform, error of angle", "rad", turn, ("phi",))
    return own


def gap_rows(result: TwinResult) -> list[list[str]]:
    """Row of each quantity and link, and of all links together."""
    rows = []
    for one in compared(result):
        factor, unit = {"m": (1e6, "µm"), "rad": (1e6, "µrad")}.get(one.unit, (1.0, one.unit))
        control = "with control" if one.is_controlled else "without control"
        parts = one.gap.ours, one.gap.theirs, one.gap.difference
        for k, entry in enumerate(one.entries):
            texts = (f"{factor * x[k]:.4g} {unit}" for x in parts)
            rows.append([f"{one.name}, {entry}, {control}", *texts, _percent(one.gap.share[k])])
        if len(one.entries) > 1:
            together = (float(np.linalg.norm(x)) / len(x) ** 0.5 for x in parts)
            texts = (f"{factor * x:.4g} {unit}" for x in together)
            rows.append([f"{one.name}, all together, {control}", *texts, _percent(one.gap.whole)])
    return rows


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if np.isfinite(share) else "-"


def cause_rows(found: list[ChangedRun]) -> list[list[str]]:
    """Row of each change."""
    return [
        [one.text, *(_percent(x) for x in (one.free, one.controlled, one.voltage))] for one in found
    ]


def damping_ratios(result: TwinResult) -> tuple[np.ndarray, np.ndarray]:
    """Of the first modes under control, ours and theirs [1], (n,) each."""
    ours = result.loop.damping_ratio[0]
    theirs = -result.first_modes.real / np.abs(result.first_modes)
    return np.asarray(ours[np.isfinite(ours)]), theirs


def pole_rows(result: TwinResult) -> list[list[str]]:
    """Damping of the first modes, and the gain margin."""
    ours, theirs = damping_ratios(result)
    rows = [
        [f"damping ratio of the first modes, {k + 1} of {len(ours)}", f"{a:.4f}", f"{b:.4f}"]
        + [_percent(abs(a / b - 1))]
        for k, (a, b) in enumerate(zip(ours, theirs, strict=True))
    ]
    growth, margin = result.growth, float(result.loop.gain_margin)
    found = "not found" if np.isnan(growth.margin) else margin_text(growth.margin)
    apart = _percent(abs(margin / growth.margin - 1))
    return [*rows, ["gain margin, twin: by growth", margin_text(margin), found, apart]]


def verdict(result: TwinResult) -> str:
    """The comparison in a sentence."""
    both, window = result.runs.controlled, result.window
    margin = abs(float(result.loop.gain_margin) / result.growth.margin - 1)
    text = (
        f"in the {1e3 * (window.stop - window.start) * result.plan.electronics.period:.3g} ms "
        f"after the motion, with control, mid-span deflections of all links differ by "
        f"{_percent(gap(both, deflection, window).whole)} of their rms, voltages by "
        f"{_percent(gap(both, voltage, window).whole)}"
    )
    if np.isnan(margin):
        return f"{text}; no gain margin by growth was found"
    seen = "growth 1 % beyond and decay 1 % below it seen"
    return (
        f"{text}; the gain margin by growth is {margin_text(result.growth.margin)}, "
        f"{_percent(margin)} from the predicted {margin_text(float(result.loop.gain_margin))}"
        f" ({seen if result.growth.is_confirmed else 'NOT confirmed by runs on both sides of it'})"
    )


def twin_document(result: TwinResult) -> TwinDocument:
    """The document of a comparison."""
    window, (ours, theirs) = result.window, damping_ratios(result)
    return TwinDocument(
        title=result.study.title,
        verdict=verdict(result),
        exudyn=result.version,
        elements_per_link=result.settings.n_elements,
        steps_per_sample=result.plan.n_steps,
        command_end=float(result.plan.command_end),
        window_length=(window.stop - window.start) * result.plan.electronics.period,
        compared=compared(result),
        changes=result.causes,
        damping_ratio=ours,
        twin_damping_ratio=theirs,
        gain_margin=float(result.loop.gain_margin),
        growth=result.growth,
        study=result.study,
    )


def say(result: TwinResult) -> Report:
    """What a twin tells."""
    study, growth = result.study, result.growth
    rounding = study.electronics.adc_step / study.electronics.conditioner_gain
    step = result.plan.electronics.period / result.plan.n_steps
    at = "" if np.isnan(growth.frequency) else f" at {growth.frequency:.4g} Hz"
    causes = cause_rows(result.causes)
    return Report(
        title=f"{study.title or 'untitled study'}: twin",
        result=[verdict(result)],
        question=f"""{motion_text(study)}; {control_text(study)}: does the loop do the same where
        somebody else's code is the machine, and the exported C code the controller?""",
        next_steps="""if the differences below are small beside what you decide by, carry on:
        `studies certify DESIGN --out DIR` certifies the controller on machines that differ from
        its model. If not, the second table says which assumption they come from.""",
        top=[],
        chapters=[
            chapter(
                "Side by side",
                drawing(side_by_side, result.plan, result.runs, name=FIGURE),
                Rows(list(GAP_HEAD), gap_rows(result)),
                f"""One step of the ADC is {rounding:.3g} V of a sensor. Where signals come near it,
                the rounding of the two loops differs, and percentages mean little.""",
            ),
            chapter(
                "What the difference is made of",
                """Differences over the twin's rms, all links together, with one thing changed at a
                time."""
                if causes
                else "",
                Rows(list(CAUSE_HEAD), causes),
            ),
            chapter(
                "Damping and gain margin",
                f"""The twin rests, gets a pulse of small voltages and rings; poles are those of its
                recorded sensors. Beyond the margin, a factor on `control.gain_factor`, its signals
                grow{at}.""",
                Rows(list(POLE_HEAD), pole_rows(result)),
            ),
            chapter(
                "The twin",
                f"""{result.version}: each link consists of {result.settings.n_elements} elements or
                more (ANCF cables). Patches are pairs of moments, sensors differences of slope.
                Steps of {1e6 * step:.3g} µs, half of that for poles and margin, generalised alpha.
                The analogue filters are stepped exactly, the controller is the C code of `studies
                export --target c`.""",
            ),
        ],
        files={"Study file": study},
    )
