"""Cost of a sample on a TMS320F2812-class DSP: 32-bit fixed point, no floating-point unit."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from studies.engine.blocks import ModalBlocks
from studies.engine.channels import ActiveChannels
from studies.engine.controller import FixedController
from studies.export.fixed import FixedPoint
from studies.export.fixed_blocks import FixedBlocks


class Cost(NamedTuple):
    """Cost of a sample of controller and shaper on a DSP without a floating-point unit."""

    products: int  # of 32 by 32 bits
    roundings: int  # shifts and limits of 64-bit sums
    cycles: int  # estimate
    load: float  # share of the available time, estimate [1]
    words: int  # of 16 bits, for both states

    @property
    def text(self) -> str:
        highest = CLOCK / self.cycles
        slow = f". CAUTION: it cannot keep up; at this clock up to {highest:.0f} Hz can be sampled"
        return (
            f"{self.products} multiplications a sample, about {self.cycles} cycles: "
            f"{100 * self.load:.0f} % of a sample at {CLOCK / 1e6:.0f} MHz (estimate)"
            f"{slow if self.load > 1 else ''}"
        )


#: Clock of a TMS320F2812 [Hz].
CLOCK = 150e6
#: Cycles of a product with its loads and the 64-bit addition, of a rounding with limit, of a
#: channel with its checks, and of a call: instructions counted generously, not measured.
CYCLES = (12, 30, 30, 200)


def cost_of(exported: FixedController, fixed: FixedPoint | FixedBlocks) -> Cost:
    """Multiplications, cycles, load and memory of a sample."""
    n_taps, k = len(exported.taps.weight), exported.n_patches
    n_channels = k * len(np.unique(exported.channels.link))
    count = _of_blocks if isinstance(fixed, FixedBlocks) else _of_channels
    roundings, words = count(fixed)  # type: ignore[arg-type]
    links, pose = exported.n_links, exported.structure.n_pose
    # codes to counts; the coordinates of the shaper
    products = products_of(exported.channels) + n_channels + pose * n_taps
    roundings += 2 * n_channels + pose
    words += links * k + 1 + 2 * (pose * (int(exported.taps.sample.max()) + 1) + 1)
    if fixed.wires.feedthrough is not None:
        products, roundings = products + n_channels * k, roundings + n_channels
        words += 2 * links * k
    parts = (products, roundings, n_channels, 1)
    cycles = sum(count * each for count, each in zip(parts, CYCLES, strict=True))
    load = cycles * exported.study.electronics.sample_rate_hz / CLOCK
    return Cost(products=products, roundings=roundings, cycles=cycles, load=load, words=words)


def products_of(channels: ActiveChannels | ModalBlocks) -> int:
    """Multiplications of filter, synthesizer and sections in a sample; of blocks, also by 0."""
    if isinstance(channels, ModalBlocks):
        return int(sum(np.size(x) for x in jax.tree.leaves(channels.system)))
    n, k = channels.filter.shape
    switched = 0 if channels.energy is None else 10
    return n * (2 * k + 1 + 2 + 3 + 3 + bool(np.any(channels.direct)) + switched)


def _of_channels(fixed: FixedPoint) -> tuple[int, int]:
    """Roundings and words of filter, synthesizer and sections."""
    n = len(fixed.filter.integers)
    return 5 * n + (0 if fixed.energy is None else 2 * n), 2 * 3 * n


def _of_blocks(fixed: FixedBlocks) -> tuple[int, int]:
    """The same of all blocks."""
    states = fixed.state.bits.size
    roundings = states + fixed.leave.shift.size
    return roundings + (0 if fixed.anti_windup is None else states), 2 * states
