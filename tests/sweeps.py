"""A small sweep that all tests of the batch engine share, so that it is compiled once."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from studies.engine import plan
from studies.job import working
from studies.screen import shards
from studies.sweeps.run import sweep_phases, swept_into
from tests.bare import bare, parse_sweep

HOME_PHI = float(np.pi / 6)
#: 2 mm in 15 ms, then 10 ms; two modes.
BASE = {
    "title": "small",
    "run": {"duration": 0.025},
    "link": {"modes": 3},
    "motion": {"waypoints": [[0, 0, HOME_PHI], [0, 0.002, HOME_PHI]], "move_time": 0.01},
    "shaper": {"kind": "zv"},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.01},
}
MIXED = {
    "method": "grid",
    "axes": {
        "controlled_modes": [1, 2, 3],
        "plant_modes": [2, 3],
        "link_subsets": ["none", "1", "1+2+3"],
    },
    "blocks": [{"method": "sobol", "count": 4, "axes": {"placement": {"kind": "same"}}}],
}


def small(sweep=MIXED, **sections):
    """Dictionary of a sweep on the small machine."""
    data = bare(copy.deepcopy(BASE) | copy.deepcopy(sections))
    return data | {"sweep": copy.deepcopy(sweep)}


def small_spec(sweep=MIXED, **sections):
    return parse_sweep(small(sweep, **sections))


def run_sweep(spec, out, resume=False, **options):
    """A sweep in a folder, quietly; options: as in `swept_into`."""
    with working("sweep", out, None, sweep_phases(spec), resume, progress=False) as job:
        return swept_into(spec, job, **options)


@contextmanager
def narrow_blocks(largest_chunk: int = plan.LARGEST_CHUNK) -> Iterator[None]:
    """Blocks of 8 cases, so that sweeps of all sizes share programs.

    Not by `monkeypatch`, which keeps no programs: these are kept by their sizes.
    """
    before = plan.LANES, shards.LANES, plan.LARGEST_CHUNK
    plan.LANES, shards.LANES, plan.LARGEST_CHUNK = 8, 8, largest_chunk
    try:
        yield
    finally:
        plan.LANES, shards.LANES, plan.LARGEST_CHUNK = before


#: Sections of a fast move without a shaper.
FAST_MOVE = """
[motion]
waypoints = [[0.0, 0.0, 0.5236], [0.0, 0.01, 0.5236]]
move_time = 0.03
[shaper]
kind = "none"
"""
