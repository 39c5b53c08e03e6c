"""Fields of a study as arrays with a leading case axis, of length 1 where nothing varies.

A *column* holds the values of one field for many cases: numbers, or lists of equal shape, as a
NumPy array with the cases first; lists of unequal shape as an object array of tuples. A column can
also be named after an entry of a list, `control.velocity_gain[0]`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from studies.study.paths import field_value, parse_entry
from studies.study.spec import Study

Columns = Mapping[str, np.ndarray]


def padded(values: list[Any], n_links: int) -> np.ndarray:
    """Numbers, or lists of any length, as one float array with NaN for missing entries.

    Beside lists, one number stands for all links.
    """
    is_list = [isinstance(value, (tuple, list, np.ndarray)) for value in values]
    if not any(is_list):
        return np.array(values, float)
    values = [x if is_it else (x,) * n_links for x, is_it in zip(values, is_list, strict=True)]
    if all(np.size(np.array(value, object)) == 0 for value in values):
        return np.zeros((len(values), 0))
    depth = nesting(values)
    shape = [len(values)] + [0] * depth
    _measure(values, shape, 0)
    array = np.full(shape, np.nan)
    _fill(array, values)
    return array


def row_keys(columns: Iterable[np.ndarray]) -> np.ndarray:
    """Bytes that are equal for rows whose numbers are equal in all columns, (n,).

    Args:
        columns: of numbers, one row each, (n, ...).
    """
    flat = [x.reshape(len(x), int(np.prod(x.shape[1:]))) for x in columns]
    whole = np.concatenate([np.ascontiguousarray(x).view(np.uint8) for x in flat], axis=1)
    return whole.view(np.dtype((np.void, whole.shape[1]))).ravel()


def nesting(value: Any) -> int:
    """Levels of lists inside a list; -1: no list."""
    if not isinstance(value, (tuple, list, np.ndarray)):
        return -1
    return 1 + max((nesting(entry) for entry in value), default=-1)


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


def _spread(array: np.ndarray, value: Any, at: tuple[int, ...] = ()) -> None:
    if not isinstance(value, (tuple, list, np.ndarray)):
        array[at] = value
        return
    for k, entry in enumerate(value[: array.shape[len(at)]]):
        _spread(array, entry, (*at, k))


class Fields:
    """All fields of a study, some with one value per case.

    study: values of all fields that no column names. columns: the others.
    """

    def __init__(self, study: Study, columns: Columns | None = None) -> None:
        self.study = study
        self.columns = columns or {}

    def raw(self, field: str) -> np.ndarray:
        """Values as written, (m,) or (m, ...), m = 1 or the number of cases."""
        if field in self.columns:
            return self.columns[field]
        value = field_value(self.study, field)
        if isinstance(value, tuple):
            column = np.empty(1, object)
            column[0] = value
            return column
        return np.array([value])

    def numbers(self, field: str) -> np.ndarray:
        """As floats, with entries of lists filled in; NaN pads ragged lists."""
        raw = self.raw(field)
        array = padded(list(raw), self.study.n_links) if raw.dtype == object else raw.astype(float)
        return self._with_entries(field, array)

    def spread(self, field: str, shape: tuple[int, ...], missing: float = 0.0) -> np.ndarray:
        """As floats, (m, *shape): a number stands for all below it; `missing` without any."""
        raw = self.raw(field)
        array = np.full((len(raw), *shape), missing)
        for whole, value in zip(array, raw, strict=True):
            _spread(whole, value)
        return self._with_entries(field, array)

    def _with_entries(self, field: str, array: np.ndarray) -> np.ndarray:
        """With the columns of single entries of its lists."""
        for name, column in self.columns.items():
            entry = parse_entry(name)
            if entry is not None and entry.field == field and entry.indices:
                if array.ndim == 1:
                    array = np.repeat(array[:, None], self.study.n_links, axis=1)
                if len(array) != len(column):
                    array = np.repeat(array, len(column), axis=0)
                np.moveaxis(array, 0, -1)[entry.indices] = np.moveaxis(column, 0, -1)
        return array

    def each_link(self, field: str) -> np.ndarray:
        """As floats, one for each link even if one stands for all, (m, n)."""
        array = self.numbers(field)
        return np.repeat(array[:, None], self.study.n_links, axis=1) if array.ndim == 1 else array

    def choices(self, field: str, names: tuple[str, ...]) -> np.ndarray:
        """Index of each text value in `names`, (m,)."""
        raw = self.raw(field)
        distinct, inverse = np.unique(raw.astype(str), return_inverse=True)
        return np.array([names.index(name) for name in distinct])[inverse]
