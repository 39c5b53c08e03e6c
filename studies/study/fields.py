"""Fields of a study as arrays with a leading case axis, of length 1 where nothing varies.

A *column* holds the values of one field for many cases: numbers, or lists of equal shape, as a
NumPy array with the cases first; lists of unequal shape as an object array of tuples. A column can
also be named after an entry of a list, `control.velocity_gain[0]`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from studies.study.paths import as_list, field_value, known_field, own_place, parse_entry
from studies.study.spec import OWN_FIELDS, Study

Columns = Mapping[str, np.ndarray]


def column_of(values: list[Any]) -> np.ndarray:
    """Values of one field as a column: an array if they have one shape, otherwise of objects."""
    if isinstance(values[0], (tuple, list)) or any(isinstance(v, tuple) for v in values):
        try:
            array = np.array(values)
        except ValueError:
            array = np.empty(0, object)
        if array.dtype.kind in "bif" and array.ndim > 1 and len(array) == len(values):
            return array
        array = np.empty(len(values), object)
        array[:] = values
        return array
    return np.array(values)


def padded(values: list[Any], n_links: int) -> np.ndarray:
    """Numbers, or lists of any length, as one float array with NaN for missing entries.

    Beside lists, one number stands for all links; so does one list beside lists of lists.
    """
    depth = nesting(values)
    if depth == 0:
        return np.array(values, float)
    values = [x if nesting(x) == depth - 1 else (x,) * n_links for x in values]
    if all(np.size(np.array(value, object)) == 0 for value in values):
        return np.zeros((len(values), 0))
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
                    array = np.multiply.outer(array, np.array(as_list(field, 1.0, self.study)))
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


# --- where nothing depends on a field -------------------------------------------------------------
# What is listed here is proved by the equations; what only seldom matters is not. A law from a
# user's file may read any field, so that nothing is idle where one takes part.

_LAWS = {"imsc", "srf", "lqr", "modified_imsc", "ppf", "observer", "lqg", "state_space"}
_GAINS = (
    *("control.velocity_gain", "control.position_gain", "control.gain_", "control.laws."),
    *("control.ratios", "control.ratio_exponent", "control.mode_mask", "control.damping"),
    *("control.pole_", "control.feedthrough_factor", "control.notch_depth", "control.notch_width"),
)
Rule = tuple[str, tuple[Any, ...], tuple[str, ...]]
#: Where a field has one of these values, nothing depends on fields that begin so.
_RULES: tuple[Rule, ...] = (
    ("control.links", (False,), _GAINS),
    ("control.feedback", ("none",), _GAINS),
    ("control.notch_hz", (0.0,), ("control.notch_depth", "control.notch_width")),
    ("shaper.kind", ("none", "zv", "zvd", "zvdd"), ("shaper.tolerance",)),
    ("shaper.kind", ("none",), ("shaper.frequencies_hz", "shaper.damping_ratio", "shaper.split")),
    ("electronics.estimator", ("modal_phase",), ("electronics.difference_cutoff_hz",)),
    ("electronics.estimator", ("difference",), ("electronics.lowpass_", "electronics.highpass_hz")),
    ("patches.sensor", ("piezo",), ("patches.gauge_",)),
    ("patches.sensor", ("strain_gauge",), ("electronics.sensor_highpass_hz",)),
    ("drive.coulomb_friction", (0.0,), ("drive.friction_speed",)),
    ("machine.joint_friction", (0.0,), ("machine.joint_friction_speed",)),
)


def idle_cases(study: Study, columns: Columns, name: str) -> tuple[np.ndarray, str]:
    """Cases in which nothing depends on a column, (n,) or (1,), and what says so.

    Args:
        study: values of all fields that do not vary.
        columns: the others.
        name: of one of them.
    """
    fields, why = Fields(study, columns), ""
    is_idle: np.ndarray = np.zeros(1, bool)
    if not {*fields.raw("control.law").tolist()} <= _LAWS:
        return is_idle, why
    for field, values, beginnings in (*_RULES, *_of_parts(name)):
        if name.startswith(beginnings):
            has = fields.raw(field) if isinstance(values[0], str) else fields.numbers(field)
            is_met = np.isin(has, values).reshape(len(has), -1).all(axis=1)
            if is_met.any():
                known = np.unique(has[is_met]).tolist() if has.dtype.kind == "U" else values
                is_idle, why = is_idle | is_met, f"{field} {' or '.join(map(str, known)).lower()}"
    return is_idle, why


def _of_parts(name: str) -> list[Rule]:
    """Own fields of a law, drive or mechanism: where another one is selected."""
    place = own_place(name)
    own = name.removeprefix(f"{place}.").partition(".")[0]
    others = [part.name for part in OWN_FIELDS[place].values() if part.name != own] if place else []
    return [(place.removesuffix("s"), tuple(others), (f"{place}.",))] if others else []


def idle_axes(study: Study, columns: Columns) -> list[str]:
    """A line for each column that nothing depends on in any case."""
    found = {name: idle_cases(study, columns, name) for name in columns}
    return [f"no metric depends on {x} with {y[1]}" for x, y in found.items() if y[0].all()]


def acting_columns(study: Study, columns: Columns) -> dict[str, np.ndarray]:
    """The columns with the study's value wherever nothing depends on theirs."""
    changed = dict(columns)
    for name, column in columns.items():
        is_idle, _ = idle_cases(study, columns, name)
        if is_idle.any():
            rows = zip(column.tolist(), np.broadcast_to(is_idle, len(column)), strict=True)
            value = known_field(name, study)
            changed[name] = column_of([value if idle else x for x, idle in rows])
    return changed
