"""Free parameters: their names, bounds and scale, and how they get into a `Case`.

A free field is a number of the study file, an entry of a list, or a list, each of whose entries is
then free by itself. `DESIGN` are the fields that a designer decides, `MACHINE` those that he finds
in his machine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case
from jaxmodel.laws import LAWS
from jaxmodel.parameters import Array
from studies.errors import StudyError, field_error, nearest
from studies.space.axes import ALIASES, READY_MADE, Range, parse_range
from studies.study.paths import checked_value, is_each_link, known_field, overlaps, parse_entry
from studies.study.spec import OWN_FIELDS, Study

TWO_PI = 2 * np.pi


class FieldPlace(NamedTuple):
    """Where a field of the study is in a Case."""

    path: str
    factor: float = 1.0  # the Case's unit in the study's
    is_of_mode_1: bool = False  # one number, or one a link, is that of mode 1, not of all


def _same(section: str, inside: str, *names: str) -> dict[str, FieldPlace]:
    return {f"{section}.{name}": FieldPlace(f"{inside}.{name}") for name in names}


#: Fields that a designer decides.
DESIGN: dict[str, FieldPlace] = {
    **_same(
        "control", "control", "velocity_gain", "position_gain", "gain_factor", "feedthrough_factor"
    ),
    "control.ratios": FieldPlace("control.ratio"),
    "control.damping": FieldPlace("control.damping", is_of_mode_1=True),
    "control.pole_decay": FieldPlace("control.pole_decay"),
    "control.pole_frequency_hz": FieldPlace("control.pole_frequency", TWO_PI),
    "electronics.highpass_hz": FieldPlace("electronics.highpass", TWO_PI),
    "electronics.antialias_hz": FieldPlace("electronics.antialias", TWO_PI),
    "electronics.difference_cutoff_hz": FieldPlace("electronics.difference_cutoff", TWO_PI),
    **_same("electronics", "electronics", "lowpass_ratio", "lowpass_zeta"),
    "shaper.frequencies_hz": FieldPlace("shaping.omega", TWO_PI),
    "shaper.damping_ratio": FieldPlace("shaping.zeta"),
    "shaper.tolerance": FieldPlace("shaping.tolerance"),
    "patches.centers": FieldPlace("machine.patches.center"),
    **_same("patches", "machine.patches", "sensor_length", "actuator_length", "width", "thickness"),
    **_same("drive", "drive", "kp", "kd"),
    **_same("link", "machine.beam", "length", "thickness", "width"),
    **_same("machine", "machine.masses", "platform_mass", "platform_inertia", "slider_mass"),
    "load.mass": FieldPlace("machine.masses.payload_mass"),
    "load.inertia": FieldPlace("machine.masses.payload_inertia"),
}
#: Fields that are found by measuring, besides.
MACHINE: dict[str, FieldPlace] = {
    **_same("machine", "machine.geometry", "guide_side", "joint_radius"),
    **_same(
        "link",
        "machine.beam",
        "density",
        "youngs_modulus",
        "stiffness_factor",
        "joint_inertia_b",
        "joint_inertia_c",
    ),
    "link.damping_ratio": FieldPlace("machine.damping.ratio"),
    **_same(
        "patches",
        "machine.patches",
        "youngs_modulus",
        "d31",
        "relative_permittivity",
        "density",
    ),
    **_same("drive", "drive", "coulomb_friction", "viscous_friction", "pulse_force", "ripple"),
    "electronics.conditioner_gain": FieldPlace("electronics.conditioner_gain"),
    "electronics.sensor_highpass_hz": FieldPlace("electronics.sensor_highpass", TWO_PI),
}


class Free(NamedTuple):
    """One free parameter."""

    name: str  # with its index in a list
    span: Range
    start: float  # the study's value, nan if it has no such number
    key: str  # its name in the file


@dataclass(frozen=True)
class Placing:
    """A function with its first arguments given; equal ones share their compiled programs."""

    function: Callable[..., Case]
    given: tuple[Any, ...]  # hashable

    def __call__(self, case: Case, values: Array) -> Case:
        """The case with the values put into it."""
        return self.function(*self.given, case, values)


class Setter(NamedTuple):
    """Writes one number into a Case; hashable."""

    path: str
    indices: tuple[Any, ...]  # those of links end with an ellipsis: all below
    factor: float


class FreeNumbers(NamedTuple):
    """All free parameters of a design, in the order of the parameter vector."""

    numbers: tuple[Free, ...]
    #: Puts values (p,) in the study's units into a case; nan leaves the case's value.
    place: Callable[[Case, Array], Case]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in order."""
        return tuple(number.name for number in self.numbers)

    def values(self, u: np.ndarray) -> np.ndarray:
        """Numbers in the study's units, (..., p), from their places between the bounds, 0 to 1."""
        columns = [free.span.at(u[..., k]) for k, free in enumerate(self.numbers)]
        return np.stack(columns, axis=-1)

    def slopes(self, u: np.ndarray) -> np.ndarray:
        """Derivatives of the values by their places, (..., p)."""
        found = []
        for k, free in enumerate(self.numbers):
            low, high = free.span.low, free.span.high
            width = free.span.at(u[..., k]) * np.log(high / low) if free.span.is_log else high - low
            found.append(np.broadcast_to(width, u.shape[:-1]))
        return np.stack(found, axis=-1)

    def places(self) -> np.ndarray:
        """Where the baseline lies between the bounds, 0 to 1; 1/2 if undefined."""
        found = []
        for _, span, start, _ in self.numbers:
            if span.is_log:
                at = np.log(start / span.low) / np.log(span.high / span.low)
            else:
                at = (start - span.low) / (span.high - span.low)
            found.append(0.5 if np.isnan(at) else float(np.clip(at, 0.0, 1.0)))
        return np.array(found)


def join_numbers(
    parts: Sequence[tuple[list[Free], Callable[[Case, Array], Case]]],
) -> FreeNumbers:
    """All free parameters, from those of each field."""
    numbers: list[Free] = []
    places: list[Callable[[Case, Array], Case]] = []
    for added, put in parts:
        places.append(Placing(_part, (put, len(numbers), len(numbers) + len(added))))
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


def _place_all(places: tuple[Any, ...], case: Case, values: Array) -> Case:
    for place in places:
        case = place(case, values)
    return case


def _part(put: Callable[..., Any], first: int, after: int, case: Case, values: Array) -> Case:
    return put(case, values[first:after])


def plain_numbers(
    name: str,
    bounds: Any,
    study: Study,
    path: str,
    leaves: Mapping[str, FieldPlace],
    others: Sequence[str] = (),
) -> tuple[list[Free], Callable[[Case, Array], Case]]:
    """The numbers of one free field, and what puts their values into a case.

    Args:
        name: field, entry of a list, or list.
        bounds: its range as the file writes it.
        study: where it starts from.
        path: where it is written, for messages.
        leaves: fields that can be free, without the law's own.
        others: further names that can be, for messages.

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
    leaves = {**leaves, **_own_leaves(study)}
    leaf = leaves.get(entry.field)
    if leaf is None:
        hint = nearest(entry.field, leaves)
        raise StudyError(
            f"{path}: cannot be free; fields that can are {', '.join((*leaves, *others))}"
            + (f"; did you mean {hint!r}?" if hint else "")
        )
    _check_field(entry.field, study, path)
    span = parse_bounds(bounds, path)
    numbers, setters = [], []
    for indices, start in _entries(value):
        whole = (*entry.indices, *indices)
        label = entry.field + "".join(f"[{k}]" for k in whole)
        for key, end in (("from", span.low), ("to", span.high)):
            if entry.field != "patches.centers":  # all of them together may still fit the link
                checked_value(study, label, end, f"{path}.{key}")
        if not span.low <= start <= span.high:
            raise field_error(label, start, f"{span.low:g} to {span.high:g}, the bounds of {path}")
        numbers.append(Free(label, span, float(start), name))
        at = (*whole, Ellipsis) if whole and is_each_link(entry.field) else whole
        if leaf.is_of_mode_1 and len(whole) < 2:
            at = (*(whole or (Ellipsis,)), 0)
        setters.append(Setter(leaf.path, at, leaf.factor))
    if not numbers:
        raise field_error(name, value, f"one number or more, where {path} is to be free")
    return numbers, Placing(_set, (tuple(setters),))


def _own_leaves(study: Study) -> dict[str, FieldPlace]:
    """The own fields of the study's law."""
    law = LAWS[study.control.law]
    return {
        f"{OWN_FIELDS}.{law.name}.{x.name}": FieldPlace(f"control.parameters.{x.name}")
        for x in law.parameters
    }


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


def parse_bounds(bounds: Any, path: str) -> Range:
    """Bounds of a free parameter.

    Raises:
        StudyError: not a range, or one with points.
    """
    allowed = "a range {from = ..., to = ..., scale = 'linear' or 'log'}"
    if not isinstance(bounds, dict) or "count" in bounds:
        raise field_error(path, bounds, allowed)
    return parse_range(bounds, path)


def _entries(value: Any, indices: tuple[int, ...] = ()) -> list[tuple[tuple[int, ...], float]]:
    """Numbers of a nested list with their indices."""
    if not isinstance(value, tuple):
        return [(indices, value)]
    return [found for k, x in enumerate(value) for found in _entries(x, (*indices, k))]


def _set(setters: tuple[Setter, ...], case: Case, values: Array) -> Case:
    for k, setter in enumerate(setters):
        case = _replaced(case, setter.path.split("."), setter.indices, values[k] * setter.factor)
    return case


def _replaced(tree: Any, path: list[str], indices: tuple[Any, ...], value: Array) -> Any:
    """A tree of named tuples and dictionaries with one number replaced.

    Fewer indices than axes select everything below.
    """
    if not path:
        whole = jnp.asarray(tree, value.dtype)
        at = _widened(indices, whole.ndim)
        return whole.at[at].set(jnp.where(jnp.isnan(value), whole[at], known(value)))
    first, *rest = path
    if isinstance(tree, dict):
        return tree | {first: _replaced(tree[first], rest, indices, value)}
    return tree._replace(**{first: _replaced(getattr(tree, first), rest, indices, value)})


def _widened(indices: tuple[Any, ...], depth: int) -> Any:
    """One list of patch centres, or of one number, stands for those of all links."""
    if Ellipsis in indices:
        return indices
    return (Ellipsis, *indices) if indices and depth > len(indices) else (indices or Ellipsis)


def known(value: Array) -> Array:
    """Replace nan, whose derivatives would spoil those of the selected alternative."""
    return jnp.where(jnp.isnan(value), 1.0, value)
