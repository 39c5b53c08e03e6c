"""Free parameters: their names, bounds and scale, and how they get into a study's numbers.

A free field is a number of the study file, an entry of a list, or a list, each of whose entries is
then free by itself. The schema says which fields can be free.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.numbers import Numbers, case_of
from jaxmodel.parameters import Array
from studies.errors import StudyError, field_error, nearest, nearest_field
from studies.space.axes import ALIASES, READY_MADE, Range, WrittenRange, parse_range
from studies.study.numbers import position, put
from studies.study.paths import (
    Parts,
    checked_value,
    free_fields,
    known_field,
    overlaps,
    own_place,
    parse_entry,
    parts_of,
)
from studies.study.spec import Study

#: Puts values (p,) of free parameters, in the study's units, among the numbers of one case; nan
#: leaves the case's value. Pass the same object, or an equal one, to avoid recompiling.
Place = Callable[[Numbers, Array], Numbers]


class Free(NamedTuple):
    """One free parameter."""

    name: str  # with its index in a list
    span: Range
    start: float  # the study's value, nan if it has no such number
    key: str  # its name in the file


@dataclass(frozen=True)
class Placing:
    """A function with its first arguments given; equal ones share their compiled programs."""

    function: Callable[..., Any]  # of a module
    arguments: tuple[Any, ...]  # hashable

    def __call__(self, *others: Any) -> Any:
        return self.function(*self.arguments, *others)

    def __repr__(self) -> str:
        return f"{self.function.__module__}.{self.function.__qualname__}{self.arguments}"


class FreeNumbers(NamedTuple):
    """All free parameters of a design, in the order of the parameter vector."""

    numbers: tuple[Free, ...]
    place: Place

    def build(self, structure: Structure) -> Callable[[Numbers, Array], Case]:
        """What makes a case of numbers without the free ones, and these."""
        return Placing(_case, (structure, self.place))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in order."""
        return tuple(number.name for number in self.numbers)

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that the numbers are in."""
        return tuple(name.partition("[")[0] for name in self.names)

    def values(self, u: np.ndarray) -> np.ndarray:
        """Numbers in the study's units, (..., p), from their places between the bounds, 0 to 1."""
        columns = [free.span.at(u[..., k]) for k, free in enumerate(self.numbers)]
        return np.stack(columns, axis=-1)

    def slopes(self, u: np.ndarray) -> np.ndarray:
        """Derivatives of the values by their places, (..., p)."""
        slopes = []
        for k, free in enumerate(self.numbers):
            low, high = free.span.low, free.span.high
            width = free.span.at(u[..., k]) * np.log(high / low) if free.span.is_log else high - low
            slopes.append(np.broadcast_to(width, u.shape[:-1]))
        return np.stack(slopes, axis=-1)

    def places(self) -> np.ndarray:
        """Where the baseline lies between the bounds, 0 to 1; 1/2 if undefined."""
        places = []
        for _, span, start, _ in self.numbers:
            if span.is_log:
                at = np.log(start / span.low) / np.log(span.high / span.low)
            else:
                at = (start - span.low) / (span.high - span.low)
            places.append(0.5 if np.isnan(at) else float(np.clip(at, 0.0, 1.0)))
        return np.array(places)


def join_numbers(
    parts: Sequence[tuple[list[Free], Place]],
) -> FreeNumbers:
    """All free parameters, from those of each field."""
    numbers: list[Free] = []
    places: list[Place] = []
    for added, place in parts:
        places.append(Placing(_part, (place, len(numbers), len(numbers) + len(added))))
        numbers += added
    return FreeNumbers(tuple(numbers), Placing(_place_all, (tuple(places),)))


def check_twice(numbers: Sequence[Free], path: str) -> None:
    """No field can be moved by two numbers.

    Raises:
        StudyError: one is.
    """
    names = [number.name for number in numbers]
    for k, name in enumerate(names):
        if any(overlaps(name, other) for other in names[:k]):
            raise StudyError(f"{path}.{name}: free twice")


def _place_all(places: tuple[Place, ...], numbers: Numbers, values: Array) -> Numbers:
    for place in places:
        numbers = place(numbers, values)
    return numbers


def _part(place: Place, first: int, after: int, numbers: Numbers, values: Array) -> Numbers:
    return place(numbers, values[first:after])


def plain_numbers(
    name: str,
    written: object,
    study: Study,
    path: str,
    roles: Sequence[str],
    others: Sequence[str] = (),
    parts: Sequence[Parts] = (),
    form: type[WrittenRange] = WrittenRange,
) -> tuple[list[Free], Place]:
    """The numbers of one free field, and what puts their values among those of a study.

    Args:
        name: field, entry of a list, or list.
        written: its range as the file has it.
        study: where it starts from.
        path: where it is written, for messages.
        roles: of the fields that can be free, besides the parts' own.
        others: further names that can be, for messages.
        parts: laws and drives whose parameters can be free; (): those of the study.
        form: of the range.

    Raises:
        StudyError: unknown name, bad bounds, a start outside them.
    """
    entry, ready = parse_entry(name), nearest(name, others)
    if ready and name.partition(".")[0] not in Study.model_fields:
        raise StudyError(f"{path}: cannot be free; did you mean {ready!r}?")
    if name in READY_MADE:
        hint = f"did you mean {ALIASES[name]!r}?" if name in ALIASES else "an axis of sweeps alone"
        raise StudyError(f"{path}: cannot be free; {hint}")
    value = known_field(name, study, path)  # names the nearest field if there is none
    assert entry is not None
    allowed = free_fields(parts or (parts_of(study),), *roles)
    if entry.field not in allowed:
        hint = nearest_field(entry.field, allowed)
        raise StudyError(
            f"{path}: cannot be free; fields that can are {', '.join((*allowed, *others))}"
            + (f"; did you mean {hint!r}?" if hint else "")
        )
    _check_field(entry.field, study, path)
    span = parse_range(written, path, form)
    numbers, positions = [], []
    for indices, start in numbers_in(value):
        whole = (*entry.indices, *indices)
        label = entry.field + "".join(f"[{k}]" for k in whole)
        for key, end in (("from", span.low), ("to", span.high)):
            if entry.field != "patches.centers":  # all of them together may still fit the link
                checked_value(study, label, end, f"{path}.{key}")
        if not span.low <= start <= span.high:
            raise field_error(label, start, f"{span.low:g} to {span.high:g}, the bounds of {path}")
        numbers.append(Free(label, span, float(start), name))
        positions.append(position(study, label))
    if not numbers:
        raise field_error(name, value, f"one number or more, where {path} is to be free")
    return numbers, Placing(_set, (tuple(positions),))


def _check_field(field: str, study: Study, path: str) -> None:
    """Check what a free field requires of others."""
    if field == "control.ratios" and study.control.ratio_exponent != 1:
        raise field_error(
            "control.ratio_exponent", study.control.ratio_exponent, f"1 where {path} is free", "1"
        )
    if field == "control.ratios" and study.control.ratio_source != "given":
        raise field_error(
            "control.ratio_source", study.control.ratio_source, f"'given' where {path} is free"
        )


def numbers_in(value: Any, indices: tuple[int, ...] = ()) -> list[tuple[tuple[int, ...], float]]:
    """Numbers of a nested list with their indices."""
    if not isinstance(value, tuple):
        return [(indices, value)]
    return [entry for k, x in enumerate(value) for entry in numbers_in(x, (*indices, k))]


def _set(positions: tuple[Any, ...], numbers: Numbers, values: Array) -> Numbers:
    for k, at in enumerate(positions):
        if own_place(at[0]) and at[0] not in numbers:
            continue  # of a law or drive that this program does not have
        numbers = put(numbers, at, values[k], keeps_missing=True)
    return numbers


def _case(structure: Structure, place: Place, numbers: Numbers, values: Array) -> Case:
    return case_of(structure, place(numbers, values))
