"""The report of a tuning: what was gained, on which machines, and what limits it."""

from __future__ import annotations

import numpy as np

from studies.tuning.audit import Disagreement
from studies.tuning.check import Judged
from studies.tuning.optimise import KEPT, Progress
from studies.tuning.spec import LOOP_LIMITS, TuneSpec

#: A limit nearer than this share counts as active.
NEAR = 0.02


def report(
    spec: TuneSpec,
    limits: tuple[str, ...],
    at: Progress,
    judged: list[Judged],
    audited: list[Disagreement],
) -> str:
    """Markdown text.

    Args:
        spec: of the tuning.
        limits: their names, in the order of `at.best_limits`.
        at: where the tuning ended.
        judged: the study's own design, then the tuned one.
        audited: derivatives against differences at the tuned design.
    """
    before, after = judged
    k = at.winner
    lines = [f"# {spec.study.title}: tuning", ""]
    lines += [
        f"{spec.tune.starts} starts, {int(at.iteration)} iterations, "
        f"{spec.tune.scenarios.count} scenarios; start {k + 1} is the best"
        + (f"; {at.is_frozen.sum()} starts were frozen." if at.is_frozen.any() else "."), "",
        f"On {spec.tune.scenarios.check} scenarios that the tuning has not seen, with the real "
        "converters and limits:", "",
        "| figure | before | tuned | change |", "|---|---|---|---|",
    ]  # fmt: skip
    rows = [("objective, mean", before.objective.mean(), after.objective.mean())]
    rows += [("objective, worst", before.objective.max(), after.objective.max())]
    rows += [("objective, the study's own machine", before.objective[0], after.objective[0])]
    for name in before.metrics:
        rows += [(f"{name}, worst", before.metrics[name].max(), after.metrics[name].max())]
    rows += [("gain margin, 12 modes", before.gain_margin, after.gain_margin)]
    for name, a, b in rows:
        change = f"{100 * (b / a - 1):+.1f} %" if a else ""
        lines.append(f"| {name} | {a:.5g} | {b:.5g} | {change} |")
    lines += ["", f"Statuses before: {_codes(before)}; tuned: {_codes(after)}.", ""]
    seen = at.best_objective[k]
    lines += [
        f"On the scenarios of the tuning, with smooth limits, the objective is {seen:.5g}; on "
        f"fresh ones it is {100 * (after.objective.mean() / seen - 1):+.1f} % higher.", "",
        "## Numbers", "", "| free number | from | tuned | bounds |", "|---|---|---|---|",
    ]  # fmt: skip
    values = spec.free.values(at.best_place[k])
    for free, value, place in zip(spec.free.numbers, values, at.best_place[k], strict=True):
        edge = " (at its bound)" if place in (0.0, 1.0) else ""
        start = f"{free.start:.5g}" if np.isfinite(free.start) else "-"
        bounds = f"{free.span.low:g} to {free.span.high:g}"
        lines.append(f"| {free.name} | {start} | {value:.5g}{edge} | {bounds} |")
    lines += ["", "## Limits", ""]
    for name, excess in zip(limits, at.best_limits[k], strict=True):
        lines.append(f"- {name} = {spec.tune.limits[name]:g}: {_told(name, float(excess))}")
    lines += ["" if limits else "None.\n", "## Derivatives", ""]
    worst = max(audited, key=lambda entry: entry.share)
    lines.append(
        f"Against central differences at the tuned design the worst disagreement is "
        f"{worst.share:.1e}, of {worst.figure} by {worst.name}."
    )
    return "\n".join(lines) + "\n"


def _codes(judged: Judged) -> str:
    codes, counts = np.unique(judged.status, return_counts=True)
    return ", ".join(f"{count} of code {code}" for code, count in zip(codes, counts, strict=True))


def _told(name: str, excess: float) -> str:
    if excess > KEPT:
        return "**violated**" + ("" if name in LOOP_LIMITS else f" by {100 * excess:.2f} %")
    state = "active" if excess > -NEAR else "not active"
    return state if name in LOOP_LIMITS else f"{state}, {-100 * excess:.2f} % below it"
