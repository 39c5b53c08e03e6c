"""C99 of a controller in floating point."""

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
    structure_tables,
)

_FEEDTHROUGH = """\
    for (k = 0; k < @_N_CHANNELS; k++) {
        first = @_N_PATCHES * (k / @_N_PATCHES);
        for (m = 0; IS_USED[k / @_N_PATCHES] && m < @_N_PATCHES; m++) {
            volt[k] -= FEEDTHROUGH[k][m] * state->command[first + m];
        }
    }
"""
#: All channels act.
_ALL = Rivals(
    "",
    "",
    "",
    """        for (k = 0; k < @_N_PATCHES; k++) {
            wanted[first + k] += SYNTHESIZER[m][k] * force;
        }
""",
)
#: Of the rivals of a link the one of highest energy acts.
_ONE = Rivals(
    """    real forces[@_N_MODES], energy[@_N_MODES]; /* of the channels */
""",
    """        rate = RATE[m][0] * inner + RATE[m][1] * line[0] + RATE[m][2] * line[1];
        place = PLACE[m][0] * inner + PLACE[m][1] * line[0] + PLACE[m][2] * line[1]
            + PLACE[m][3] * signal;
        energy[m] = rate * rate + place * place;
        forces[m] = force;
""",
    """    for (m = 0; m < @_N_MODES; m++) {
        int acts = 1;

        for (k = 0; k < @_N_MODES; k++) {
            if (IS_RIVAL[m] && IS_RIVAL[k] && LINK[k] == LINK[m] && energy[k] > energy[m]) {
                acts = 0;
            }
        }
        first = @_N_PATCHES * LINK[m];
        for (k = 0; acts && k < @_N_PATCHES; k++) {
            wanted[first + k] += SYNTHESIZER[m][k] * forces[m];
        }
    }
""",
)
_TYPES = """\
/* double, or float with -D@_REAL=float. */
#ifndef @_REAL
#define @_REAL double
#endif
typedef @_REAL {name}_real;
"""


def floating_source(found: FixedController, name: str, origin: Iterable[str]) -> Source:
    """Controller in double or single precision.

    Args:
        found: the controller.
        name: prefix of functions and types, and name of the files.
        origin: lines that say where the numbers come from.
    """
    controller, real = found.controller, f"{name}_real"
    header = {
        "border": [
            "Sensors: volts at the ADC's input, the code times @_ADC_STEP; conditioner gain and",
            "bias are taken off here. Actuators: volts at the piezo patch, so divide by the gain",
            "of the amplifier. A sensor is faulty if it is no number or out of range, or too long",
            "at one end of it.",
        ],
        "types": _TYPES.format(name=name),
        "constants": f"#define @_ADC_TOP {int(controller.adc_top)} /* highest code */\n"
        f"#define @_ADC_STEP {literal(controller.adc_step)} /* V per code */\n"
        f"#define @_LIMIT {literal(controller.voltage_limit)} /* V, of every actuator, +- */",
        "members": [
            f"    {real} high[@_N_MODES]; /* memory of the first section */",
            f"    {real} line[@_N_MODES][2]; /* delay line of the second section */",
        ],
        "faulty": "not a number, out of range or stuck at one end of it",
        "sensor_type": real,
        "actuator_type": real,
        "reference_type": real,
        "reference_unit": ", in any units",
    }
    parts = Parts(
        template="floating.c",
        tables=_tables(found),
        header=header,
        command_type=real,
        subtract_feedthrough=_FEEDTHROUGH,
        keep_command="        state->command[k] = wanted[k];\n",
        direct="\n            + DIRECT[m] * signal",
        rivals=_ALL if found.channels.energy is None else _ONE,
    )
    return filled(parts, found, name, origin)


def _tables(found: FixedController) -> list[Table]:
    controller, channels = found.controller, found.channels
    names, (first, second) = channels.names, section_comments(found)
    to_signal, force, to_volt = ("m/V", "N/m", "V/N") if found.is_modal else ("1", "1", "1")
    rate = "1" if found.study.electronics.estimator == "modal_phase" else "1/s"

    def real(name: str, values: np.ndarray, comment: str, rows: list[str] | None = None) -> Table:
        return Table("real", name, values, comment, rows or [])

    tables = [
        *structure_tables(channels),
        real("ADC_STEP", controller.adc_step, "[V] one code at the ADC; adc_range, adc_bits"),
        real("ADC_TOP", controller.adc_top * controller.adc_step, "[V] highest code; adc_range"),
        real("BIAS", controller.adc_bias, "[V] at the ADC, sensor at rest; conditioner_bias"),
        real("CONDITIONER_GAIN", controller.adc_gain, "[1] ADC volt per sensor volt; electronics"),
        real("LIMIT", controller.voltage_limit, "[V] of every actuator, +-; voltage_limit"),
        real(
            "FILTER",
            channels.filter,
            f"[{to_signal}] modal filter pinv(lambda_s Phi_s^t): signal "
            "per volt of each sensor of the link; control.basis, patches",
            names,
        ),
        real(
            "HIGH_PASS",
            channels.first,
            f"[{rate}; {rate}; 1] b0, b1, a1 of the velocity estimate's first section: {first}",
            names,
        ),
        real(
            "LOW_PASS",
            channels.denominator,
            f"[1] a1, a2 of its second section: {second}",
            names,
        ),
        real(
            "FORCE",
            channels.force,
            f"[{force}] its numerator times the gains, {GAINS}",
            names,
        ),
        real(
            "SYNTHESIZER",
            channels.synthesizer,
            f"[{to_volt}] voltage of each actuator of the "
            "link per force, pinv(lambda_a Phi_a); control.basis, patches",
            names,
        ),
        *shaper_tables(found, "real", found.taps.weight),
    ]
    if channels.energy is not None:
        tables += [
            rival_table(channels),
            real("RATE", channels.energy[:, 0, :3], "[1/s] modal velocity; energy", names),
            real("PLACE", channels.energy[:, 1], "[1/s] omega times modal position", names),
        ]
    if channels.has_direct:
        comment = f"[{force}] force past the filters; control.position_gain"
        tables.append(real("DIRECT", channels.direct, comment))
    if np.any(controller.feedthrough):
        comment = (
            "[1] sensor volts per volt of each actuator of the link, by modes that are not "
            "controlled; control.feedthrough_factor"
        )
        table = controller.feedthrough.reshape(-1, found.n_patches)
        tables.append(real("FEEDTHROUGH", table, comment, patch_names(found)))
    return tables
