"""From a folder of results to its explorer, whatever kind of results they are."""

from __future__ import annotations

import os
from functools import partial
from importlib import import_module
from pathlib import Path

from rich.console import Console

from studies.engine.folder import ATLASES, FIT, MANIFEST, TUNING
from studies.errors import StudyError
from studies.explorer.page import write_explorer

#: By what a folder holds: the module and the function that fill a page, imported when needed.
_KINDS = {
    MANIFEST: ("studies.sweeps.explore", "explore_sweep"),
    TUNING: ("studies.tuning.explore", "explore_tuning"),
    FIT: ("studies.fitting.explore", "explore_fit"),
    f"{ATLASES.mark}/{MANIFEST}": ("studies.atlas.explore", "explore_atlas"),
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
    kind = next((name for name in _KINDS if os.path.isfile(folder / name)), None)
    if kind is None:
        raise StudyError(f"{folder}: no results of a sweep, a tuning, a fit or an atlas there")
    if subject_to and kind != MANIFEST:
        raise StudyError(f"--subject-to {subject_to!r}: {folder} is not the folder of a sweep")
    module, name = _KINDS[kind]
    fill = getattr(import_module(module), name)
    if subject_to:
        fill = partial(fill, subject_to=subject_to)
    return write_explorer(folder, fill, console)
