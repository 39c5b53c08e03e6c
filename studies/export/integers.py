"""The exported fixed-point arithmetic in NumPy integers: what the C code does, bit by bit."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from studies.engine.channels import acting
from studies.export.fixed import FixedPoint, IntegerRow
from studies.export.fixed_blocks import FixedBlocks

#: Axes of one sequence's numbers.
SENSORS, CHANNELS, STATES = (-2, -1), (-1,), (-3, -2, -1)


class Response(NamedTuple):
    """Results of the integer arithmetic; counts are per sample, (T, ...)."""

    codes: np.ndarray  # of the DAC, (T, ..., 3, K)
    limited: np.ndarray  # internal signals clipped to words
    saturated: np.ndarray  # actuators at their limit
    is_faulty: np.ndarray  # whether actuators are at rest because of a faulty sensor


class _Limit:
    """Words of so many bits; `cut` counts, call by call, what was clipped in each sequence."""

    def __init__(self, word: int) -> None:
        self._most = 2 ** (word - 1) - 1
        self.cut: list[np.ndarray] = []

    def __call__(self, x: np.ndarray, axes: tuple[int, ...] = CHANNELS) -> np.ndarray:
        inside = np.minimum(np.maximum(x, -self._most - 1), self._most)
        self.cut.append(np.sum(x != inside, axis=axes))
        return inside


class _Memory(Protocol):
    """What the arithmetic remembers between samples."""

    def step(self, sensor: np.ndarray, limit: _Limit) -> np.ndarray:
        """Counts for the actuators, (..., 3, K), from those of the sensors."""
        ...

    def reset(self, is_faulty: np.ndarray) -> None:
        """Begin again in some sequences, (...)."""
        ...


def respond(fixed: FixedPoint | FixedBlocks, codes: np.ndarray, rail: int) -> Response:
    """The exported arithmetic, bit by bit, on sequences of ADC codes from rest.

    Args:
        fixed: formats and coefficients.
        codes: 16-bit words, (T, ..., 3, K); sequences side by side.
        rail: samples at one end of the range after which a sensor is faulty.
    """
    many, wires = codes.shape[1:-2], fixed.wires
    memory: _Memory
    if isinstance(fixed, FixedBlocks):
        memory = _BlockMemory(fixed, many)
    else:
        memory = _ChannelMemory(fixed, many)
    command = np.zeros(codes.shape[1:], np.int64)
    at_end = np.zeros(codes.shape[1:], np.int64)  # samples at the highest code, or minus at 0
    is_faulty = np.zeros(many, bool)
    is_used = np.isin(np.arange(codes.shape[-2]), fixed.link)[:, None]
    rows = []
    for code in codes.astype(np.int64):
        end = (code == wires.adc_top).astype(np.int64) - (code == 0)
        at_end = np.where(end * at_end > 0, at_end, 0) + end
        bad = ((code > wires.adc_top) | (np.abs(at_end) >= rail)) & is_used
        is_faulty = is_faulty | bad.any(axis=(-2, -1))
        limit = _Limit(wires.word)
        sensor = limit(code * 2**wires.adc_bits - wires.bias, SENSORS)
        if wires.feedthrough is not None:
            own = _rounded_sums(wires.feedthrough, command[..., None, :])
            sensor = limit(sensor - own, SENSORS)
        demand = memory.step(sensor, limit)
        command = np.minimum(np.maximum(demand, 1 - wires.dac_rest), wires.dac_rest - 1)
        memory.reset(is_faulty)
        command = np.where(is_faulty[..., None, None], 0, command)
        full = np.sum(np.abs(command) == wires.dac_rest - 1, axis=(-2, -1))
        # a faulty sample ends before the arithmetic
        n_cut = np.where(is_faulty, 0, np.sum(limit.cut, axis=0))
        rows.append((command + wires.dac_rest, n_cut, full, is_faulty))
    return Response(*map(np.stack, zip(*rows, strict=True)))


class _ChannelMemory:
    """Sections of every channel."""

    def __init__(self, fixed: FixedPoint, many: tuple[int, ...]) -> None:
        self._fixed = fixed
        self._high, self._older, self._old = np.zeros((3, *many, len(fixed.link)), np.int64)

    def step(self, sensor: np.ndarray, limit: _Limit) -> np.ndarray:
        fixed, old, older = self._fixed, self._old, self._older
        signal = limit(_rounded_sums(fixed.filter, sensor[..., fixed.link, :]))
        high = limit(_rounded_sums(fixed.high_pass, signal[..., None]) + self._high)
        self._high = limit(_rounded_sums(fixed.memory, np.stack([signal, high], -1)))
        inner = limit(_rounded_sums(fixed.low_pass, np.stack([high, old, older], -1)))
        taps = np.stack([inner, old, older, signal], -1)
        force = limit(_rounded_sums(fixed.numerator, taps))
        if fixed.energy is not None:
            roots = limit(_rounded_sums(fixed.energy, taps[..., None, :]), SENSORS)
            energy = np.sum(roots * roots, axis=-1)
            force = np.where(acting(fixed.link, fixed.is_rival, energy), force, 0)
        self._older, self._old = old, inner
        return _rounded_sums(fixed.synthesizer, force[..., None, None, :])

    def reset(self, is_faulty: np.ndarray) -> None:
        at = is_faulty[..., None]
        self._high, self._old, self._older = (
            np.where(at, 0, x) for x in (self._high, self._old, self._older)
        )


class _BlockMemory:
    """States of every block."""

    def __init__(self, fixed: FixedBlocks, many: tuple[int, ...]) -> None:
        self._fixed = fixed
        self._state = np.zeros((*many, *fixed.state.bits.shape), np.int64)

    def step(self, sensor: np.ndarray, limit: _Limit) -> np.ndarray:
        fixed, state = self._fixed, self._state
        volts = fixed.blocks.of_groups(sensor)  # (..., G, M)
        flat = state.reshape(*state.shape[:-2], -1)
        counts = _rounded_sums(fixed.leave, np.concatenate([flat, volts], -1)[..., None, :])
        entering = np.broadcast_to(volts[..., None, :], (*state.shape[:-1], volts.shape[-1]))
        read = np.concatenate([state, entering], -1)[..., None, :]
        after = _rounded_sums(fixed.advance, read)
        if fixed.anti_windup is not None:
            most = fixed.wires.dac_rest - 1
            change = limit(np.clip(counts, -most, most) - counts, SENSORS)
            after = after + _rounded_sums(fixed.anti_windup, change[..., None, None, :])
        self._state = limit(after, STATES)
        return fixed.blocks.of_patches(counts, sensor.shape[-1])

    def reset(self, is_faulty: np.ndarray) -> None:
        self._state = np.where(is_faulty[..., None, None, None], 0, self._state)


def _rounded_sums(row: IntegerRow, x: np.ndarray) -> np.ndarray:
    """Rounded sums of products along the last axis."""
    return shifted(np.sum(row.integers * x, axis=-1), row.shift)


def shifted(x: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Divide by 2^shift and round to nearest, halves up."""
    return (x + (np.int64(1) << (shift - 1))) >> shift
