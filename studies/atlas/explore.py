"""An atlas as a page to look at, see `studies.explorer`: the runs of its subsets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from studies.explorer.table import ExplorerTable
from studies.sweeps.explore import explore_sweep


def explore_atlas(folder: Path, on_progress: Callable[[int, int], None]) -> ExplorerTable:
    """All runs of an atlas, arguments and errors as `explore_sweep`."""
    return explore_sweep(folder / "runs", on_progress)
