"""C99 of a controller in floating point."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from studies.engine.blocks import BlockFlow
from studies.engine.channels import ChannelFlow
from studies.engine.controller import FixedController
from studies.export.c_text import Source, real, source


def floating_source(found: FixedController, name: str, origin: Iterable[str]) -> Source:
    """Controller in double or single precision.

    Args:
        found: the controller.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
    """
    return source(
        "floating.c",
        found,
        name,
        origin,
        fixed=None,
        word=f"{name}_real",
        wire=f"{name}_real",
        is_modal=found.is_modal,
        feedthrough=found.controller.feedthrough.reshape(-1, found.n_patches),
        weight=found.taps.weight,
        real=real,
        **_constants(found.channels),
    )


def _constants(arranged: ChannelFlow | BlockFlow) -> dict[str, Any]:
    if isinstance(arranged, ChannelFlow):
        energy = arranged.energy
        return {
            "has_rivals": energy is not None,
            "velocity": None if energy is None else energy[:, 0, :3],
            "position": None if energy is None else energy[:, 1],
        }
    system = arranged.system
    size = system.direct.shape[1]
    return {
        "has_rivals": False,
        "state_rows": system.state.reshape(-1, 2),
        "enter_rows": system.enter.reshape(-1, size),
        "leave_rows": system.leave.reshape(len(system.leave) * size, -1),
        "direct_rows": system.direct.reshape(-1, size),
    }
