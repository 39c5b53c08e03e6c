"""From a folder of results to its explorer, whatever kind of results they are."""

from __future__ import annotations

import os
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from studies.errors import StudyError
from studies.job import KINDS
from studies.verbs import check_file, verb

if TYPE_CHECKING:
    from studies.explorer.page import Explorer

#: By what a folder holds: the module and the function that fill a page, imported when needed.
_KINDS = {
    KINDS["sweep"].mark: ("studies.sweeps.explore", "explore_sweep"),
    KINDS["tune"].mark: ("studies.tuning.explore", "explore_tuning"),
    "fit.h5": ("studies.fitting.explore", "explore_fit"),
    "runs/sweep.json": ("studies.atlas.explore", "explore_atlas"),
}


@verb
def explore(
    what: str | Path, out: str | Path | None = None, *, subject_to: str = "", progress: bool = True
) -> Explorer:
    """Write a page on which all cases can be looked at: brushed plots, tables, motion.

    Args:
        what: folder of a sweep, a tuning, a fit or an atlas.
        out: HTML file for the page; default: explorer.html in that folder.
        subject_to: condition whose best cases are replayed, too; for sweeps.
        progress: show how far it is.

    Returns:
        The page; notebooks show where it is.

    Raises:
        StudyError: no results there, damaged ones, or a file that cannot be written.

    Example:
        >>> explore("gains").folder  # doctest: +SKIP
    """
    from studies.explorer.page import write_explorer

    check_file(out, ".html")
    folder = Path(what)
    kind = next((name for name in _KINDS if os.path.isfile(folder / name)), None)
    if kind is None:
        raise StudyError(f"{folder}: no results of a sweep, a tuning, a fit or an atlas there")
    if subject_to and kind != KINDS["sweep"].mark:
        raise StudyError(f"--subject-to {subject_to!r}: {folder} is not the folder of a sweep")
    module, name = _KINDS[kind]
    fill = getattr(import_module(module), name)
    if subject_to:
        fill = partial(fill, subject_to=subject_to)
    return write_explorer(folder, fill, None if out is None else Path(out), progress)
