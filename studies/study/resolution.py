"""What the controller can measure: deflections below one ADC step, in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxmodel.metrics import METRICS
from studies.study.paths import NAMED_INDEX, parse_entry


def is_deflection(name: str) -> bool:
    """Whether a metric, or the one that this is an entry of, is a deflection of links [m]."""
    metric = METRICS.get(name.partition("[")[0])
    return metric is not None and metric.unit == "m" and "link" in metric.dims


def least_step(name: str, adc_step: Any, links: tuple[int, ...]) -> float:
    """One ADC step of the links that a deflection is taken over, the smallest of theirs [m].

    Args:
        name: of the metric or an entry of it.
        adc_step: of every link, in the deflection of mode 1 [m], (3,).
        links: those that count if the name gives none, from 0.
    """
    named = [int(k) - 1 for axis, k in NAMED_INDEX.findall(name) if axis == "link"]
    plain = parse_entry(NAMED_INDEX.sub("", name))
    if not named and plain is not None:
        named = list(plain.indices[:1])  # links are the first axis
    return float(np.min(np.asarray(adc_step)[named or list(links)]))


def resolution_text(name: str, values: Any, step: Any, what: str) -> str:
    """Warning that values are below one ADC step, "" if none is.

    Args:
        name: of the metric.
        values: of it [m].
        step: one ADC step in the deflection of mode 1, of all or of each [m].
        what: one value belongs to: "case", "design".
    """
    values = np.asarray(values)
    is_low = values < step
    low = int(np.sum(is_low))
    if not low:
        return ""
    step = float(np.max(np.broadcast_to(step, values.shape)[is_low]))
    verb = "is" if low == 1 else "are"
    which = f"this {what}" if len(values) == 1 else f"{low} of these {len(values)} {what}s"
    return (
        f"{name} of {which} {verb} below one ADC step of {1e6 * step:.3g} µm: the controller "
        "cannot measure these differences."
    )
