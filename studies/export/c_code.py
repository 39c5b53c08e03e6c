"""C99 of a controller: tables of constants put into the templates."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.shaper import Taps
from studies.export.channels import Channels
from studies.export.controller import FixedController
from studies.export.fixed import WORD, FixedPoint, Format, Row, rail_samples, shaper_row

_TEMPLATES = Path(__file__).parent / "templates"


class Source(NamedTuple):
    """A C module: text of `<name>.h` and `<name>.c`."""

    header: str
    code: str


class Table(NamedTuple):
    """One static constant."""

    type: str
    name: str
    values: np.ndarray
    comment: str
    rows: list[str] = []  # meaning of each row, a comment beside it


def floating_source(
    found: FixedController, channels: Channels, name: str, origin: Iterable[str]
) -> Source:
    """Controller in double or single precision.

    Args:
        found: the controller.
        channels: the same, folded.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
    """
    controller, names = found.controller, _names(channels)
    is_modal = found.study.control.law == "imsc"
    unit = ("m/V", "N/m", "V/N") if is_modal else ("1", "1", "1")
    rate = "1" if found.study.electronics.estimator == "modal_phase" else "1/s"
    real = "real"
    tables = [
        *_which(found, channels),
        Table(real, "ADC_STEP", controller.adc_step, "[V] one code at the ADC; adc_range, adc_bits"),
        Table(real, "ADC_TOP", controller.adc_top * controller.adc_step, "[V] highest code; adc_range"),
        Table(real, "BIAS", controller.adc_bias, "[V] at the ADC, sensor at rest; conditioner_bias"),
        Table(real, "CONDITIONER_GAIN", controller.adc_gain, "[1] ADC volt per sensor volt; conditioner_gain"),
        Table(real, "LIMIT", controller.voltage_limit, "[V] of every actuator, +-; voltage_limit"),
        *(
            [Table(
                real, "FEEDTHROUGH", controller.feedthrough.reshape(-1, found.n_patches),
                "[1] sensor volts per volt of each actuator of the link, by modes that are not "
                "controlled; control.feedthrough_factor", _patch_names(found),
            )] if np.any(controller.feedthrough) else []
        ),
        Table(
            real, "FILTER", channels.filter, f"[{unit[0]}] modal filter pinv(lambda_s Phi_s^t): "
            "signal per volt of each sensor of the link", names,
        ),
        Table(
            real, "HIGH_PASS", channels.first, f"[{rate}, {rate}, 1] b0, b1, a1 of the first "
            "section of the velocity estimate; electronics.highpass_hz or difference_cutoff_hz", names,
        ),
        Table(
            real, "LOW_PASS", channels.denominator, "[1] a1, a2 of the second section; "
            "electronics.lowpass_ratio and lowpass_zeta", names,
        ),
        Table(
            real, "FORCE", channels.force, f"[{unit[1]}] numerator of the second section times the "
            "gains, -k_d n_v - k_p n_x; control", names,
        ),
        *(
            [Table(real, "DIRECT", channels.direct, f"[{unit[1]}] force past the filters")]
            if channels.has_direct else []
        ),
        Table(
            real, "SYNTHESIZER", channels.synthesizer, f"[{unit[2]}] voltage of each actuator of "
            "the link per force, pinv(lambda_a Phi_a)", names,
        ),
        *_shaper(found, real, Row(found.taps.weight[None], np.zeros(1, int)), False),
    ]  # fmt: skip
    members = [
        f"    {name}_real high[@_N_MODES]; /* memory of the first section */",
        f"    {name}_real line[@_N_MODES][2]; /* delay line of the second section */",
    ]
    step = controller.adc_step
    header = {
        "border": [
            "Sensors: volts at the ADC's input, the code times @_ADC_STEP; conditioner gain and",
            "bias are taken off here. Actuators: volts at the piezo patch, so divide by the gain",
            "of the amplifier. A sensor is faulty if it is no number or out of range, or too long",
            "at one end of it.",
        ],
        "types": "/* double, or float with -D@_REAL=float. */\n#ifndef @_REAL\n"
        f"#define @_REAL double\n#endif\ntypedef @_REAL {name}_real;\n",
        "constants": f"#define @_ADC_STEP {_literal(step)} /* V per code */\n"
        f"#define @_LIMIT {_literal(controller.voltage_limit)} /* V, of every actuator, +- */",
        "members": members,
        "faulty": "not a number, out of range or stuck at one end of it",
        "sensor_type": f"{name}_real", "actuator_type": f"{name}_real",
        "reference_type": f"{name}_real", "reference_unit": ", in any units",
    }  # fmt: skip
    through = (
        "    for (k = 0; k < @_N_CHANNELS; k++) {\n"
        "        first = @_N_PATCHES * (k / @_N_PATCHES);\n"
        "        for (m = 0; IS_USED[k / @_N_PATCHES] && m < @_N_PATCHES; m++) {\n"
        "            volt[k] -= FEEDTHROUGH[k][m] * state->command[first + m];\n"
        "        }\n    }\n"
    )
    code = {
        "subtract_feedthrough": through,
        "keep_command": "        state->command[k] = wanted[k];\n",
        "command_type": f"{name}_real",
        "direct": "\n            + DIRECT[m] * signal",
    }
    return _filled("floating.c", found, channels, name, origin, tables, header, code)


def fixed_source(
    found: FixedController,
    channels: Channels,
    fixed: FixedPoint,
    name: str,
    origin: Iterable[str],
    cost: str,
) -> Source:
    """Controller in fixed point; cost: what a sample costs, for the file's head."""
    names = _names(channels)
    is_modal = found.study.control.law == "imsc"
    integer = "int32_t"
    first = np.searchsorted(channels.link, np.arange(4))
    back = fixed.synthesizer
    own = back.integers[channels.link, :, np.arange(len(channels.link))]
    shaper = shaper_row(found.taps)
    numerator = fixed.numerator.integers
    tables = [
        *_which(found, channels),
        Table("uint16_t", "FIRST_MODE", first, "first channel of each link, and the end"),
        Table("uint16_t", "ADC_TOP", np.array(fixed.adc_top), "[code] highest one; electronics.adc_bits"),
        Table(integer, "ADC_UNIT", np.array(2**fixed.adc_bits), "[count] of a sensor per code"),
        Table("int64_t", "BIAS", np.array(fixed.bias), "[count] sensor at rest; conditioner_bias"),
        Table(integer, "DAC_REST", np.array(fixed.dac_rest), "[code] of 0 V at an actuator"),
        *_with_shift(
            integer, "FEEDTHROUGH", fixed.feedthrough, (3 * found.n_patches, found.n_patches),
            "sensor counts per code of each actuator of the link; control.feedthrough_factor",
            _patch_names(found),
        ),
        *_with_shift(
            integer, "FILTER", fixed.filter, None,
            "modal filter pinv(lambda_s Phi_s^t): sensor counts to signal counts", names,
        ),
        Table(
            integer, "HIGH_PASS", np.hstack([fixed.high_pass.integers, fixed.memory.integers]),
            "b0; b1, -a1 of the first section; electronics.highpass_hz", names,
        ),
        Table(
            "uint8_t", "HIGH_PASS_SHIFT", np.stack([fixed.high_pass.shift, fixed.memory.shift], 1),
            "[bit] of b0; of b1 and -a1",
        ),
        *_with_shift(
            integer, "LOW_PASS", fixed.low_pass, None, "scale, -a1, -a2 of the second section; "
            "electronics.lowpass_ratio and lowpass_zeta", names,
        ),
        *_with_shift(
            integer, "FORCE", Row(numerator[:, :3], fixed.numerator.shift), None,
            "numerator of the second section times the gains; control", names,
        ),
        *(
            [Table(integer, "DIRECT", numerator[:, 3], "force past the filters; FORCE_SHIFT")]
            if channels.has_direct else []
        ),
        Table(
            integer, "SYNTHESIZER", own, "pinv(lambda_a Phi_a): force counts to codes of each "
            "actuator of the link", names,
        ),
        Table("uint8_t", "SYNTHESIZER_SHIFT", back.shift.ravel(), "[bit] of each actuator"),
        *_shaper(found, integer, shaper, True),
    ]  # fmt: skip
    tables = [t._replace(type="uint16_t") if t.type == "uint8_t" else t for t in tables]
    volts = float(found.controller.voltage_limit)
    header = {
        "border": [
            f"Sensors: codes of the ADC, 0 to {fixed.adc_top}. Actuators: codes of the DAC, 1 to",
            f"{2 * fixed.dac_rest - 1} for {-volts:g} to {volts:g} V at the piezo patch, "
            f"{fixed.dac_rest} for 0 V. A sensor is faulty",
            "if its code is too high or too long at one end of the range.",
        ],
        "types": "",
        "constants": f"#define @_DAC_REST {fixed.dac_rest} /* code of 0 V */\n"
        f"#define @_DAC_STEP {_literal(fixed.dac_step)} /* V per code at the patch */",
        "members": [
            "    int32_t high[@_N_MODES]; /* memory of the first section */",
            "    int32_t line[@_N_MODES][2]; /* delay line of the second section */",
        ],
        "faulty": "a code beyond the ADC's, or stuck at one end",
        "sensor_type": "uint16_t", "actuator_type": "uint16_t",
        "reference_type": "int32_t",
        "reference_unit": ", each in any unit that fits 32 bits",
    }  # fmt: skip
    through = (
        "    for (k = 0; k < @_N_CHANNELS; k++) {\n"
        "        first = @_N_PATCHES * (k / @_N_PATCHES);\n"
        "        sum = 0;\n"
        "        for (m = 0; m < @_N_PATCHES; m++) {\n"
        "            sum += (int64_t)FEEDTHROUGH[k][m] * state->command[first + m];\n"
        "        }\n"
        "        sensed[k] = limited(sensed[k] - shifted(sum, FEEDTHROUGH_SHIFT[k]));\n"
        "    }\n"
    )
    code = {
        "subtract_feedthrough": through,
        "keep_command": "        state->command[k] = command;\n",
        "command_type": "int32_t",
        "direct": "\n            + (int64_t)DIRECT[m] * signal",
        "formats": _starred(format_lines(fixed, channels, is_modal)),
        "cost": cost,
    }
    return _filled("fixed.c", found, channels, name, origin, tables, header, code)


def format_lines(fixed: FixedPoint, channels: Channels, is_modal: bool) -> list[str]:
    """Table of formats; room of the word and reach of ADC codes in units of `one per unit`."""
    value, force = ("m", "N") if is_modal else ("V", "V")
    lines = [
        f"{'signal':<30}{'format':>7}{'one per unit':>16}{'room':>10}{'codes':>10}",
        f"{'sensors':<30}{f'Q{fixed.adc_bits}':>7}{'1 code':>16}",
    ]
    parts: list[tuple[str, Format, str]] = [
        ("signal", fixed.signal, value), ("high-passed", fixed.high, value),
        ("delay line", fixed.inner, value), ("force", fixed.force, force),
    ]  # fmt: skip
    for m, name in enumerate(_names(channels)):
        for text, form, unit in parts:
            lines.append(
                f"{f'{text}, {name}':<30}{f'Q{form.bits[m]}':>7}"
                f"{f'{form.base[m]:.4g} {unit}':>16}{2.0 ** (WORD - 1 - form.bits[m]):>10.0f}"
                f"{form.bound[m] / form.base[m]:>10.1f}"
            )
    return lines


def _names(channels: Channels) -> list[str]:
    return [
        f"link {i + 1}, mode {j + 1}" for i, j in zip(channels.link, channels.mode, strict=True)
    ]


def _patch_names(found: FixedController) -> list[str]:
    return [f"link {i + 1}, patch {k + 1}" for i in range(3) for k in range(found.n_patches)]


def _which(found: FixedController, channels: Channels) -> list[Table]:
    used = np.isin(np.arange(3), channels.link)
    return [
        Table("uint16_t", "IS_USED", used.astype(int), "1: link is controlled; control.links"),
        Table("uint16_t", "LINK", channels.link, "link of each channel, from 0; control"),
    ]


def _shaper(found: FixedController, kind: str, row: Row, is_fixed: bool) -> list[Table]:
    taps: Taps = found.taps
    count = Table("int", "N_TAPS", np.array(len(taps.weight)), f"shaper {found.study.shaper.kind}")
    tables = [
        count,
        Table(kind, "WEIGHT", row.integers[0], "[1] of each tap of the input shaper; shaper"),
        Table("uint32_t", "DELAY", taps.sample, "[samples] of each tap; shaper"),
    ]
    if is_fixed:
        tables.append(Table("int", "WEIGHT_SHIFT", row.shift[0], "[bit] of all weights"))
    return tables


def _with_shift(
    kind: str, name: str, row: Row | None, shape: tuple[int, ...] | None, comment: str,
    rows: list[str],
) -> list[Table]:  # fmt: skip
    if row is None:
        return []
    integers = row.integers if shape is None else row.integers.reshape(shape)
    return [
        Table(kind, name, integers, comment, rows),
        Table("uint8_t", f"{name}_SHIFT", row.shift.ravel(), "[bit] of each row"),
    ]


def _filled(
    template: str,
    found: FixedController,
    channels: Channels,
    name: str,
    origin: Iterable[str],
    tables: list[Table],
    header: dict[str, Any],
    code: dict[str, str],
) -> Source:
    """Header and source from their templates; @ stands for the prefix in capitals."""
    rate = found.study.electronics.sample_rate_hz
    rail = rail_samples(rate)
    has_memory = any(table.name == "FEEDTHROUGH" for table in tables)
    title = _comment(found.study.title)
    kept = f"    {code.pop('command_type')} command[@_N_CHANNELS]; /* on the actuators now */"
    members = [*header["members"], *([kept] if has_memory else [])]
    header |= {
        "members": "\n".join(members),
        "border": _starred(header["border"]),
        "n_links": 3, "n_patches": found.n_patches, "n_channels": 3 * found.n_patches,
        "n_modes": len(channels.link), "rate": f"{rate:g}", "rate_literal": _literal(rate),
        "rail": rail, "rail_ms": f"{1e3 * rail / rate:.3g}",
        "shaper_length": int(found.taps.sample.max()) + 1,
    }  # fmt: skip
    optional = {
        "forget_command": "        state->command[k] = 0;\n" if has_memory else "",
        "subtract_feedthrough": code["subtract_feedthrough"] if has_memory else "",
        "keep_command": code["keep_command"] if has_memory else "",
        "direct": code["direct"] if channels.has_direct else "",
        "tables": "\n\n".join(_text(table) for table in tables),
    }
    common = {"name": name, "NAME": name.upper(), "title": title, "origin": _starred(origin)}
    texts = []
    for file, values in (("controller.h", header), (template, code | optional)):
        text = (_TEMPLATES / file).read_text(encoding="utf-8")
        filled = Template(text).substitute(common | values)
        texts.append(filled.replace("@_", f"{name.upper()}_"))
    return Source(*texts)


def _text(table: Table) -> str:
    """A constant in C."""
    values = np.asarray(table.values)
    is_real = table.type == "real"

    def number(value: Any) -> str:
        return f"R({_literal(value)})" if is_real else str(int(value))

    comment = f"/* {table.comment} */\n"
    if values.ndim == 0:
        if table.name == "N_TAPS":  # a size, in C no constant but an enumerator or a macro is one
            return f"{comment}#define N_TAPS {int(values)}"
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
    if len(numbers) <= 4:
        return ", ".join(numbers)
    rows = [", ".join(numbers[k : k + 4]) for k in range(0, len(numbers), 4)]
    return "\n    " + ",\n    ".join(rows) + "\n"


def _literal(value: Any) -> str:
    """A double of C with all its digits."""
    text = repr(float(value))
    return text if any(mark in text for mark in ".en") else text + ".0"


def _starred(lines: Iterable[str]) -> str:
    """Lines of a C comment."""
    return "\n".join(f" * {_comment(line)}".rstrip() for line in lines)


def _comment(text: str) -> str:
    """Text that can stand in a comment: printable ASCII that does not end it."""
    plain = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").replace("\\", "/")
