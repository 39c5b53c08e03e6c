"""The sampled controller: ADC, notch filters, feedback, saturation, delay.

Feedback is modal filter, estimator, gains and synthesizer, channel by channel, or a linear system
of any order. `controller_step` is what a DSP does once per sample. Shapes: links first, then
patches (K), then lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.channels import Channels
from jaxmodel.estimator import FilterState
from jaxmodel.lazy import jax, jnp
from jaxmodel.notch import Notch, NotchState, advance_notch
from jaxmodel.parameters import Array, Num
from jaxmodel.state_space import StateSpace

#: From sensor to actuator voltages, in either form; both have the same methods.
Feedback = Channels | StateSpace


class Controller(NamedTuple):
    """Coefficients, computed once per case."""

    feedback: Feedback
    feedthrough: Num[Array, "links K K"]  # sensor volts per actuator volt to subtract [1]
    voltage_limit: Num[Array, ""]  # [V]
    adc_gain: Num[Array, ""]  # conditioner gain [1]
    adc_bias: Num[Array, ""]  # [V]
    adc_step: Num[Array, ""]  # one code [V]
    adc_top: Num[Array, ""]  # highest code [1]
    adc_noise: Num[Array, ""]  # rms at the ADC input [V]
    notch: Notch | None = None  # before the feedback; None: there is none


class ChannelParts(NamedTuple):
    """What the channels of a controller read and drive; a linear system has none, C = 0."""

    filter: Num[Array, "n C K"]  # channel signal per sensor volt
    synthesizer: Num[Array, "n K C"]  # actuator volts per channel force


def channel_parts(controller: Controller) -> ChannelParts:
    """Of either kind of feedback."""
    feedback = controller.feedback
    if isinstance(feedback, Channels):
        return ChannelParts(feedback.filter, feedback.synthesizer)
    links, patches = controller.feedthrough.shape[:2]
    return ChannelParts(np.zeros((links, 0, patches)), np.zeros((links, patches, 0)))


class ControllerState(NamedTuple):
    """What the controller remembers from sample to sample."""

    feedback: FilterState | Num[Array, "G N b"]  # of channels, or of a linear system
    # command applied during this sample, computed in the last one [V]
    voltage: Num[Array, "links K"]
    notch: NotchState | None = None


class ControllerInfo(NamedTuple):
    """Diagnostics of one sample."""

    measured: Num[Array, "links K"]  # sensor voltage as the controller sees it [V]
    command: Num[Array, "links K"]  # new command, applied from the next sample on [V]
    is_clipped: Num[Array, "links K"]  # ADC at the end of its range, 0 or 1 per channel


def rest_controller(controller: Controller) -> ControllerState:
    """All zeros."""
    voltage = jnp.zeros_like(jnp.asarray(controller.feedthrough)[..., 0])
    notch = None if controller.notch is None else (jnp.zeros_like(voltage),) * 2
    return ControllerState(controller.feedback.at_rest(), voltage, notch)


def with_gains(controller: Controller, factor: Array) -> Controller:
    """All gains times a common factor."""
    return controller._replace(feedback=controller.feedback.amplified(factor))


#: Half-width of a smooth limit's corner, as a share of the limit.
CORNER = 0.1


def soft_limit(x: Array, bound: Array, is_smooth: bool) -> Array:
    """x limited to +-bound: clipped, or with parabolic corners where a gradient is needed.

    The smooth limit is x itself up to 0.9 bound and bound from 1.1 bound on; between them, where
    it is at most bound/40 below the sharp one, its slope falls linearly from 1 to 0.

    Args:
        x: any unit.
        bound: in the same unit, positive.
        is_smooth: see `Structure`.
    """
    if not is_smooth:
        return jnp.clip(x, -bound, bound)
    share, straight = x / bound, 1 - CORNER
    beyond = jnp.clip(share - straight, 0.0, 2 * CORNER)
    beyond = beyond - jnp.clip(-share - straight, 0.0, 2 * CORNER)
    bent = beyond - beyond * jnp.abs(beyond) / (4 * CORNER)
    return bound * (jnp.clip(share, -straight, straight) + bent)


def convert(
    controller: Controller, voltage: Array, noise: Array | None, is_smooth: bool
) -> tuple[Array, Array]:
    """Conditioner and ADC: sensor voltage [V] as read back from the code, and where it clips.

    Args:
        controller: coefficients.
        voltage: filtered sensor voltage [V], (3, K).
        noise: standard normal numbers, (3, K), or None.
        is_smooth: leave out rounding and clipping, add noise of equal variance instead.

    Returns:
        (measured [V], is_clipped), (3, K) each.
    """
    if not is_smooth:
        code, is_clipped = adc_code(controller, voltage, noise)
        return read_back(controller, code), is_clipped
    level = controller.adc_gain * voltage + controller.adc_bias
    if noise is not None:  # uniform rounding error has variance step^2/12
        level = level + jnp.sqrt(controller.adc_noise**2 + controller.adc_step**2 / 12) * noise
    return (level - controller.adc_bias) / controller.adc_gain, jnp.zeros_like(level)


def adc_code(controller: Controller, voltage: Array, noise: Array | None) -> tuple[Array, Array]:
    """ADC code of a sensor voltage behind the conditioner, and 1 where it clips, else 0.

    Args:
        controller: coefficients.
        voltage: filtered sensor voltage [V], (3, K).
        noise: standard normal numbers, (3, K), or None.
    """
    level = controller.adc_gain * voltage + controller.adc_bias
    if noise is not None:
        level = level + controller.adc_noise * noise
    code = jnp.round(level / controller.adc_step)
    clipped = jnp.clip(code, 0.0, controller.adc_top)
    return clipped, jnp.where(code == clipped, jnp.zeros_like(code), jnp.ones_like(code))


def read_back(controller: Controller, code: Array) -> Array:
    """Sensor voltage [V] that an ADC code represents."""
    return (code * controller.adc_step - controller.adc_bias) / controller.adc_gain


def linear_parts(controller: Controller) -> list[tuple[slice, Controller]]:
    """Parts that a linear analysis can judge: the controller, or each rival channel by itself.

    Each comes with the channels whose modes it covers. Stability of every part proves nothing
    about switching between them.

    Args:
        controller: NumPy arrays.
    """
    parts = controller.feedback.linear_parts()
    return [(modes, controller._replace(feedback=part)) for modes, part in parts]


def controller_step(
    controller: Controller,
    state: ControllerState,
    voltage: Array,
    noise: Array | None = None,
    is_smooth: bool = False,
) -> tuple[ControllerState, ControllerInfo]:
    """One sample of the controller.

    Args:
        controller: coefficients.
        state: from the last sample; `state.voltage` is on the actuators now.
        voltage: sensor voltages behind the anti-alias filter at the sampling instant [V], (3, K).
        noise: standard normal numbers for the ADC, (3, K), or None.
        is_smooth: see `Structure`.

    Returns:
        (next state, ControllerInfo).
    """
    measured, is_clipped = convert(controller, voltage, noise, is_smooth)
    own = jnp.sum(controller.feedthrough * state.voltage[:, None], axis=2)
    seen, notch = measured - own, state.notch
    if controller.notch is not None and notch is not None:
        notch, seen = advance_notch(controller.notch, notch, seen)
    after, demand = controller.feedback.step(state.feedback, seen)
    command = soft_limit(demand, controller.voltage_limit, is_smooth)
    after = controller.feedback.limited(after, command - demand)
    return ControllerState(after, command, notch), ControllerInfo(measured, command, is_clipped)


def linear_law(controller: Controller) -> tuple[Array, Array, Array, Array]:
    """The controller without ADC and limits, as a linear system.

    x[k+1] = A x[k] + B (y, v)[k] and m[k] = C x[k] + D (y, v)[k], with sensor voltages y,
    commands m and those of the sample before, v[k+1] = m[k].

    Args:
        controller: without rival channels, see `linear_parts`.

    Returns:
        A, (n, n); B, (n, 6 K); C, (3 K, n); D, (3 K, 6 K).
    """
    from jax.flatten_util import ravel_pytree

    start = rest_controller(controller)
    rest, unpack = ravel_pytree((start.feedback, start.notch))
    applied = jnp.zeros(start.voltage.shape)
    width = applied.size

    def step(x: Array, ports: Array) -> tuple[Array, Array]:
        measured, held = (jnp.reshape(part, applied.shape) for part in jnp.split(ports, 2))
        feedback, notch = unpack(x)
        before = ControllerState(feedback, held, notch)
        after, info = controller_step(controller, before, measured, None, True)
        return ravel_pytree((after.feedback, after.notch))[0], jnp.ravel(info.command)

    (a, b), (c, d) = jax.jacfwd(step, (0, 1))(jnp.zeros_like(rest), jnp.zeros(2 * width))
    return a, b, c, d
