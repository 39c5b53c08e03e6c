"""What the phases after the descent found, kept in the folder: a resumed tuning repeats none.

Results of phases are named tuples, lists and dictionaries of arrays and numbers. They are written
as arrays with a description of how they nest, so that reading them runs no code.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from studies.engine.poles import PoleReport
from studies.publish import replacing
from studies.reading import read_npz
from studies.store import numbers_digest
from studies.tuning.audit import Disagreement
from studies.tuning.check import JudgedDesign, OwnRun, RandomSearch
from studies.tuning.loop_figures import DesignFigures
from studies.tuning.optimise import Progress
from studies.tuning.references import GainScan, References

FILE = "phases.npz"
_RECORDS = {
    record.__name__: record
    for record in (
        DesignFigures,
        Disagreement,
        GainScan,
        JudgedDesign,
        OwnRun,
        PoleReport,
        RandomSearch,
        References,
    )
}


class KeptPhases:
    """Results of the phases of a tuning that has ended its descent."""

    def __init__(self, folder: Path, at: Progress) -> None:
        """
        Args:
            folder: of the tuning.
            at: where the descent ended; results of another end are not used.
        """
        self._path = folder / FILE
        self._end = numbers_digest({"place": at.best_place, "iteration": at.iteration})
        self._found: dict[str, Any] = {}
        try:
            arrays = read_npz(self._path)
            end, digest = (str(arrays.pop(name)) for name in ("end", "digest"))
            if end == self._end and digest == numbers_digest(arrays):
                self._found = unpacked(json.loads(str(arrays.pop("form"))), arrays)
        except (OSError, ValueError, KeyError, TypeError):
            pass  # not there or damaged: the phases run again

    def find(self, name: str, make: Callable[[], Any]) -> Any:
        """What a phase has found, or finds now."""
        if name not in self._found:
            self._found[name] = make()
            arrays: dict[str, np.ndarray] = {}
            arrays["form"] = np.array(json.dumps(packed(self._found, arrays)))
            whole: Any = {**arrays, "digest": numbers_digest(arrays), "end": self._end}
            with replacing(self._path) as temporary, temporary.open("wb") as file:
                np.savez(file, allow_pickle=False, **whole)
        return self._found[name]


def packed(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """How a value nests, for JSON; its numbers and texts are added to `arrays`."""
    if value is None:
        return None
    if isinstance(value, Mapping):
        return {"of": {name: packed(x, arrays) for name, x in value.items()}}
    if isinstance(value, list | tuple):
        kind = type(value).__name__
        return {kind: [packed(x, arrays) for x in value]}
    name = f"x{len(arrays)}"
    arrays[name] = np.asarray(value)
    return {"array" if isinstance(value, np.ndarray) else "item": name}


def unpacked(form: Any, arrays: dict[str, np.ndarray]) -> Any:
    """The value that `packed` has described."""
    if form is None:
        return None
    ((kind, content),) = form.items()
    if kind == "of":
        return {name: unpacked(x, arrays) for name, x in content.items()}
    if kind in ("array", "item"):
        return arrays[content] if kind == "array" else arrays[content].item()
    entries = [unpacked(x, arrays) for x in content]
    if kind in ("list", "tuple"):
        return entries if kind == "list" else tuple(entries)
    return _RECORDS[kind](*entries)
