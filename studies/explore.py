"""From a folder of results to its explorer, whatever kind of results they are."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from rich.console import Console

from studies.atlas.explore import explore_atlas
from studies.atlas.run import RUNS_FOLDER
from studies.engine.folder import MANIFEST, TUNING
from studies.errors import StudyError
from studies.explorer.page import write_explorer
from studies.fitting.explore import explore_fit
from studies.fitting.run import DATA as FIT
from studies.publish import check_folder
from studies.sweeps.explore import explore_sweep
from studies.tuning.explore import explore_tuning

#: What fills a page, by what its folder holds.
_KINDS = {
    MANIFEST: explore_sweep,
    TUNING: explore_tuning,
    FIT: explore_fit,
    f"{RUNS_FOLDER}/{MANIFEST}": explore_atlas,
}


def explore_results(
    folder: str | Path, console: Console | None = None, subject_to: str = ""
) -> Path:
    """Write `explorer.html` into a folder of results, and return its path.

    Args:
        folder: of a sweep, a tuning, a fit or an atlas.
        console: where progress goes; default: nowhere.
        subject_to: condition on metrics and axes of a sweep; the best that meet it are replayed.

    Raises:
        StudyError: no results there, damaged ones, or a file that cannot be written.
    """
    folder = Path(folder)
    fill = next((fill for name, fill in _KINDS.items() if os.path.isfile(folder / name)), None)
    if fill is None:
        raise StudyError(f"{folder}: no results of a sweep, a tuning, a fit or an atlas there")
    check_folder(folder)
    if subject_to and fill is not explore_sweep:
        raise StudyError(f"--subject-to {subject_to!r}: {folder} is not the folder of a sweep")
    if subject_to:
        fill = partial(explore_sweep, subject_to=subject_to)
    return write_explorer(folder, fill, console)
