"""Free numbers of a design: their names, bounds and scale, and how they get into a `Case`.

A free field is a number of the study file, an entry of a list, or a list, each of whose entries is
then free by itself. Ready-made ones stand for several numbers:

- `poles.decay` [1/s] and `poles.frequency_hz` [Hz], three entries each: alpha-bar and beta-bar of
  mode 1 of each link, which become its gains by (22)-(23); they need `control.gain_unit = "1/s"`;
- `placement`: patch centres on the link and without overlap, for any numbers in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.control import pole_placement
from jaxmodel.laws import LAWS
from jaxmodel.parameters import Array
from studies.errors import StudyError, field_error, nearest, shown_name
from studies.space.axes import ALIASES, READY_MADE, Range, parse_range
from studies.study.cases import build_structure
from studies.study.consistency import each_link, patch_centers, patch_pitch
from studies.study.paths import checked_value, known_field, parse_entry
from studies.study.spec import OWN_FIELDS, Study

TWO_PI = 2 * np.pi


class FieldPlace(NamedTuple):
    """Where a field of the study is in a Case."""

    path: str
    factor: float = 1.0  # the Case's unit in the study's


def _same(section: str, inside: str, *names: str) -> dict[str, FieldPlace]:
    return {f"{section}.{name}": FieldPlace(f"{inside}.{name}") for name in names}


#: Fields that can be free.
LEAVES: dict[str, FieldPlace] = {
    **_same(
        "control", "control", "velocity_gain", "position_gain", "gain_factor", "feedthrough_factor"
    ),
    "control.ratios": FieldPlace("control.ratio"),
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
#: Free names that stand for several numbers of a Case.
POLES = ("poles.decay", "poles.frequency_hz")
PLACEMENT = "placement"
PLACEMENTS = ("same", "per_link")
#: Fields that a ready-made free number sets or relies on.
_GAINS = ("control.velocity_gain", "control.position_gain")
DECIDED = {PLACEMENT: ("patches.", "link.length"), POLES[0]: _GAINS, POLES[1]: _GAINS}


class Free(NamedTuple):
    """One free number."""

    name: str  # with its index in a list
    span: Range
    start: float  # the study's value, nan if it has no such number
    key: str  # its name in the file


class Setter(NamedTuple):
    """Writes one number into a Case; hashable."""

    path: str
    indices: tuple[int, ...]
    factor: float


class FreeNumbers(NamedTuple):
    """All free numbers of a design, in the order of the parameter vector."""

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
        """Where the study itself lies between the bounds, 0 to 1; 1/2 if undefined."""
        found = []
        for _, span, start, _ in self.numbers:
            if span.is_log:
                at = np.log(start / span.low) / np.log(span.high / span.low)
            else:
                at = (start - span.low) / (span.high - span.low)
            found.append(0.5 if np.isnan(at) else float(np.clip(at, 0.0, 1.0)))
        return np.array(found)


def writes(number: Free) -> tuple[str, ...]:
    """Fields of the study that a free number sets."""
    if number.key in POLES:
        return "control.velocity_gain", "control.position_gain"
    return ("patches.centers",) if number.key == PLACEMENT else (number.name,)


def free_numbers(written: dict[str, Any], study: Study) -> FreeNumbers:
    """Free numbers from what the file says.

    Args:
        written: ranges by name, from `[tune.free]`.
        study: the initial design.

    Raises:
        StudyError: nothing free, unknown name, bad bounds, a start outside them.
    """
    if not written:
        raise field_error("tune.free", {}, "one free field or more")
    numbers: list[Free] = []
    places: list[Callable[[Case, Array], Case]] = []
    for name, bounds in written.items():
        path = f"tune.free.{shown_name(name)}"
        first = len(numbers)
        if name == PLACEMENT:
            added, put = _placement(bounds, study, path)
        elif name in POLES:
            if name == POLES[1] and POLES[0] in written:
                continue  # comes with the other one
            added, put = _poles(written, study)
        else:
            added, put = _plain(name, bounds, study, path)
        numbers += added
        places.append(partial(_part, put, first, first + len(added)))
    _check_twice(numbers)
    return FreeNumbers(tuple(numbers), partial(_place_all, tuple(places)))


def _check_twice(numbers: list[Free]) -> None:
    """No field can be moved by two numbers, nor one that a ready-made number relies on."""
    names = [number.name for number in numbers]
    ready = [key for key in DECIDED if any(number.key == key for number in numbers)]
    for k, (name, _, _, own_key) in enumerate(numbers):
        if name in names[:k] or any(
            name.startswith(f"{other}[") or other.startswith(f"{name}[") for other in names[:k]
        ):
            raise StudyError(f"tune.free.{name}: free twice")
        for key in ready:
            if own_key not in DECIDED and own_key.startswith(DECIDED[key]):
                raise StudyError(f"tune.free.{own_key}: {key} is free too and decides it")


def _place_all(places: tuple[Any, ...], case: Case, values: Array) -> Case:
    for place in places:
        case = place(case, values)
    return case


def _part(put: Callable[..., Any], first: int, after: int, case: Case, values: Array) -> Case:
    return put(case, values[first:after])


# --- plain fields ---------------------------------------------------------------------------------


def _plain(
    name: str, bounds: Any, study: Study, path: str
) -> tuple[list[Free], Callable[..., Any]]:
    entry, ready = parse_entry(name), nearest(name, DECIDED)
    if ready and name.partition(".")[0] not in Study.model_fields:
        raise StudyError(f"{path}: cannot be free; did you mean {ready!r}?")
    if name in READY_MADE:
        hint = f"did you mean {ALIASES[name]!r}?" if name in ALIASES else "an axis of sweeps alone"
        raise StudyError(f"{path}: cannot be free; {hint}")
    value = known_field(name, study, path)  # names the nearest field if there is none
    assert entry is not None
    leaves = LEAVES | _own_leaves(study)
    leaf = leaves.get(entry.field)
    if leaf is None:
        hint = nearest(entry.field, leaves)
        raise StudyError(
            f"{path}: cannot be free; fields that can are {', '.join(leaves)}, {', '.join(POLES)} "
            f"and {PLACEMENT}" + (f"; did you mean {hint!r}?" if hint else "")
        )
    _check_field(entry.field, study, path)
    span = _span(bounds, path)
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
        setters.append(Setter(leaf.path, whole, leaf.factor))
    if not numbers:
        raise field_error(name, value, f"one number or more, where {path} is to be free")
    return numbers, partial(_set, tuple(setters))


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


def _span(bounds: Any, path: str) -> Range:
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


def _replaced(tree: Any, path: list[str], indices: tuple[int, ...], value: Array) -> Any:
    """A tree of named tuples and dictionaries with one number replaced.

    Fewer indices than axes select everything below.
    """
    if not path:
        whole = jnp.asarray(tree, value.dtype)
        at = _widened(indices, whole.ndim)
        return whole.at[at].set(jnp.where(jnp.isnan(value), whole[at], _safe(value)))
    first, *rest = path
    if isinstance(tree, dict):
        return tree | {first: _replaced(tree[first], rest, indices, value)}
    return tree._replace(**{first: _replaced(getattr(tree, first), rest, indices, value)})


def _widened(indices: tuple[int, ...], depth: int) -> Any:
    """One list of patch centres, or of one number, stands for those of all links."""
    return (Ellipsis, *indices) if indices and depth > len(indices) else (indices or Ellipsis)


def _safe(value: Array) -> Array:
    """Replace nan, whose derivatives would spoil those of the selected alternative."""
    return jnp.where(jnp.isnan(value), 1.0, value)


# --- ready-made ones ------------------------------------------------------------------------------


def _poles(written: dict[str, Any], study: Study) -> tuple[list[Free], Callable[..., Any]]:
    for one, other in (POLES, POLES[::-1]):
        if one in written and other not in written:
            raise StudyError(f"tune.free.{one}: needs {other} too, (22)-(23) use both")
    if study.control.gain_unit != "1/s":
        raise field_error(
            "control.gain_unit",
            study.control.gain_unit,
            "'1/s' where tune.free.poles.decay is free",
        )
    spans = [_span(written[name], f"tune.free.{name}") for name in POLES]
    if spans[1].low <= 0:
        raise field_error(f"tune.free.{POLES[1]}.from", spans[1].low, "more than 0", "Hz")
    numbers = [
        Free(f"{name}[{k}]", span, np.nan, name)
        for name, span in zip(POLES, spans, strict=True)
        for k in range(3)
    ]
    return numbers, partial(_place_poles, build_structure(study))


def _place_poles(structure: Structure, case: Case, values: Array) -> Case:
    omega = find_bases(structure, case).believed_omega[:, 0]
    is_kept, values = jnp.isnan(values[:3] + values[3:]), _safe(values)
    gains = pole_placement(values[:3], TWO_PI * values[3:], omega)
    control = case.control._replace(
        velocity_gain=jnp.where(is_kept, case.control.velocity_gain, gains.velocity),
        position_gain=jnp.where(is_kept, case.control.position_gain, gains.position),
    )
    return case._replace(control=control)


def _placement(bounds: Any, study: Study, path: str) -> tuple[list[Free], Callable[..., Any]]:
    if not isinstance(bounds, dict) or set(bounds) != {"kind"} or bounds["kind"] not in PLACEMENTS:
        raise field_error(path, bounds, "{kind = 'same'} or {kind = 'per_link'}")
    centers, pitch, length = patch_centers(study), patch_pitch(study), each_link(study.link.length)
    links, count = (1 if bounds["kind"] == "same" else 3), centers.shape[1]
    if links == 1:  # room on all links
        pitch, length = pitch.max(keepdims=True), length.min(keepdims=True)
    free = length - count * pitch
    if np.any(free <= 0):
        raise field_error(path, bounds, f"a link longer than its {count} patches")
    numbers = []
    for i in range(links):
        gaps = np.diff([0.0, *(np.sort(centers[i]) - pitch[i] * (np.arange(count) + 0.5))])
        starts = _shares(gaps / free[i])
        numbers += [
            Free(f"placement[{i}][{k}]", Range(0.0, 1.0, 0, False), float(starts[k]), PLACEMENT)
            for k in range(count)
        ]
    return numbers, partial(_place_patches, links, tuple(pitch))


def _shares(gaps: np.ndarray) -> np.ndarray:
    """Numbers for which `_place_patches` leaves these gaps, as shares of the free length."""
    left, found = 1.0, []
    for k, gap in enumerate(gaps):
        kept = np.clip(1 - gap / left, 0.0, 1.0) if left > 0 else 1.0
        found.append(1 - kept ** (len(gaps) - k))
        left -= gap
    return np.array(found)


def _place_patches(links: int, pitches: tuple[float, ...], case: Case, values: Array) -> Case:
    """Place patches one by one, each after a gap that is its share of the remaining free length.

    Of k gaps to come, a number v takes 1 - (1 - v)^(1/k): equal numbers are drawn evenly from all
    placements.
    """
    patches, pitch = case.machine.patches, jnp.asarray(pitches)
    count = values.shape[0] // links
    length = jnp.broadcast_to(case.machine.beam.length, (3,))
    left = (jnp.min(length) if links == 1 else length) - count * pitch
    begin, centers = jnp.zeros((links,), values.dtype), []
    is_kept, shares = jnp.isnan(jnp.sum(values)), jnp.reshape(_safe(values), (links, count))
    for k in range(count):
        # the root has no slope at 0, where no free length is left
        kept = jnp.maximum(1 - shares[:, k], 1e-12) ** (1 / (count - k))
        begin, left = begin + left * (1 - kept), left * kept
        centers.append(begin + pitch * (k + 0.5))
    center = jnp.broadcast_to(jnp.stack(centers, axis=-1), (3, count))
    center = jnp.where(is_kept, patches.center, center)
    machine = case.machine._replace(patches=patches._replace(center=center))
    return case._replace(machine=machine)
