"""A C module from the templates next to this file: they hold the code, this file the numbers.

Templates: `controller.h`; `floating.c` and `fixed.c`, one for each arithmetic; `shared.c`, what
both have in common.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from studies.engine.blocks import ModalBlocks
from studies.engine.channels import ActiveChannels
from studies.engine.controller import FixedController
from studies.export.fixed import rail_samples
from studies.show.pages import render


class Source(NamedTuple):
    """A C module: text of `<name>.h` and `<name>.c`."""

    header: str
    code: str


def source(
    template: str, exported: FixedController, name: str, origin: Iterable[str], **values: Any
) -> Source:
    """Header and code from their templates.

    Args:
        template: file of the code.
        exported: the controller.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
        values: for one kind of arithmetic: `word` and `wire`, the types of stored values and of
            sensors and actuators; `fixed`, the controller in integers or None; `weight` of the
            shaper's taps; and what only this code needs.
    """
    channels, electronics = exported.channels, exported.study.electronics
    rail = rail_samples(electronics.sample_rate_hz)
    has_feedthrough = bool(np.any(exported.controller.feedthrough))
    values |= {
        "name": name,
        "NAME": name.upper(),
        "origin": [plain(line) for line in origin],
        "controller": exported.controller,
        **_channel_values(channels),
        "electronics": electronics,
        "shaper": exported.study.shaper.kind,
        "machine": exported.study.mechanism.text,
        "n_links": exported.n_links,
        "n_pose": exported.structure.n_pose,
        "n_patches": exported.n_patches,
        "is_used": np.isin(np.arange(exported.n_links), channels.link).astype(int),
        "patches": [
            f"link {i + 1}, patch {k + 1}"
            for i in range(exported.n_links)
            for k in range(exported.n_patches)
        ],
        "has_feedthrough": has_feedthrough,
        "has_first": has_feedthrough or isinstance(channels, ActiveChannels),
        "rail": rail,
        "rail_ms": f"{1e3 * rail / electronics.sample_rate_hz:.3g}",
        "settle": channels.memory(1e-4),
        "delay": exported.taps.sample,
        "shaper_length": int(exported.taps.sample.max()) + 1,
        "exact": exact,
        "array": array,
    }
    files = ("controller.h", template)
    return Source(*(render(f"export/templates/{file}", **values) for file in files))


def _channel_values(channels: ActiveChannels | ModalBlocks) -> dict[str, Any]:
    """What templates read of channels, or of blocks; the other is None."""
    if isinstance(channels, ActiveChannels):
        return {
            "blocks": None,
            "channels": channels,
            "has_anti_windup": False,
            "is_rival": channels.is_rival.astype(int),
        }
    groups, n, block, size = channels.system.enter.shape
    ports = [f"system {g + 1}, actuator {k + 1}" for g in range(groups) for k in range(size)]
    return {
        "blocks": channels,
        "channels": None,
        "has_anti_windup": channels.system.anti_windup is not None,
        "order": n * block,
        "block": block,
        "n_ports": size,
        "port_names": ports,
    }


def exact(value: Any) -> str:
    """A double in C, with all its digits."""
    text = repr(float(value))
    return text if any(mark in text for mark in ".en") else text + ".0"


def real(value: Any) -> str:
    """A number in the precision the code is compiled for."""
    return f"R({exact(value)})"


def array(values: Any, notes: Iterable[str] = ()) -> str:
    """What follows the name of a constant array: its size and its values.

    Args:
        values: whole numbers, or others that become `real`; one axis or two.
        notes: for two axes, the meaning of each row; none: no comments.
    """
    values = np.asarray(values)
    write = real if values.dtype.kind == "f" else str
    size = "".join(f"[{n}]" for n in values.shape)
    if values.ndim == 1:
        return f"{size} = {{{_wrap([write(value) for value in values])}}}"
    remarks = [f" /* {note} */" for note in notes] or [""] * len(values)
    rows = [
        f"    {{{', '.join(map(write, row))}}},{remark}\n"
        for row, remark in zip(values, remarks, strict=True)
    ]
    return f"{size} = {{\n{''.join(rows)}}}"


def _wrap(numbers: list[str]) -> str:
    if len(numbers) <= 9 and sum(map(len, numbers)) < 60:
        return ", ".join(numbers)
    rows = [", ".join(numbers[k : k + 3]) for k in range(0, len(numbers), 3)]
    return "\n    " + ",\n    ".join(rows) + "\n"


def plain(text: str) -> str:
    """Text that is safe in a comment: printable ASCII that does not end it."""
    plain = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    # no line continuation, no trigraph, no end of comment
    plain = re.sub(r"\?(?=\?)", "? ", plain.replace("\\", "/"))
    return plain.replace("*/", "* /").replace("/*", "/ *")
