"""The exported fixed-point arithmetic in NumPy integers: what the C code does, bit by bit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.engine.channels import acting
from studies.export.fixed import FixedPoint, IntegerRow

#: Axes of one sequence's numbers.
SENSORS, CHANNELS = (-2, -1), (-1,)


class Response(NamedTuple):
    """Results of the integer arithmetic; counts are per sample, (T, ...)."""

    codes: np.ndarray  # of the DAC, (T, ..., 3, K)
    limited: np.ndarray  # internal signals clipped to 32 bits
    saturated: np.ndarray  # actuators at their limit
    is_faulty: np.ndarray  # whether actuators are at rest because of a faulty sensor


def respond(fixed: FixedPoint, codes: np.ndarray, rail: int) -> Response:
    """The exported arithmetic, bit by bit, on sequences of ADC codes from rest.

    Args:
        fixed: formats and coefficients.
        codes: 16-bit words, (T, ..., 3, K); sequences side by side.
        rail: samples at one end of the range after which a sensor is faulty.
    """
    many, n = codes.shape[1:-2], len(fixed.link)
    memory, older, old = np.zeros((3, *many, n), np.int64)
    command = np.zeros(codes.shape[1:], np.int64)
    at_end = np.zeros(codes.shape[1:], np.int64)  # samples at the highest code, or minus at 0
    is_faulty = np.zeros(many, bool)
    is_used = np.isin(np.arange(3), fixed.link)[:, None]
    rows = []
    for code in codes.astype(np.int64):
        end = (code == fixed.adc_top).astype(np.int64) - (code == 0)
        at_end = np.where(end * at_end > 0, at_end, 0) + end
        bad = ((code > fixed.adc_top) | (np.abs(at_end) >= rail)) & is_used
        is_faulty = is_faulty | bad.any(axis=(-2, -1))
        cut: list[np.ndarray] = []  # per sequence, how many were clipped
        sensor = _limited(code * 2**fixed.adc_bits - fixed.bias, cut, SENSORS)
        if fixed.feedthrough is not None:
            own = _products(fixed.feedthrough, command[..., None, :])
            sensor = _limited(sensor - own, cut, SENSORS)
        signal = _limited(_products(fixed.filter, sensor[..., fixed.link, :]), cut)
        high = _limited(_products(fixed.high_pass, signal[..., None]) + memory, cut)
        memory = _limited(_products(fixed.memory, np.stack([signal, high], -1)), cut)
        inner = _limited(_products(fixed.low_pass, np.stack([high, old, older], -1)), cut)
        taps = np.stack([inner, old, older, signal], -1)
        force = _limited(_products(fixed.numerator, taps), cut)
        if fixed.energy is not None:
            roots = _limited(_products(fixed.energy, taps[..., None, :]), cut, SENSORS)
            energy = np.sum(roots * roots, axis=-1)
            force = np.where(acting(fixed.link, fixed.is_rival, energy), force, 0)
        older, old = old, inner
        wanted = _limited(_products(fixed.synthesizer, force[..., None, None, :]), cut, SENSORS)
        command = np.minimum(np.maximum(wanted, 1 - fixed.dac_rest), fixed.dac_rest - 1)
        rest = is_faulty[..., None]
        memory, old, older = (np.where(rest, 0, x) for x in (memory, old, older))
        command = np.where(rest[..., None], 0, command)
        full = np.sum(np.abs(command) == fixed.dac_rest - 1, axis=(-2, -1))
        # a faulty sample ends before the arithmetic
        n_cut = np.where(is_faulty, 0, np.sum(cut, axis=0))
        rows.append((command + fixed.dac_rest, n_cut, full, is_faulty))
    return Response(*map(np.stack, zip(*rows, strict=True)))


def _limited(x: np.ndarray, cut: list[np.ndarray], axes: tuple[int, ...] = CHANNELS) -> np.ndarray:
    """Clip to 32 bits; the number clipped in each sequence is appended to `cut`."""
    inside = np.minimum(np.maximum(x, -(2**31)), 2**31 - 1)
    cut.append(np.sum(x != inside, axis=axes))
    return inside


def _products(row: IntegerRow, x: np.ndarray) -> np.ndarray:
    """Rounded sums of products along the last axis."""
    return shifted(np.sum(row.integers * x, axis=-1), row.shift)


def shifted(x: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Divide by 2^shift and round to nearest, halves up."""
    return (x + (np.int64(1) << (shift - 1))) >> shift
