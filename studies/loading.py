"""Reading whatever a file, a folder or a name holds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from studies.commission.spec import parse_measured
from studies.engine.design import load_design
from studies.export.document import import_study
from studies.fitting.spec import parse_fit
from studies.job import KINDS
from studies.space.spec import parse_sweep
from studies.study.files import find_spec, read_toml
from studies.study.spec import parse_study
from studies.sweeps.result import read_result
from studies.tuning.spec import parse_tuning


def load(what: Mapping[str, Any] | str | Path) -> Any:
    """What a file, a folder or a ready-made name holds.

    Args:
        what: study file (TOML), or one with a section [sweep], [tune], [fit] or [commission]; its
            sections as a dictionary; the name of a ready-made one; JSON file of `export`; folder of
            a sweep or a tuning.

    Returns:
        A `Study`; what the verb of that section takes; of a sweep its results, of a tuning its
        best study.

    Raises:
        StudyError: not found, damaged, or not valid.

    Example:
        >>> load("paper").change(control__gain_factor=0.5).control.gain_factor
        0.5
    """
    if isinstance(what, Mapping):
        return _parsed(dict(what), Path())
    path = Path(what)
    if path.is_dir():
        is_sweep = (path / KINDS["sweep"].mark).is_file()
        return read_result(path) if is_sweep else load_design(path).study
    if path.suffix == ".json":
        return import_study(path)
    return _parsed(read_toml(path), find_spec(path).parent)


def _parsed(data: dict[str, Any], folder: Path) -> Any:
    """What sections hold; folder: where files that they name are."""
    if "commission" in data:
        return parse_measured(data, folder)
    if "fit" in data:
        return parse_fit(data, folder)
    if "tune" in data:
        return parse_tuning(data)
    return parse_sweep(data) if "sweep" in data else parse_study(data)
