"""By which voltages actuators act on the links: commands behind amplifiers and hysteresis."""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.electronics import Amplifier
from jaxmodel.hysteresis import Hysteresis, added_voltage, advance_plays
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num


class Acting(NamedTuple):
    """How actuators act over a plant step: as if held + remainder exp(-t/lag) were on them."""

    held: Num[Array, "links K"]  # [V]
    remainder: Num[Array, "links K"] | None  # [V]; None: no amplifiers
    # at start, middle and end [V]
    course: tuple[Num[Array, "links K"], Num[Array, "links K"], Num[Array, "links K"]]
    voltage: Num[Array, "links K"] | None  # on them at the end [V]; None: no amplifiers
    plays: Num[Array, "N links K"] | None  # of their hysteresis at the end [V]


def act(
    amplifier: Amplifier | None,
    hysteresis: Hysteresis | None,
    voltage: Array | None,
    plays: Array | None,
    command: Array,
) -> Acting:
    """Actuators over a step with a held command.

    The voltage approaches the command without turning. What the plays add over the step follows
    the same course, also where a play is used up only on the way.

    Args:
        amplifier: over that step; None: commands are on the actuators at once.
        hysteresis: None: actuators are linear.
        voltage: on the actuators at the start [V], (3, K); None: no amplifiers.
        plays: of their hysteresis at the start [V], (N, 3, K); None: they are linear.
        command: [V], (3, K).
    """
    held, remainder, last = command, None, None
    if amplifier is not None and voltage is not None:
        remainder = voltage - command
        last = command + amplifier.left * remainder
    if hysteresis is not None and plays is not None:
        after = advance_plays(hysteresis, plays, command if last is None else last)
        added = added_voltage(hysteresis, after)
        if amplifier is None or remainder is None:
            held = command + added
        else:
            old = added_voltage(hysteresis, plays)
            passed = 1 - amplifier.left  # 0 in a step that takes no time
            change = (added - old) / jnp.where(passed > 0, passed, 1.0)
            held, remainder = command + old + change, remainder - change
        plays = after
    if amplifier is None or remainder is None:
        course = (held, held, held)
    else:
        start, middle, end = (held + amplifier.course[k] * remainder for k in range(3))
        course = (start, middle, end)
    return Acting(held=held, remainder=remainder, course=course, voltage=last, plays=plays)


def acting_now(
    hysteresis: Hysteresis | None, voltage: Array | None, plays: Array | None, command: Array
) -> Array:
    """By which voltages actuators act once a command is on them, or on their amplifiers.

    Args:
        hysteresis: None: actuators are linear.
        voltage: on the actuators [V], (3, K); None: no amplifiers.
        plays: of their hysteresis until then [V], (N, 3, K); None: they are linear.
        command: [V], (3, K).

    Returns:
        [V], (3, K).
    """
    now = command if voltage is None else voltage
    if hysteresis is None or plays is None:
        return now
    if voltage is None:
        plays = advance_plays(hysteresis, plays, command)
    return now + added_voltage(hysteresis, plays)
