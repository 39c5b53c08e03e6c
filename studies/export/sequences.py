"""ADC codes that no plant would produce, for comparing controllers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

#: Samples of each sequence.
LENGTH = 3000


def hard_sequences(recorded: np.ndarray, top: int, rail: int) -> dict[str, np.ndarray]:
    """Sequences without a sensor fault, by name.

    Args:
        recorded: codes of a run, (T, 3, K).
        top: highest code.
        rail: samples at an end after which a sensor is faulty.

    Returns:
        each (LENGTH, 3, K) or shorter.
    """
    rng = np.random.default_rng(0)
    shape = (LENGTH, *recorded.shape[1:])
    sample = np.arange(LENGTH)[:, None, None]
    # every channel with its own period, all just short of a fault
    longest = max(rail - 1, 1)
    half = np.clip(rng.integers(1, 90, shape[1:]), 1, longest)
    stuck = np.clip(recorded[:LENGTH], 1, top - 1)
    stuck[:, 0, 0] = stuck[len(stuck) // 2, 0, 0]
    stuck[len(stuck) // 2 :, -1, -1] = top // 5
    slow = np.clip(np.round(top * (0.5 + 0.5 * np.sin(2 * np.pi * sample / 97))), 1, top - 1)
    return {
        "random codes": rng.integers(1, top, shape).astype(float),
        "full-scale square waves": np.where(sample // half % 2, float(top), 0.0),
        "full-scale square waves in phase": np.broadcast_to(
            np.where(sample // min(43, longest) % 2, float(top), 0.0), shape
        ),
        "sine of nearly full scale": np.broadcast_to(slow, shape),
        "stuck sensors": stuck,
    }


def stuck_at_end(recorded: np.ndarray, top: int, channel: tuple[int, int]) -> np.ndarray:
    """A recorded run whose sensor `channel` (link, patch from 0) sticks at the highest code."""
    codes = np.array(recorded)
    codes[len(codes) // 3 :, channel[0], channel[1]] = top
    return codes


def episodes(count: int, shape: tuple[int, int], top: int, rail: int) -> Iterator[np.ndarray]:
    """Random codes in which every second sequence has a sensor fault, each to begin at rest.

    Args:
        count: sequences.
        shape: links and patches.
        top: highest code.
        rail: samples at an end after which a sensor is faulty.

    Yields:
        (LENGTH, 3, K) each.
    """
    rng = np.random.default_rng(2)
    for episode in range(count):
        # steps of random size and length around mid-scale, which excite all filters
        size, length = top * 10 ** rng.uniform(-3, -0.31), int(rng.integers(1, 60))
        steps = rng.normal(0, size, (LENGTH // length + 1, *shape))
        codes = np.clip(np.round(top / 2 + np.repeat(steps, length, axis=0)), 1, top - 1)[:LENGTH]
        if episode % 2:
            begin = int(rng.integers(LENGTH // 2, LENGTH - rail))
            at = int(rng.integers(shape[0])), int(rng.integers(shape[1]))
            codes[begin : begin + rail, *at] = rng.choice([0, top, min(top + 1, 2**16 - 1)])
        yield codes
