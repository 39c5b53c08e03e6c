"""C99 of a controller in floating point."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from studies.engine.blocks import ModalBlocks
from studies.engine.channels import ActiveChannels
from studies.engine.controller import FixedController
from studies.export.c_text import Source, real, source


def floating_source(exported: FixedController, name: str, origin: Iterable[str]) -> Source:
    """Controller in double or single precision.

    Args:
        exported: the controller.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
    """
    return source(
        "floating.c",
        exported,
        name,
        origin,
        fixed=None,
        word=f"{name}_real",
        count=f"{name}_real",
        wire=f"{name}_real",
        is_modal=exported.is_modal,
        feedthrough=exported.controller.feedthrough.reshape(-1, exported.n_patches),
        weight=exported.taps.weight,
        real=real,
        **_constants(exported.channels),
    )


def _constants(channels: ActiveChannels | ModalBlocks) -> dict[str, Any]:
    if isinstance(channels, ActiveChannels):
        energy = channels.energy
        return {
            "has_rivals": energy is not None,
            "velocity": None if energy is None else energy[:, 0, :3],
            "position": None if energy is None else energy[:, 1],
        }
    system = channels.system
    size = system.direct.shape[1]
    return {
        "has_rivals": False,
        "state_rows": system.state.reshape(-1, system.state.shape[3]),
        "enter_rows": system.enter.reshape(-1, size),
        "leave_rows": system.leave.reshape(len(system.leave) * size, -1),
        "direct_rows": system.direct.reshape(-1, size),
        "windup_rows": None if system.anti_windup is None else system.anti_windup.reshape(-1, size),
    }
