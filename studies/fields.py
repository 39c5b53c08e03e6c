"""Fields of a study as arrays with a leading case axis, of length 1 where nothing varies.

A *column* holds the values of one field for many cases: numbers, or lists of equal shape, as a
NumPy array with the cases first; lists of unequal shape as an object array of tuples. A column may
also be named after an entry of a list, `control.velocity_gain[0]`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from studies.spec import EACH_LINK, Study

Columns = Mapping[str, np.ndarray]

#: An index that names its axis and counts from 1, as the files do: `residual_rms[link=1]`.
NAMED_INDEX = re.compile(r"\[(\w+)=(\d{1,6})\]")
LINKS = 3
_ENTRY = re.compile(r"(?P<field>[^\s\[\]]+)(?P<indices>(\[(0|[1-9]\d{0,5})\])*)")


class Entry(NamedTuple):
    """A field, or an entry of a list: `control.ratios[0][1]` is ("control.ratios", (0, 1))."""

    field: str
    indices: tuple[int, ...]


def parse_entry(name: str) -> Entry | None:
    """Split a name into field and indices; None where it is no such name."""
    match = _ENTRY.fullmatch(name)
    if match is None:
        return None
    return Entry(match["field"], tuple(map(int, re.findall(r"\d+", match["indices"]))))


def field_value(study: Study, field: str) -> Any:
    """Value of `section.field` of a study."""
    section, _, leaf = field.partition(".")
    value = getattr(study, section)
    return getattr(value, leaf) if leaf else value


def as_list(field: str, value: Any) -> Any:
    """A field's value where its entries are asked for: three, where one stands for all links."""
    return (value,) * LINKS if field in EACH_LINK and not isinstance(value, tuple) else value


def padded(values: list[Any]) -> np.ndarray:
    """Numbers, or lists of them of any lengths, as one float array, missing entries NaN."""
    if not isinstance(values[0], (tuple, list, np.ndarray)):
        return np.array(values, float)
    if all(np.size(np.array(value, object)) == 0 for value in values):
        return np.zeros((len(values), 0))
    depth = _depth(values)
    shape = [len(values)] + [0] * depth
    _measure(values, shape, 0)
    array = np.full(shape, np.nan)
    _fill(array, values)
    return array


def _depth(value: Any) -> int:
    if not isinstance(value, (tuple, list, np.ndarray)):
        return -1
    return 1 + max((_depth(entry) for entry in value), default=-1)


def _measure(value: Any, shape: list[int], level: int) -> None:
    for entry in value:
        if isinstance(entry, (tuple, list, np.ndarray)):
            shape[level + 1] = max(shape[level + 1], len(entry))
            _measure(entry, shape, level + 1)


def _fill(array: np.ndarray, value: Any) -> None:
    for k, entry in enumerate(value):
        if isinstance(entry, (tuple, list, np.ndarray)):
            _fill(array[k], entry)
        else:
            array[k] = entry


class Fields:
    """Every field of a study, some of them with one value per case.

    study: values of all fields that no column names. columns: the others.
    """

    def __init__(self, study: Study, columns: Columns | None = None) -> None:
        self.study = study
        self.columns = columns or {}

    def raw(self, field: str) -> np.ndarray:
        """Values as they were written, (m,) or (m, ...), m = 1 or the number of cases."""
        if field in self.columns:
            return self.columns[field]
        value = field_value(self.study, field)
        if isinstance(value, tuple):
            column = np.empty(1, object)
            column[0] = value
            return column
        return np.array([value])

    def numbers(self, field: str) -> np.ndarray:
        """As floats, entries of lists put in; what ragged lists lack is NaN."""
        raw = self.raw(field)
        if raw.dtype == object:
            is_mixed = field in EACH_LINK and any(isinstance(value, tuple) for value in raw)
            array = padded([as_list(field, x) for x in raw] if is_mixed else list(raw))
        else:
            array = raw.astype(float)
        for name, column in self.columns.items():
            entry = parse_entry(name)
            if entry is not None and entry.field == field and entry.indices:
                if array.ndim == 1:
                    array = np.repeat(array[:, None], LINKS, axis=1)
                if len(array) != len(column):
                    array = np.repeat(array, len(column), axis=0)
                np.moveaxis(array, 0, -1)[entry.indices] = np.moveaxis(column, 0, -1)
        return array

    def each_link(self, field: str) -> np.ndarray:
        """As floats, one for each link where one stands for all, (m, 3)."""
        array = self.numbers(field)
        return np.repeat(array[:, None], LINKS, axis=1) if array.ndim == 1 else array

    def choices(self, field: str, names: tuple[str, ...]) -> np.ndarray:
        """Position of each text value in `names`, (m,)."""
        raw = self.raw(field)
        distinct, inverse = np.unique(raw.astype(str), return_inverse=True)
        return np.array([names.index(name) for name in distinct])[inverse]
