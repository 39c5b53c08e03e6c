"""Software in the loop: the plant in JAX, the controller any function from ADC codes to volts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller, adc_code, controller_step, read_back, rest_controller
from jaxmodel.loop import Inputs, Loop, State, advance, filtered_voltage
from jaxmodel.simulate import RunResult, Start, begin, conclude
from studies.engine.programs import kept_jit


class Stepping(Protocol):
    """Code of a controller, wherever it runs."""

    def begin(self) -> None:
        """Reset the state."""

    def step(self, sensor: np.ndarray) -> tuple[np.ndarray, int]:
        """One sample: actuator values and the fault, from sensor values."""


#: Maps ADC codes (3, K) of a sample to actuator voltages (3, K) [V] of the next one.
Law = Callable[[np.ndarray], np.ndarray]


class LoopRun(NamedTuple):
    """A run over a case's motion."""

    codes: np.ndarray  # of the ADC, (T, 3, K)
    voltage: np.ndarray  # commands [V], (T, 3, K)
    pose: np.ndarray  # [m, m, rad], (T, 3)
    result: RunResult  # metrics and status, NumPy arrays


def law_of(
    code: Stepping,
    sensor_step: float = 1.0,
    to_volts: Callable[[np.ndarray], np.ndarray] = lambda values: values,
) -> Law:
    """A controller's code, from rest, between the ADC's codes and the actuators.

    Args:
        code: of the controller.
        sensor_step: what it is given for one ADC code, in its own unit.
        to_volts: from its actuator values, (3, K), to voltages [V].
    """
    code.begin()

    def law(codes: np.ndarray) -> np.ndarray:
        return to_volts(code.step(codes * sensor_step)[0].reshape(codes.shape).astype(float))

    return law


def run_in_the_loop(structure: Structure, case: Case, law: Law) -> LoopRun:
    """Run a case with a controller outside the compiled program.

    Args:
        structure: static choices, feedback "sampled".
        case: the numbers.
        law: called once per sample, in order.
    """
    # the controller is outside, so its kind must not cost another compilation
    structure = structure._replace(has_position_gain=False)
    start = _begin(structure, case)
    state, inputs = start.state, start.inputs
    code, clipped = _read_adc(start.loop, inputs, 0, state)
    voltage = np.zeros_like(np.asarray(code))
    sample = _sample.program(structure, start.loop, inputs, 0, state, voltage, clipped)
    codes, voltages, poses = [], [], []
    for k in range(structure.n_steps):
        code = np.asarray(code)
        voltage = np.asarray(law(code), code.dtype)
        codes.append(code)
        voltages.append(voltage)
        state, pose, code, clipped = sample(start.loop, inputs, k, state, voltage, clipped)
        poses.append(pose)
    result = jax.tree.map(np.asarray, _conclude(start.outline, start.state.status, state))
    return LoopRun(np.stack(codes), np.stack(voltages), np.stack(poses), result)


_begin = kept_jit(static_argnums=0)(begin)
_conclude = kept_jit()(conclude)


def _read(loop: Loop, inputs: Inputs, k: Any, state: State) -> Any:
    """ADC codes of a state at sample k, and whether any of them clips."""
    noise = None if inputs.adc_noise is None else inputs.adc_noise[k]
    code, is_clipped = adc_code(loop.controller, filtered_voltage(loop, state.plant), noise)
    return code, is_clipped.max()


_read_adc = kept_jit()(_read)


@kept_jit(static_argnums=0)
def _sample(
    structure: Structure,
    loop: Loop,
    inputs: Inputs,
    k: Any,
    state: State,
    voltage: Any,
    clipped: Any,
) -> Any:
    """The plant over sample k; what the ADC reads after it."""
    own = jax.tree.map(lambda x: x[k], inputs)
    after = state.controller._replace(voltage=voltage)
    held = state.controller.voltage
    following, record = advance(structure, loop, state, own, held, after, clipped)
    return following, record.pose, *_read(loop, inputs, k + 1, following)


def run_controller(
    structure: Structure, case: Case, controller: Controller, dac_step: float = 0.0
) -> LoopRun:
    """Run a case with the JAX controller.

    Args:
        structure: as for `run_in_the_loop`.
        case: the numbers.
        controller: coefficients.
        dac_step: commands are rounded to multiples of it [V]; 0: they are not.
    """
    structure = structure._replace(has_position_gain=False)
    start = _begin(structure, case)
    controller = jax.tree.map(jnp.asarray, controller)
    state, *run = _samples(structure, start, controller, jnp.asarray(dac_step))
    result = _conclude(start.outline, start.state.status, state)
    return LoopRun(*jax.tree.map(np.asarray, (*run, result)))


@kept_jit(static_argnums=0)
def _samples(structure: Structure, start: Start, controller: Controller, dac_step: Any) -> Any:
    """The last state; codes, commands and poses of all samples."""
    loop, inputs = start.loop, start.inputs

    def body(carry: Any, k: Any) -> Any:
        state, own, code, clipped = carry
        own = _step(controller, own, code)
        rounded = jnp.round(own.voltage / jnp.where(dac_step > 0, dac_step, 1.0)) * dac_step
        voltage = jnp.where(dac_step > 0, rounded, own.voltage)
        state, pose, *after = _sample(structure, loop, inputs, k, state, voltage, clipped)
        return (state, own._replace(voltage=voltage), *after), (code, voltage, pose)

    first = start.state, rest_controller(controller), *_read(loop, inputs, 0, start.state)
    last, records = jax.lax.scan(body, first, jnp.arange(structure.n_steps))
    return last[0], *records


@kept_jit()
def _step(controller: Controller, state: Any, code: Any) -> Any:
    return controller_step(controller, state, read_back(controller, code))[0]


@kept_jit()
def replay(controller: Controller, codes: Any) -> Any:
    """The JAX controller from rest on a sequence of ADC codes (T, 3, K): voltages (T, 3, K)."""

    def body(state: Any, code: Any) -> Any:
        after = _step(controller, state, code)
        return after, after.voltage

    return jax.lax.scan(body, rest_controller(controller), codes)[1]
