"""C99 of a controller in 32-bit fixed point."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from studies.engine.controller import FixedController
from studies.export.c_text import (
    GAINS,
    Parts,
    Rivals,
    Source,
    Table,
    filled,
    literal,
    patch_names,
    rival_table,
    section_comments,
    shaper_tables,
    starred,
    structure_tables,
)
from studies.export.fixed import WORD, FixedPoint, Format, Row, shaper_row

_FEEDTHROUGH = """\
    for (k = 0; k < @_N_CHANNELS; k++) {
        first = @_N_PATCHES * (k / @_N_PATCHES);
        sum = 0;
        for (m = 0; IS_USED[k / @_N_PATCHES] && m < @_N_PATCHES; m++) {
            sum += (int64_t)FEEDTHROUGH[k][m] * state->command[first + m];
        }
        if (IS_USED[k / @_N_PATCHES]) {
            sensed[k] = limited(sensed[k] - shifted(sum, FEEDTHROUGH_SHIFT[k]));
        }
    }
"""
_ALL = Rivals("", "", "")
#: Of the rivals of a link the one of highest energy acts.
_ONE = Rivals(
    """    int64_t energy[@_N_MODES]; /* of the channels */
""",
    """        energy[m] = 0;
        for (k = 0; k < 2; k++) {
            int64_t part;

            sum = (int64_t)ENERGY[2 * m + k][0] * inner + (int64_t)ENERGY[2 * m + k][1] * line[0]
                + (int64_t)ENERGY[2 * m + k][2] * line[1] + (int64_t)ENERGY[2 * m + k][3] * signal;
            part = limited(shifted(sum, ENERGY_SHIFT[2 * m + k]));
            energy[m] += part * part;
        }
""",
    """    for (m = 0; m < @_N_MODES; m++) {
        for (k = 0; k < @_N_MODES; k++) {
            if (IS_RIVAL[m] && IS_RIVAL[k] && LINK[k] == LINK[m] && energy[k] > energy[m]) {
                force[m] = 0;
            }
        }
    }
""",
)
_WORD = "int32_t"


def fixed_source(
    found: FixedController,
    fixed: FixedPoint,
    name: str,
    origin: Iterable[str],
    cost: str,
) -> Source:
    """Controller in fixed point.

    Args:
        found: the controller.
        fixed: the same in integers.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
        cost: what a sample costs, for the file's head.
    """
    volts = float(found.controller.voltage_limit)
    header = {
        "border": [
            f"Sensors: codes of the ADC, 0 to {fixed.adc_top}. Actuators: codes of the DAC, 1 to",
            f"{2 * fixed.dac_rest - 1} for {-volts:g} to {volts:g} V at the piezo patch, "
            f"{fixed.dac_rest} for 0 V. A sensor is faulty",
            "if its code is too high or too long at one end of the range.",
        ],
        "types": "",
        "constants": f"#define @_ADC_TOP {fixed.adc_top} /* highest code */\n"
        f"#define @_DAC_REST {fixed.dac_rest} /* code of 0 V */\n"
        f"#define @_DAC_STEP {literal(fixed.dac_step)} /* V per code at the patch */",
        "members": [
            f"    {_WORD} high[@_N_MODES]; /* memory of the first section */",
            f"    {_WORD} line[@_N_MODES][2]; /* delay line of the second section */",
        ],
        "faulty": "a code beyond the ADC's, or stuck at one end",
        "sensor_type": "uint16_t",
        "actuator_type": "uint16_t",
        "reference_type": _WORD,
        "reference_unit": ", each in any unit that fits 32 bits",
    }
    parts = Parts(
        template="fixed.c",
        tables=_tables(found, fixed),
        header=header,
        command_type=_WORD,
        subtract_feedthrough=_FEEDTHROUGH,
        keep_command="        state->command[k] = command;\n",
        direct="\n            + (int64_t)DIRECT[m] * signal",
        rivals=_ALL if fixed.energy is None else _ONE,
        more={
            "formats": starred(format_lines(fixed, found)),
            "cost": cost,
            "code": f"{fixed.sensor_step * 2.0**fixed.adc_bits:.9g}",
            "dac": f"{fixed.dac_step:.9g}",
        },
    )
    return filled(parts, found, name, origin)


def format_lines(fixed: FixedPoint, found: FixedController) -> list[str]:
    """Table of formats; room of the word and reach of ADC codes in units of the base."""
    value, force = ("m", "N") if found.is_modal else ("V", "V")
    lines = [
        f"{'signal':<30}{'Q':>4}{'base':>20}{'room':>9}{'reach':>9}",
        f"{'sensors':<30}{fixed.adc_bits:>4}{'1 code':>20}",
    ]
    parts: list[tuple[str, Format, str]] = [
        ("signal", fixed.signal, value),
        ("high-passed", fixed.high, value),
        ("delay line", fixed.inner, value),
        ("force", fixed.force, force),
    ]
    for m, name in enumerate(found.channels.names):
        for text, form, unit in parts:
            lines.append(
                f"{f'{text}, {name}':<30}{form.bits[m]:>4}{f'{form.base[m]:.9e} {unit}':>20}"
                f"{2.0 ** (WORD - 1 - form.bits[m]):>9.0f}{form.bound[m] / form.base[m]:>9.1f}"
            )
    return lines


def _tables(found: FixedController, fixed: FixedPoint) -> list[Table]:
    channels, shaper = found.channels, shaper_row(found.taps)
    names, section = channels.names, section_comments(found)
    back, each = fixed.synthesizer, np.arange(len(channels.link))
    high = np.hstack([fixed.high_pass.integers, fixed.memory.integers])
    high_shift = np.stack([fixed.high_pass.shift, fixed.memory.shift], axis=1)
    numerator = Row(fixed.numerator.integers[:, :3], fixed.numerator.shift)
    first = np.searchsorted(channels.link, np.arange(4))

    def word(name: str, values: np.ndarray, comment: str, rows: list[str] | None = None) -> Table:
        return Table(_WORD, name, values, comment, rows or [])

    def shift(name: str, row: Row) -> Table:
        return Table("uint16_t", f"{name}_SHIFT", row.shift.ravel(), "[bit] of each row")

    tables = [
        *structure_tables(channels),
        Table("uint16_t", "FIRST_MODE", first, "first mode of each link, and the end; control"),
        Table("uint16_t", "ADC_TOP", fixed.adc_top, "[code] highest one; adc_bits"),
        word("ADC_UNIT", np.array(2**fixed.adc_bits), "[count] of a sensor per code; adc_bits"),
        Table("int64_t", "BIAS", fixed.bias, "[count] sensor at rest; conditioner_bias"),
        word("DAC_REST", np.array(fixed.dac_rest), "[code] of 0 V at an actuator; the DAC's bits"),
        word(
            "FILTER",
            fixed.filter.integers,
            "[signal/sensor] modal filter pinv(lambda_s Phi_s^t); control.basis, patches",
            names,
        ),
        shift("FILTER", fixed.filter),
        word(
            "HIGH_PASS",
            high,
            "[high/signal; high/signal, 1] b0; b1, -a1 of the velocity "
            f"estimate's first section: {section[0]}",
            names,
        ),
        Table("uint16_t", "HIGH_PASS_SHIFT", high_shift, "[bit] of b0; of b1 and -a1"),
        word(
            "LOW_PASS",
            fixed.low_pass.integers,
            f"[delay line/high, 1, 1] scale, -a1, -a2 of its second section: {section[1]}",
            names,
        ),
        shift("LOW_PASS", fixed.low_pass),
        word(
            "FORCE",
            numerator.integers,
            "[force/delay line] its numerator times the gains, " + GAINS,
            names,
        ),
        shift("FORCE", numerator),
        word(
            "SYNTHESIZER",
            back.integers[channels.link, :, each],
            "[code/force] of each actuator "
            "of the link, pinv(lambda_a Phi_a); control.basis, patches",
            names,
        ),
        Table("uint16_t", "SYNTHESIZER_SHIFT", back.shift.ravel(), "[bit] of each actuator"),
        *shaper_tables(found, _WORD, shaper.integers[0]),
        Table("int", "WEIGHT_SHIFT", shaper.shift[0], "[bit] of all weights"),
    ]
    if fixed.energy is not None:
        rows = [f"{name}, {what}" for name in names for what in ("velocity", "position")]
        words = fixed.energy.integers.reshape(-1, 4)
        comment = "[energy root/delay line; energy root/signal] modal velocity, omega position"
        tables += [rival_table(channels), word("ENERGY", words, comment, rows)]
        tables.append(shift("ENERGY", fixed.energy))
    if channels.has_direct:
        comment = "[force/signal] force past the filters, shifted as FORCE; control.position_gain"
        tables.append(word("DIRECT", fixed.numerator.integers[:, 3], comment))
    if fixed.feedthrough is not None:
        comment = (
            "[sensor/code] of each actuator of the link, by modes that are not controlled; "
            "control.feedthrough_factor"
        )
        table = fixed.feedthrough.integers.reshape(-1, found.n_patches)
        tables += [
            word("FEEDTHROUGH", table, comment, patch_names(found)),
            shift("FEEDTHROUGH", fixed.feedthrough),
        ]
    return tables
