"""The sampled controller: ADC, feedback, saturation, delay.

Feedback is modal filter, estimator, gains and synthesizer, channel by channel, or a linear system
of any order. `controller_step` is what a DSP does once per sample. Shapes: links first, then
patches (K) or channels (C), then lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.estimator import Estimator, FilterState, advance_filters, weighted
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array
from jaxmodel.state_space import StateSpace, advance, amplified, at_rest


class Controller(NamedTuple):
    """Coefficients, computed once per case."""

    filter: Array  # channels from sensor voltages [m/V] (SRF: identity), (3, C, K)
    estimator: Estimator  # (3, C) each
    velocity_gain: Array  # [N s/m] (SRF: [s]), (3, C)
    position_gain: Array | None  # [N/m] (SRF: [1]), (3, C), None if there is none
    synthesizer: Array  # voltages from channel forces [V/N] (SRF: identity), (3, K, C)
    feedthrough: Array  # sensor volts per actuator volt to subtract [1], (3, K, K)
    voltage_limit: Array  # [V], ()
    adc_gain: Array  # conditioner gain [1], ()
    adc_bias: Array  # [V], ()
    adc_step: Array  # one code [V], ()
    adc_top: Array  # highest code [1], ()
    adc_noise: Array  # rms at the ADC input [V], ()
    # [rad/s], (3, C): among a link's channels with a value above 0, only the one of highest modal
    # energy acts (modified IMSC); None: all act
    rival_omega: Array | None = None
    system: StateSpace | None = None  # instead of channels, of which there are none then


class ControllerState(NamedTuple):
    """What the controller remembers from sample to sample."""

    first: Array  # state of the first-order section, (3, C)
    second: tuple[Array, Array]  # delay line of the second-order section, (3, C) each
    voltage: Array  # command applied during this sample, computed in the last one [V], (3, K)
    system: Array | None = None  # state of `Controller.system`, (G, N, b)


class ControllerInfo(NamedTuple):
    """Diagnostics of one sample."""

    measured: Array  # sensor voltage as the controller sees it [V], (3, K)
    command: Array  # new command, applied from the next sample on [V], (3, K)
    is_clipped: Array  # ADC at the end of its range, 0 or 1 per channel, (3, K)


def rest_controller(controller: Controller) -> ControllerState:
    """All zeros."""
    zero = jnp.zeros_like(jnp.asarray(controller.velocity_gain))
    voltage = jnp.zeros_like(jnp.asarray(controller.feedthrough)[..., 0])
    system = None if controller.system is None else at_rest(controller.system)
    return ControllerState(zero, (zero, zero), voltage, system)


def with_gains(controller: Controller, factor: Array) -> Controller:
    """All gains times a common factor."""
    position, system = controller.position_gain, controller.system
    return controller._replace(
        velocity_gain=factor * controller.velocity_gain,
        position_gain=None if position is None else factor * position,
        system=None if system is None else amplified(system, factor),
    )


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


def strongest(omega: Array, value: Array, rate: Array) -> Array:
    """1 for the channel of highest modal energy (omega q)^2 + q'^2 of each link, 0 for its rivals.

    Modified IMSC (Baz and Poh 1988): all actuators of a link serve one mode at a time. A channel
    with omega = 0 has no rivals and always acts.

    Args:
        omega: frequency of each channel [rad/s], (3, C).
        value: estimated q [m], (3, C).
        rate: estimated q' [m/s], (3, C).
    """
    is_rival = omega > 0
    energy = jnp.where(is_rival, (omega * value) ** 2 + rate**2, 0.0)
    is_first = energy >= jnp.max(energy, axis=1, keepdims=True)
    return jnp.where(is_rival & ~is_first, 0.0, 1.0).astype(energy.dtype)


def linear_parts(controller: Controller) -> list[tuple[slice, Controller]]:
    """Parts that a linear analysis can judge: the controller, or each rival channel by itself.

    Each comes with the channels whose modes it covers. Stability of every part proves nothing
    about switching between them.

    Args:
        controller: NumPy arrays.
    """
    if controller.rival_omega is None:
        return [(slice(None), controller)]
    parts = []
    for j in np.flatnonzero(np.any(controller.rival_omega, axis=0)):
        alone = np.arange(controller.rival_omega.shape[1]) == j
        position = controller.position_gain
        part = controller._replace(
            velocity_gain=alone * controller.velocity_gain,
            position_gain=None if position is None else alone * position,
            rival_omega=None,
        )
        parts.append((slice(j, j + 1), part))
    return parts or [(slice(None), controller._replace(rival_omega=None))]


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
    find = _from_channels if controller.system is None else _from_system
    after, wanted = find(controller, state, measured - own)
    command = soft_limit(wanted, controller.voltage_limit, is_smooth)
    return after._replace(voltage=command), ControllerInfo(measured, command, is_clipped)


def _from_system(
    controller: Controller, state: ControllerState, voltage: Array
) -> tuple[ControllerState, Array]:
    """Next state, and voltages wanted on the actuators [V], (3, K)."""
    assert controller.system is not None
    x, wanted = advance(controller.system, state.system, voltage)
    return state._replace(system=x), wanted


def _from_channels(
    controller: Controller, state: ControllerState, voltage: Array
) -> tuple[ControllerState, Array]:
    """As `_from_system`."""
    channel = jnp.sum(controller.filter * voltage[:, None], axis=2)
    estimator = controller.estimator
    filters, line = advance_filters(estimator, FilterState(state.first, state.second), channel)
    rate = weighted(estimator.velocity, line)
    force = -controller.velocity_gain * rate
    if controller.position_gain is not None or controller.rival_omega is not None:
        value = weighted(estimator.position, line) + estimator.direct * channel
        if controller.position_gain is not None:
            force = force - controller.position_gain * value
        if controller.rival_omega is not None:
            force = force * strongest(controller.rival_omega, value, rate)
    wanted = jnp.sum(controller.synthesizer * force[:, None], axis=2)
    return state._replace(first=filters.first, second=filters.second), wanted
