"""The numbers of a study, or of many, by the names of the file.

They are one dictionary: the name of each field, as in the file and in its unit, with an array of a
shape that the schema decides. Lists of unequal length are padded with NaN, a number that stands for
all links is there once for each, choices are positions among their names, truth values are 1 or 0.
`jaxmodel.numbers.case_of` turns them into the arrays of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from types import EllipsisType
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.defaults import OF_MODE_1
from jaxmodel.laws.state_space import STATE_SPACE
from jaxmodel.numbers import Numbers, case_of
from studies.study.consistency import EACH_PATCH
from studies.study.fields import Columns, Fields, nesting
from studies.study.paths import Parts, all_fields, field_choices, own_fields, own_place, parse_entry
from studies.study.sizes import alternatives, depth, has_one_a_link
from studies.study.spec import OWN_FIELDS, Study
from studies.study.state_space import system_of
from studies.study.window import DELAY, residual_delay

#: How a field's array looks, without the axis of cases: () for a number or (n, ...) for a list;
#: one entry a link, (l,); a list a link, (l, n); one entry for each controlled mode of each link,
#: (l, C); a position among names; one entry a move, (n,), n = 1 if one stands for all.
Form = Literal["plain", "integer", "choice", "link", "list of links", "mode", "move"]


@cache
def form_of(field: str) -> Form:
    """How the array of a field looks, from its type in the schema."""
    if own_place(field):
        return "link"
    if field_choices(field):
        return "choice"
    annotation = _annotation(field)
    if annotation is int:
        return "integer"
    depths = set(map(depth, alternatives(annotation)))
    is_by_link = has_one_a_link(annotation)
    if {1, 2} <= depths:
        return "mode" if is_by_link else "list of links"
    if {0, 1} <= depths:
        return "link" if is_by_link else "move"
    return "plain"


def _annotation(field: str) -> Any:
    """Type of a field in the schema."""
    section, _, leaf = field.partition(".")
    model: Any = Study.model_fields[section].annotation
    return model.model_fields[leaf].annotation


def study_numbers(study: Study, structure: Structure, columns: Columns | None = None) -> Numbers:
    """The numbers of many studies that differ in some fields, NumPy arrays.

    Args:
        study: values of all fields that no column names.
        structure: sizes; those of the largest case.
        columns: values of the others, one per case (see `studies.study.fields`).

    Returns:
        By field, with a leading axis: the cases, or of length 1 where they do not differ. A
        controller from a file is `state_space`, in real modal form.
    """
    fields = Fields(study, columns)
    numbers: Numbers = {
        name: _array(fields, name, structure)
        for name in all_fields()
        if name != DELAY and not own_place(name) and not name.startswith("state_space.")
    }
    chosen = Parts(structure.law, structure.drive, structure.mechanism)
    for (place, table), name in zip(OWN_FIELDS.items(), chosen, strict=True):
        numbers |= {own: fields.each_link(own) for own in own_fields(place, [table[name]])}
    # "auto" is that of the study without columns
    is_given = DELAY in fields.columns
    numbers[DELAY] = fields.numbers(DELAY) if is_given else np.array([residual_delay(study)])
    if structure.law == STATE_SPACE.name:
        system = system_of(study.state_space, structure.n_links, structure.n_patches)
        numbers["state_space"] = jax.tree.map(lambda x: np.asarray(x)[None], system)
    return numbers


def build_cases(study: Study, columns: Columns, structure: Structure) -> Case:
    """Traced part of many studies that differ in some fields.

    Args:
        study: values of all fields that no column names.
        columns: values of the others, one per case (see `studies.study.fields`).
        structure: sizes; those of the largest case.

    Returns:
        Case whose leaves have a leading axis: the cases, or of length 1 where they do not differ.
    """
    return case_of(structure, study_numbers(study, structure, columns))


def one_study(study: Study, structure: Structure) -> Numbers:
    """The numbers of a study, without an axis of cases."""
    numbers: Numbers = jax.tree.map(lambda x: x[0], study_numbers(study, structure))
    return numbers


def stack_numbers(parts: Sequence[Numbers]) -> Numbers:
    """Numbers of several studies as those of as many cases; shorter lists are padded."""

    def stacked(*leaves: np.ndarray) -> np.ndarray:
        shape = np.max([x.shape for x in leaves], axis=0).astype(int)
        return np.stack([_padded(np.asarray(x), shape) for x in leaves])

    numbers: Numbers = jax.tree.map(stacked, *parts)
    return numbers


def _padded(array: np.ndarray, shape: np.ndarray) -> np.ndarray:
    if array.shape == tuple(shape):
        return array
    widths = [(0, most - n) for n, most in zip(array.shape, shape, strict=True)]
    return np.pad(array, widths, constant_values=np.nan)


def _array(fields: Fields, field: str, structure: Structure) -> np.ndarray:
    form = form_of(field)
    if form == "choice":
        return fields.choices(field, field_choices(field))
    if form == "integer":
        return fields.raw(field).astype(int)
    if form == "mode":
        return _by_mode(fields, field, (structure.n_links, structure.n_controlled))
    if form == "link":
        return fields.each_link(field)
    array = fields.numbers(field)
    if form == "plain":  # lists of lists keep their axes where there is none
        missing = max(map(depth, alternatives(_annotation(field)))) + 1 - array.ndim
        return array.reshape(*array.shape, *[0] * missing)
    if array.ndim == 1:
        array = np.repeat(array[:, None], structure.n_patches if field in EACH_PATCH else 1, axis=1)
    is_for_all = form == "list of links" and array.ndim == 2
    return np.repeat(array[:, None], structure.n_links, axis=1) if is_for_all else array


def _by_mode(fields: Fields, field: str, shape: tuple[int, int]) -> np.ndarray:
    array = fields.spread(field, shape, missing=np.nan)
    if field != OF_MODE_1:
        return array
    is_by_mode = np.array([nesting(value) > 0 for value in fields.raw(field)])
    return np.where(is_by_mode[:, None, None] | (np.arange(shape[1]) == 0), array, np.nan)


def position(study: Study, name: str) -> tuple[str, tuple[int | EllipsisType, ...]]:
    """Where a number of a study is among its numbers.

    Args:
        study: which says whether a list is one for all links.
        name: a field, or an entry of it.

    Returns:
        field, and index into its array without an axis of cases; all that the number stands for.
    """
    entry = parse_entry(name)
    assert entry is not None
    field, indices = entry
    if len(indices) < 2:
        if form_of(field) == "list of links":
            return field, (..., *indices)
        if field == OF_MODE_1:
            return field, (*(indices or (...,)), 0)
    return field, (*indices, ...)


def put(numbers: Numbers, at: tuple[str, Any], value: Any, keeps_missing: bool = False) -> Numbers:
    """The numbers with one replaced, in JAX.

    Args:
        numbers: of one case.
        at: from `position`.
        value: in the field's unit, ().
        keeps_missing: nan leaves what is there.
    """
    field, index = at
    whole = jnp.asarray(numbers[field], jnp.result_type(float))
    if keeps_missing:
        # nan would spoil the derivatives of the selected alternative
        value = jnp.where(jnp.isnan(value), whole[index], jnp.where(jnp.isnan(value), 1.0, value))
    return numbers | {field: whole.at[index].set(value)}
