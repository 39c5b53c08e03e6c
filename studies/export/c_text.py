"""Text of a C module: constants as tables, put into the templates beside this file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np

from studies.engine.channels import Channels
from studies.engine.controller import FixedController
from studies.export.fixed import rail_samples

_TEMPLATES = Path(__file__).parent / "templates"


class Source(NamedTuple):
    """A C module: text of `<name>.h` and `<name>.c`."""

    header: str
    code: str


class Table(NamedTuple):
    """One static constant."""

    type: str
    name: str
    values: Any  # one number, or an array of up to two axes
    comment: str  # [unit] meaning; where it comes from
    rows: list[str] = []  # meaning of each row


def section_comments(found: FixedController) -> tuple[str, str]:
    """What the two sections of the velocity estimate are, and where their numbers come from."""
    if found.study.electronics.estimator == "difference":
        return (
            "difference behind a low-pass; electronics.difference_cutoff_hz",
            "no second section for the estimator `difference`",
        )
    return (
        "high-pass; electronics.highpass_hz",
        "low-pass; electronics.lowpass_ratio, lowpass_zeta, antialias_hz",
    )


#: Where the gains come from.
GAINS = "-k_d n_v - k_p n_x; control.gain_factor, velocity_gain, position_gain, ratios, gain_unit"


class Rivals(NamedTuple):
    """What serves one channel of a link at a time, in one kind of arithmetic."""

    declare: str  # variables
    weigh: str  # energy of channel m
    choose: str  # whose forces stay
    apply: str = ""  # the force of a channel on the actuators at once, where all act


class Parts(NamedTuple):
    """What sets one kind of arithmetic apart; @ stands for the prefix in capitals."""

    template: str  # file of the code
    tables: list[Table]
    header: dict[str, Any]  # for the header's template
    command_type: str  # of what is remembered of the last command, if anything is
    subtract_feedthrough: str
    keep_command: str
    direct: str  # share of the force past the filters
    rivals: Rivals  # where channels act one at a time
    more: dict[str, str] = {}  # for the code's template


def patch_names(found: FixedController) -> list[str]:
    """Names of sensors or actuators, for comments."""
    return [f"link {i + 1}, patch {k + 1}" for i in range(3) for k in range(found.n_patches)]


def structure_tables(channels: Channels) -> list[Table]:
    """Which links and channels there are."""
    used = np.isin(np.arange(3), channels.link)
    return [
        Table("uint16_t", "IS_USED", used.astype(int), "1: link is controlled; control.links"),
        Table("uint16_t", "LINK", channels.link, "link of each controlled mode, from 0; control"),
    ]


def rival_table(channels: Channels) -> Table:
    """Which channels act one at a time."""
    comment = "1: acts where no other one of its link has more energy; control.law"
    return Table("uint16_t", "IS_RIVAL", channels.is_rival.astype(int), comment)


def shaper_tables(found: FixedController, kind: str, weight: np.ndarray) -> list[Table]:
    """The input shaper's taps."""
    name = f"input shaper {found.study.shaper.kind}; shaper"
    return [
        Table("macro", "N_TAPS", len(weight), f"taps of the {name}"),
        Table(kind, "WEIGHT", weight, f"[1] of each tap of the {name}"),
        Table("uint32_t", "DELAY", found.taps.sample, f"[samples] of each tap of the {name}"),
    ]


def filled(parts: Parts, found: FixedController, name: str, origin: Iterable[str]) -> Source:
    """Header and code from their templates.

    Args:
        parts: constants, and what is special.
        found: the controller.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
    """
    electronics = found.study.electronics
    rate = electronics.sample_rate_hz
    rail = rail_samples(rate)
    has_memory = any(table.name == "FEEDTHROUGH" for table in parts.tables)
    kept = f"    {parts.command_type} command[@_N_CHANNELS]; /* on the actuators now */"
    members = [*parts.header["members"], *([kept] if has_memory else [])]
    header = parts.header | {
        "members": "\n".join(members),
        "border": starred(parts.header["border"]),
        "n_links": 3,
        "n_patches": found.n_patches,
        "n_channels": 3 * found.n_patches,
        "kind": f"{found.channels.kind}s".replace("patchs", "patches"),
        "settle": found.channels.memory(1e-4),
        "adc_bits": electronics.adc_bits,
        "adc_range": f"{electronics.adc_range:g}",
        "gain": f"{electronics.conditioner_gain:g}",
        "bias": f"{electronics.conditioner_bias:g}",
        "antialias": f"{electronics.antialias_hz:g}",
        "n_modes": len(found.channels.link),
        "rate": f"{rate:g}",
        "rate_literal": literal(rate),
        "rail": rail,
        "rail_ms": f"{1e3 * rail / rate:.3g}",
        "shaper_length": int(found.taps.sample.max()) + 1,
    }
    common = {
        "name": name,
        "NAME": name.upper(),
        "origin": starred(origin),
        "forget_command": "        state->command[k] = 0;\n" if has_memory else "",
    }
    code = parts.more | {
        "state": _template("state.c").substitute(common | header).rstrip(),
        "subtract_feedthrough": parts.subtract_feedthrough if has_memory else "",
        "keep_command": parts.keep_command if has_memory else "",
        "direct": parts.direct if found.channels.has_direct else "",
        "rivals": parts.rivals.declare,
        "weigh": parts.rivals.weigh,
        "choose": parts.rivals.choose,
        "apply": parts.rivals.apply,
        "more_reals": ", rate, place" if parts.rivals.weigh else "",
        "tables": "\n\n".join(_constant(table) for table in parts.tables),
    }
    texts = (
        _template(file).substitute(common | values).replace("@_", f"{name.upper()}_")
        for file, values in (("controller.h", header), (parts.template, code))
    )
    return Source(*texts)


def _template(file: str) -> Template:
    return Template((_TEMPLATES / file).read_text(encoding="utf-8"))


def _constant(table: Table) -> str:
    """A constant in C."""
    values = np.asarray(table.values)

    def number(value: Any) -> str:
        return f"R({literal(value)})" if table.type == "real" else str(int(value))

    comment = f"/* {_plain(table.comment)} */\n"
    if table.type == "macro":
        return f"{comment}#define {table.name} {number(values)}"
    if values.ndim == 0:
        return f"{comment}static const {table.type} {table.name} = {number(values)};"
    size = "".join(f"[{n}]" for n in values.shape)
    start = f"{comment}static const {table.type} {table.name}{size} = {{"
    if values.ndim == 1:
        return start + _wrapped([number(value) for value in values]) + "};"
    rows = table.rows or [""] * len(values)
    lines = [
        f"    {{{', '.join(map(number, row))}}}," + (f" /* {note} */" if note else "")
        for row, note in zip(values, rows, strict=True)
    ]
    return "\n".join([start, *lines, "};"])


def _wrapped(numbers: list[str]) -> str:
    if len(numbers) <= 9 and sum(map(len, numbers)) < 60:
        return ", ".join(numbers)
    rows = [", ".join(numbers[k : k + 3]) for k in range(0, len(numbers), 3)]
    return "\n    " + ",\n    ".join(rows) + "\n"


def literal(value: Any) -> str:
    """A double in C, with all its digits."""
    text = repr(float(value))
    return text if any(mark in text for mark in ".en") else text + ".0"


def starred(lines: Iterable[str]) -> str:
    """Lines of a C comment."""
    return "\n".join(f" * {_plain(line)}".rstrip() for line in lines)


def _plain(text: str) -> str:
    """Text that can stand in a comment: printable ASCII that does not end it."""
    plain = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    # no line that goes on, no trigraph, no end of the comment
    plain = re.sub(r"\?(?=\?)", "? ", plain.replace("\\", "/"))
    return plain.replace("*/", "* /").replace("/*", "/ *")
