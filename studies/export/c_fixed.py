"""C99 of a controller in fixed point."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from studies.engine.blocks import ModalBlocks
from studies.engine.channels import ActiveChannels
from studies.engine.controller import FixedController
from studies.export.c_text import Source, source
from studies.export.fixed import FixedPoint, IntegerRow, shaper_row
from studies.export.fixed_blocks import FixedBlocks


def fixed_source(
    exported: FixedController,
    fixed: FixedPoint | FixedBlocks,
    name: str,
    origin: Iterable[str],
    cost: str,
) -> Source:
    """Controller in fixed point.

    Args:
        exported: the controller.
        fixed: the same in integers.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
        cost: cost of a sample, for the file's header.
    """
    shaper, wires = shaper_row(exported.taps), fixed.wires
    return source(
        "fixed.c",
        exported,
        name,
        origin,
        fixed=fixed,
        word="int32_t",
        count=f"int{wires.word}_t",
        word_bits=wires.word,
        wire="uint16_t",
        formats=[
            f"{name:<30}{bits:>4}{base:>20}{room:>9}{reach:>9}".rstrip()
            for name, bits, base, room, reach in format_rows(fixed, exported)
        ],
        cost=cost,
        code=wires.sensor_step * 2.0**wires.adc_bits,
        weight=shaper.integers[0],
        weight_shift=shaper.shift[0],
        feedthrough=_rows(wires.feedthrough, exported.n_patches),
        **_constants(exported.channels, fixed),
    )


def _constants(
    channels: ActiveChannels | ModalBlocks, fixed: FixedPoint | FixedBlocks
) -> dict[str, Any]:
    if isinstance(fixed, FixedBlocks):
        advance, leave, windup = fixed.advance, fixed.leave, fixed.anti_windup
        return {
            "advance": advance.integers.reshape(-1, advance.integers.shape[-1]),
            "advance_shift": advance.shift.ravel(),
            "leave": leave.integers.reshape(-1, leave.integers.shape[-1]),
            "leave_shift": leave.shift.ravel(),
            "windup": _rows(windup, leave.shift.shape[1]),
            "windup_shift": None if windup is None else windup.shift.ravel(),
        }
    assert isinstance(channels, ActiveChannels)
    first, memory, numerator = fixed.high_pass, fixed.memory, fixed.numerator.integers
    each = np.arange(len(channels.link))
    return {
        "first_mode": np.searchsorted(channels.link, np.arange(4)),
        "high_pass": np.hstack([first.integers, memory.integers]),
        "high_pass_shift": np.stack([first.shift, memory.shift], axis=1),
        "force": numerator[:, :3],
        "direct": numerator[:, 3],
        "synthesizer": fixed.synthesizer.integers[channels.link, :, each],
        "energy": _rows(fixed.energy, 4),
        "energy_names": [
            f"{c}, {what}" for c in channels.names for what in ("velocity", "position")
        ],
    }


def _rows(table: IntegerRow | None, length: int) -> np.ndarray | None:
    """Integers of an optional table, in rows of this length."""
    return None if table is None else table.integers.reshape(-1, length)


def format_rows(fixed: FixedPoint | FixedBlocks, exported: FixedController) -> list[list[str]]:
    """Table of formats, headings first; word range and reach of ADC codes in units of the base."""
    rows = [["signal", "Q", "base", "room", "reach"]]
    rows.append(["sensors", str(fixed.wires.adc_bits), "1 code", "", ""])
    for m, name in enumerate(exported.channels.names):
        for text, form, unit in fixed.formats:
            base, bits = form.base[m], str(form.bits[m])
            shown = f"{base:.9e} {unit if exported.is_modal else 'V'}"
            room, reach = f"{form.largest[m] / base:.0f}", f"{form.bound[m] / base:.1f}"
            rows.append([f"{text}, {name}", bits, shown, room, reach])
    return rows
