"""Gain margins in words, and the bounds of the search."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from jaxmodel.hysteresis import PLAYS, slope_at_limit
from jaxmodel.loop_figures import HIGHEST, MOST_DELAY, MOST_PHASE, guaranteed_range

#: Margins below this are pointed out [1].
ENOUGH = 2.0


#: What stands beside margins and proofs.
GUESSED = (
    "Margins and proofs rest on the damping of longitudinal modes, link.stretch_damping, which is "
    "a guess until it is measured; with link.stretch = false they leave these modes out."
)
#: Other dampings of longitudinal modes at which a design's margin is told [1].
DAMPINGS = (0.003, 0.01, 0.03, 0.1)


def caution(margin: float) -> str:
    """Warning about a gain margin, "" if it is `ENOUGH` or there is none."""
    if margin == 0:
        return (
            "UNSTABLE LOOP: the linearised sampled loop grows by itself, however small the gains."
        )
    if margin < 1:
        return (
            "UNSTABLE LOOP: the linearised sampled loop grows by itself; saturation and the end of "
            "the run bound what is seen here. Lower the gains below "
            f"{margin:.3g} of these."
        )
    if margin < ENOUGH:
        return (
            f"CAUTION: a gain margin of {margin:.3g}; below {ENOUGH:g} a machine may go unstable."
        )
    return ""


def stretch_text(margins: Mapping[float, float] | None) -> str:
    """Gain margins by the damping of longitudinal modes, in one line."""
    if margins is None:
        return GUESSED
    each = ", ".join(
        f"{margin_text(value, 3)} at {100 * zeta:g} %" for zeta, value in margins.items()
    )
    return f"gain margin by the damping of longitudinal modes, link.stretch_damping: {each}"


def hysteresis_text(width: float) -> str:
    """What hysteresis of the actuators means for margins, "" without.

    Args:
        width: `patches.hysteresis` [1].
    """
    if width == 0:
        return ""
    return (
        f"Actuators have hysteresis (patches.hysteresis = {width:g}): margins and certificates are "
        f"those of signals below {PLAYS[0]:g} of electronics.voltage_limit; up to that limit the "
        f"same volts push up to {slope_at_limit(width):.3g} times as hard."
    )


def margin_text(value: float, digits: int = 4) -> str:
    """A gain margin in words; the search ends at `HIGHEST`. NaN: there is no sampled loop."""
    if math.isnan(value):
        return "none"
    return f"> {HIGHEST:g}" if value >= HIGHEST else f"{value:.{digits}g}"


def margin_in_db(value: float, digits: int = 4) -> str:
    """A gain margin as a factor and in decibels, for a sentence: "3.7 (11.4 dB)"."""
    text = margin_text(value, digits)
    return f"{text} ({20 * math.log10(min(value, HIGHEST)):.1f} dB)" if value > 0 else text


def robustness_text(figures: Mapping[str, Any]) -> str:
    """Disk, phase and delay margin for a sentence, with what the first one guarantees."""
    disk, phase, delay = (
        float(figures[name]) for name in ("disk_margin", "phase_margin", "delay_margin")
    )
    if disk == 0:
        return "disk, phase and delay margin 0"
    gain, turn = map(float, guaranteed_range(disk))
    any_gain = "any gain" if math.isinf(gain) else f"a gain of +-{gain:.3g} dB"
    return (
        f"disk margin {disk:.3g} (every actuator at once may be off by {any_gain}, or by a phase "
        f"of +-{turn:.3g} deg); all actuators alike: phase margin "
        f"{'any' if phase >= MOST_PHASE else f'{phase:.3g} deg'}, delay margin "
        f"{delay_text(delay)} samples"
    )


def delay_text(value: float) -> str:
    """A delay margin in words, without its unit; the search ends at `MOST_DELAY`."""
    return f"> {MOST_DELAY:g}" if value >= MOST_DELAY else f"{value:.3g}"
