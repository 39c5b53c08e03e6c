"""Fixed point of a controller in blocks: formats, integer coefficients, bounds on rounding errors.

As in `studies.export.fixed`: each state is a signal with its own base and fraction bits, each row
of coefficients has its own shift, and bounds hold for any sequence of ADC codes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel.state_space import StateSpace, dense
from studies.engine.blocks import ImpulseResponses, ModalBlocks, responses
from studies.engine.channels import ActiveChannels
from studies.engine.controller import FixedController
from studies.errors import StudyError
from studies.export.fixed import (
    FORGOTTEN,
    LONGEST_MEMORY,
    WORD,
    ErrorBound,
    FixedPoint,
    Format,
    IntegerRow,
    Wires,
    check_words,
    design_fixed,
    design_wires,
    find_format,
    find_row,
    output_error_bound,
    rounded,
    sensor_bound,
)
from studies.export.floating import BlockSignals, Signals


class FixedBlocks(NamedTuple):
    """A controller in fixed point; groups first, as in `ModalBlocks`."""

    wires: Wires
    blocks: ModalBlocks  # the same in SI units
    state: Format  # [V], (G, N, b)
    advance: IntegerRow  # states of the block, then the sensors, (G, N, b, b + M)
    leave: IntegerRow  # all states of the group, then the sensors, (G, M, b N + M)
    error: ErrorBound
    # states from what the limits change, in DAC codes, (G, N, b, M); None: they are not told
    anti_windup: IntegerRow | None = None

    @property
    def formats(self) -> list[tuple[str, Format, str]]:
        """Signals, their formats and units."""
        flat = Format(*(np.reshape(part, -1) for part in self.state))
        return [("state", flat, "V")]

    @property
    def link(self) -> np.ndarray:
        """Controlled links, from 0."""
        return self.blocks.link

    @property
    def energy(self) -> None:
        """No blocks are rivals."""
        return


def design_blocks(
    exported: FixedController, signals: BlockSignals, dac_bits: int, word: int = WORD
) -> FixedBlocks:
    """Formats and coefficients; arguments and errors as `studies.export.fixed.design_fixed`."""
    blocks = exported.channels
    assert isinstance(blocks, ModalBlocks)
    check_words(exported)
    wires = design_wires(exported, dac_bits, word)
    system, memory = blocks.system, blocks.memory(FORGOTTEN)
    groups, _, _, size = system.enter.shape
    volts = blocks.of_groups(sensor_bound(exported.controller))  # (G, M)
    each = [responses(system, g, memory) for g in range(groups)]
    if system.anti_windup is None:
        bounds = [np.abs(x.state).sum(axis=3) @ v for x, v in zip(each, volts, strict=True)]
    else:
        limit = float(exported.controller.voltage_limit)
        bounds = [_bound_observer(blocks, g, volts[g], limit) for g in range(groups)]
    bound = np.stack(bounds)
    state = find_format(signals.state, np.maximum(bound, np.finfo(float).tiny), word)
    step, sensor = state.step, wires.sensor_step
    within = system.state * step[:, :, None, :] / step[..., None]
    entering = system.enter * sensor / step[..., None]
    leaving = (system.leave * step[:, None] / wires.dac_step).reshape(groups, size, -1)
    direct = system.direct * sensor / wires.dac_step
    fixed = FixedBlocks(
        wires=wires,
        blocks=blocks,
        state=state,
        advance=find_row(np.concatenate([within, entering], axis=3), "states", word),
        leave=find_row(np.concatenate([leaving, direct], axis=2), "outputs", word),
        error=ErrorBound(*np.zeros((3, exported.n_links, exported.n_patches))),
        anti_windup=None
        if system.anti_windup is None
        else find_row(system.anti_windup * wires.dac_step / step[..., None], "anti-windup", word),
    )
    return fixed._replace(error=_error_bound(exported, blocks, fixed, each, memory))


def rounded_blocks(fixed: FixedBlocks, like: ModalBlocks) -> ModalBlocks:
    """The blocks that the integers represent, in SI units."""
    step, wires = fixed.state.step, fixed.wires
    order = step[0].size
    advance, leave = fixed.advance.values, fixed.leave.values
    return like._replace(
        system=StateSpace(
            state=advance[..., : step.shape[2]] * step[..., None] / step[:, :, None, :],
            enter=advance[..., step.shape[2] :] * step[..., None] / wires.sensor_step,
            leave=leave[..., :order].reshape(like.system.leave.shape)
            * wires.dac_step
            / step[:, None],
            direct=leave[..., order:] * wires.dac_step / wires.sensor_step,
            anti_windup=None
            if fixed.anti_windup is None
            else fixed.anti_windup.values * step[..., None] / wires.dac_step,
        )
    )


def design_integers(
    exported: FixedController, signals: Signals | BlockSignals, dac_bits: int, word: int = WORD
) -> tuple[FixedPoint | FixedBlocks, ActiveChannels | ModalBlocks]:
    """A controller of either kind in fixed point, and what its integers represent.

    Args:
        exported: the controller.
        signals: of the simulated motion, from `studies.export.floating.respond`.
        dac_bits: resolution of the DAC.
        word: bits of a signal, 16 or 32.

    Raises:
        StudyError: what cannot be represented, with the number and a remedy.
    """
    if isinstance(exported.channels, ModalBlocks):
        assert isinstance(signals, BlockSignals)
        blocks = design_blocks(exported, signals, dac_bits, word)
        return blocks, rounded_blocks(blocks, exported.channels)
    assert isinstance(signals, Signals)
    fixed = design_fixed(exported, signals, dac_bits, word)
    return fixed, rounded(fixed, exported.channels)


def _bound_observer(
    blocks: ModalBlocks, group: int, sensor: np.ndarray, limit: float
) -> np.ndarray:
    """Largest states that any sensor voltages and limited commands can produce, (N, b).

    With v = u + (v - u): x_(k+1) = (A - E C) x_k + (B - E D) y_k + E v_k, in which |v| is at most
    the limit, so that the sums of impulse responses bound every sequence.

    Raises:
        StudyError: that matrix is not stable, or forgets too slowly.
    """
    one = jax.tree.map(lambda part: part[group : group + 1], blocks.system)
    a, b, c, d = dense(one)
    tell = one.anti_windup.reshape(b.shape)
    a, b = a - tell @ c, b - tell @ d
    radius = float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))
    if not radius < 1 + np.log(FORGOTTEN) / LONGEST_MEMORY:
        raise StudyError(
            f"fixed point: with commands at their limits the controller has a pole of modulus "
            f"{radius:.12g}; allowed: below 1, or its states have no bound (or --target c)"
        )
    power = np.hstack([b * sensor, tell * limit])
    total = np.abs(power)
    while np.any(np.abs(power) > FORGOTTEN * np.maximum(total, np.finfo(float).tiny)):
        power = a @ power
        total = total + np.abs(power)
    bound: np.ndarray = total.sum(axis=1).reshape(one.state.shape[1:3])
    return bound


def _error_bound(
    exported: FixedController,
    exact: ModalBlocks,
    fixed: FixedBlocks,
    each: list[ImpulseResponses],
    memory: int,
) -> ErrorBound:
    """Peak errors at the actuators: the sum of every rounding through its peak gain."""
    near, half = rounded_blocks(fixed, exact), 0.5
    volts = exact.of_groups(sensor_bound(exported.controller))
    rounding, coefficients = [], []
    for g, true in enumerate(each):
        own = responses(near.system, g, memory)
        # bias and feed-through are rounded once each
        entering = fixed.wires.sensor_step * np.abs(true.command).sum(axis=(1, 2))
        states = np.abs(own.kicked).sum(axis=3)  # (M, N, b)
        rounding.append(entering + half * np.sum(states * fixed.state.step[g], axis=(1, 2)))
        coefficients.append(np.abs(own.command - true.command).sum(axis=2) @ volts[g])
    parts = [exact.of_patches(np.array(x), exported.n_patches) for x in (rounding, coefficients)]
    inside = parts[0] + parts[1] + half * fixed.wires.dac_step
    return ErrorBound(parts[0], parts[1], output_error_bound(exported, inside))
