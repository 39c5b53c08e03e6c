"""The exported arithmetic in floating point, in NumPy: every signal for given ADC codes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.controller import Controller, read_back
from studies.engine.blocks import ModalBlocks
from studies.engine.channels import ActiveChannels, acting


class BlockSignals(NamedTuple):
    """Signals of a controller in blocks over time; leading axes (T, ...)."""

    state: np.ndarray  # [V], (..., G, N, b)
    demand: np.ndarray  # without limit [V], (..., G, M)
    command: np.ndarray  # [V], (..., 3, K)


class Signals(NamedTuple):
    """Signals of a controller over time; leading axes (T, ...)."""

    signal: np.ndarray  # of the channels [m] or [V], (..., M)
    high: np.ndarray  # behind the first section, (..., M)
    inner: np.ndarray  # delay line of the second section, (..., M)
    force: np.ndarray  # [N] or [V], (..., M)
    command: np.ndarray  # [V], (..., 3, K)


def respond(
    channels: ActiveChannels | ModalBlocks, controller: Controller, codes: np.ndarray
) -> Signals | BlockSignals:
    """Run a controller, from rest, on sequences of ADC codes.

    Args:
        channels: the controller as code needs it.
        controller: the same, for converters, limit and feed-through; NumPy arrays.
        codes: of the sensors, (T, ..., 3, K); sequences side by side.
    """
    return respond_from(channels, controller, codes, np.zeros(codes.shape[1:]))


def respond_from(
    channels: ActiveChannels | ModalBlocks,
    controller: Controller,
    codes: np.ndarray,
    command: np.ndarray,
) -> Signals | BlockSignals:
    """The same with voltages on the actuators at the beginning [V], (..., 3, K)."""
    run = _by_blocks if isinstance(channels, ModalBlocks) else _by_channels
    return run(channels, controller, codes, command)  # type: ignore[arg-type]


def _sensor_volts(controller: Controller, code: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Sensor voltages less the feed-through of the last command [V], (..., 3, K)."""
    own = np.einsum("ikl,...il->...ik", controller.feedthrough, command)
    return np.asarray(read_back(controller, code)) - own


def _by_blocks(
    blocks: ModalBlocks, controller: Controller, codes: np.ndarray, command: np.ndarray
) -> BlockSignals:
    rows, system = [], blocks.system
    state = np.zeros((*codes.shape[1:-2], *system.state.shape[:3]))
    limit = float(controller.voltage_limit)
    for code in codes:
        volts = blocks.of_groups(_sensor_volts(controller, code, command))
        demand = np.einsum("gpnb,...gnb->...gp", system.leave, state)
        demand = demand + np.einsum("gpm,...gm->...gp", system.direct, volts)
        state = np.einsum("gnbc,...gnc->...gnb", system.state, state)
        state = state + np.einsum("gnbm,...gm->...gnb", system.enter, volts)
        applied = np.clip(demand, -limit, limit)
        if system.anti_windup is not None:
            change = applied - demand
            state = state + np.einsum("gnbm,...gm->...gnb", system.anti_windup, change)
        command = blocks.of_patches(applied, codes.shape[-1])
        rows.append((state, demand, command))
    return BlockSignals(*map(np.stack, zip(*rows, strict=True)))


def _by_channels(
    channels: ActiveChannels, controller: Controller, codes: np.ndarray, command: np.ndarray
) -> Signals:
    rows = []
    link, many = channels.link, codes.shape[1:-2]
    memory = np.zeros((*many, len(link)))
    line = (memory, memory)
    limit = float(controller.voltage_limit)
    b0, b1, a1 = channels.first.T
    d1, d2 = channels.denominator.T
    c0, c1, c2 = channels.force.T
    back = np.zeros((codes.shape[-2], *channels.synthesizer.shape))
    back[link, np.arange(len(link))] = channels.synthesizer
    for code in codes:
        sensor = _sensor_volts(controller, code, command)
        signal = np.einsum("mk,...mk->...m", channels.filter, sensor[..., link, :])
        high = b0 * signal + memory
        memory = b1 * signal - a1 * high
        inner = high - d1 * line[0] - d2 * line[1]
        force = c0 * inner + c1 * line[0] + c2 * line[1] + channels.direct * signal
        if channels.energy is not None:
            taps = np.stack([inner, *line, signal], axis=-1)
            parts = np.einsum("mpt,...mt->...mp", channels.energy, taps)
            energy = np.sum(parts**2, axis=-1)
            force = force * acting(link, channels.is_rival, energy)
        line = (inner, line[0])
        command = np.clip(np.einsum("imk,...m->...ik", back, force), -limit, limit)
        rows.append((signal, high, inner, force, command))
    return Signals(*map(np.stack, zip(*rows, strict=True)))
