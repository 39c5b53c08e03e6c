"""Reading whatever a file, a folder or a name holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from studies.engine.design import load_design
from studies.export.document import import_study
from studies.fitting.spec import parse_fit
from studies.job import KINDS
from studies.space.spec import parse_sweep
from studies.study.files import find_spec, read_toml
from studies.study.spec import parse_study
from studies.sweeps.result import read_result
from studies.tuning.spec import parse_tuning

#: What reads a file, by a section that it has; "": a study, which has none of these.
_READERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "": parse_study,
    "sweep": parse_sweep,
    "tune": parse_tuning,
    "fit": parse_fit,
}


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
        section = next((name for name in _READERS if name in what), "")
        return _READERS[section](dict(what))
    path = Path(what)
    if path.is_dir():
        is_sweep = (path / KINDS["sweep"].mark).is_file()
        return read_result(path) if is_sweep else load_design(path).study
    if path.suffix == ".json":
        return import_study(path)
    data = read_toml(path)
    if "commission" in data:
        from studies.commission.spec import load_measured

        return load_measured(path)
    if "fit" in data:
        return parse_fit(data, find_spec(path).parent)
    return load(data) if data.keys() & _READERS.keys() else load_design(path).study
