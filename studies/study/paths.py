"""Fields of a study by name: the only syntax, getter and setter.

A name is a field and, for a list, the indices of an entry: `link.length`, `control.ratios[0][1]`.
The own fields of control laws and drives are `control.laws.LAW.FIELD` and `drive.kinds.KIND.FIELD`;
one that a study does not set has its default.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from jaxmodel.drives.contract import DriveLaw
from jaxmodel.laws.contract import Law
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.prrr import PRRR
from jaxmodel.table import Parameter
from studies.errors import StudyError, field_error, nearest_field, shown
from studies.study.consistency import (
    EACH_PATCH,
    check_consistency,
    check_mechanism,
    check_own_fields,
    patch_centers,
)
from studies.study.explain import choices_of, explain, unit_of
from studies.study.section import Section
from studies.study.sizes import alternatives, depth, has_one_a_link
from studies.study.spec import (
    OWN_FIELDS,
    Study,
    explained,
    validate,
)

T = TypeVar("T", bound=Section)
#: An index that names its axis and counts from 1, as in the files: `residual_rms[link=1]`.
NAMED_INDEX = re.compile(r"\[(\w+)=(\d{1,6})\]")
_ENTRY = re.compile(r"(?P<field>[^\s\[\]]+)(?P<indices>(\[(0|[1-9]\d{0,5})\])*)")
#: Faults in these fields become a status of the case, so that they do not stop a sweep.
JUDGED_BY_STATUS = (
    "patches.",
    "motion.",
    "machine.",
    "link.length",
    "link.modes",
    "control.modes",
    "electronics.",
    "shaper.frequencies_hz",
    "run.duration",
    "metrics.",
)


class Parts(NamedTuple):
    """The exchangeable parts of a study, in the order of `OWN_FIELDS`; each has its own program."""

    law: str  # of LAWS
    drive: str  # of DRIVES
    mechanism: str = PRRR.name  # of MECHANISMS

    def owns(self, field: str) -> bool:
        """Whether a field is none of a law, drive or mechanism that is not among these."""
        place = own_place(field)
        return not place or field.startswith(
            f"{place}.{dict(zip(OWN_FIELDS, self, strict=True))[place]}."
        )


def parts_of(study: Study, changed: Mapping[str, Any] | None = None) -> Parts:
    """Law, drive and mechanism of a study, with other values of some fields."""
    changed = changed or {}
    return Parts(
        law=changed.get("control.law", study.control.law),
        drive=changed.get("drive.kind", study.drive.kind),
        mechanism=changed.get("machine.kind", study.machine.kind),
    )


class Entry(NamedTuple):
    """A field, or an entry of a list: `control.ratios[0][1]` is ("control.ratios", (0, 1))."""

    field: str
    indices: tuple[int, ...]


def parse_entry(name: str) -> Entry | None:
    """Split a name into field and indices; None if it is not a valid name."""
    match = _ENTRY.fullmatch(name)
    if match is None:
        return None
    return Entry(match["field"], tuple(map(int, re.findall(r"\d+", match["indices"]))))


def all_fields() -> list[str]:
    """Every field that a study can have."""
    names = []
    for section, info in Study.model_fields.items():
        inner = info.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            names += [f"{section}.{leaf}" for leaf in inner.model_fields]
    for place, table in OWN_FIELDS.items():
        names.remove(place)
        names += own_fields(place, table.values())
    return names


def own_fields(place: str, entries: Iterable[Law | DriveLaw | Mechanism]) -> list[str]:
    """Own fields of laws, drives or mechanisms.

    Args:
        place: in `OWN_FIELDS`.
        entries: of its table.
    """
    return [f"{place}.{entry.name}.{x.name}" for entry in entries for x in entry.parameters]


def own_place(field: str) -> str:
    """Place in `OWN_FIELDS` of an own field of a law and its like, "" for other fields."""
    return next((place for place in OWN_FIELDS if field.startswith(f"{place}.")), "")


def own_parameter(field: str) -> Parameter | None:
    """The parameter of a law and its like behind a field, if there is one."""
    place = own_place(field)
    if not place:
        return None
    name, _, leaf = field.removeprefix(f"{place}.").partition(".")
    table = OWN_FIELDS[place]
    parameters = table[name].parameters if name in table else ()
    return next((parameter for parameter in parameters if parameter.name == leaf), None)


def is_each_link(field: str) -> bool:
    """Whether a field takes one number for all links, or one each."""
    return field in EACH_LINK or bool(own_place(field))


def field_value(study: Study, field: str) -> Any:
    """Value of a field of a study."""
    parameter = own_parameter(field)
    if parameter is not None:
        place = own_place(field)
        name, _, leaf = field.removeprefix(f"{place}.").partition(".")
        return attrgetter(place)(study).get(name, {}).get(leaf, parameter.default)
    return attrgetter(field)(study)


def field_unit(field: str) -> str:
    """Unit of a field of a study, "1" for none."""
    parameter, (section, _, leaf) = own_parameter(field), field.partition(".")
    if parameter is not None:
        return parameter.unit
    if not leaf:
        return "1"
    model: Any = Study.model_fields[section].annotation
    return unit_of(model.model_fields[leaf]) or "1"


def field_choices(field: str) -> tuple[str, ...]:
    """Values of a choice field; () for others."""
    section, _, leaf = field.partition(".")
    fields = getattr(Study.model_fields[section].annotation, "model_fields", {})
    return choices_of(fields[leaf].annotation, fields[leaf].metadata) if leaf in fields else ()


def free_fields(parts: Iterable[Parts], *roles: str) -> tuple[str, ...]:
    """Fields that can be free, and those of some laws and drives.

    roles: `DESIGN`, `MACHINE`.
    """
    names = [
        f"{section}.{leaf}"
        for section, outer in Study.model_fields.items()
        for leaf, info in getattr(outer.annotation, "model_fields", {}).items()
        if isinstance(info.json_schema_extra, dict) and info.json_schema_extra.get("free") in roles
    ]
    for (place, table), chosen in zip(OWN_FIELDS.items(), zip(*parts, strict=True), strict=True):
        names += own_fields(place, [table[name] for name in dict.fromkeys(chosen)])
    return tuple(names)


def as_list(field: str, value: Any, study: Study) -> Any:
    """A field's value as a list of entries: one a link, or patch of a link, if one is for all."""
    if field in EACH_PATCH and not isinstance(value, tuple):
        value = (value,) * patch_centers(study).shape[1]
    elif isinstance(value, tuple) or not is_each_link(field):
        return value
    return (value,) * study.n_links


def known_field(name: str, study: Study, path: str = "", others: Iterable[str] = ()) -> Any:
    """Value of a field or an entry of it in a study.

    Args:
        name: of the field or entry.
        study: where to look.
        path: where the name is written, for messages.
        others: further valid names.

    Raises:
        StudyError: no such field or entry, with the nearest name.
    """
    entry = parse_entry(name)
    names = all_fields()
    where = f"{path}: " if path else ""
    if entry is None or entry.field not in names:
        field = entry.field if entry else name
        close = nearest_field(field, [*names, *others])
        hint = f"did you mean {close!r}?" if close else "see studies init --all for all fields"
        raise StudyError(f"{where}{shown(name)}: unknown field; {hint}")
    value = field_value(study, entry.field)
    value = as_list(entry.field, value, study) if entry.indices else value
    for index in entry.indices:
        if not isinstance(value, tuple) or index >= len(value):
            size = f"0 to {len(value) - 1}" if isinstance(value, tuple) and value else "none"
            raise StudyError(
                f"{where}{name!r}: no such entry; {entry.field} = "
                f"{field_value(study, entry.field)}, allowed index here {size}"
            )
        value = value[index]
    return value


def set_value(study: Study, name: str, value: Any) -> dict[str, Any]:
    """The study as a dictionary, with a field or an entry of it replaced."""
    return set_values(study, {name: value})


def set_values(study: Study, values: Mapping[str, Any]) -> dict[str, Any]:
    """The study as a dictionary, with fields or entries of fields replaced one by one."""
    data = study.model_dump()
    for name, value in values.items():
        entry = parse_entry(name)
        assert entry is not None
        *sections, leaf = entry.field.split(".")
        target = data
        for section in sections:
            target = target.setdefault(section, {})
        if entry.indices:
            whole = target[leaf] if leaf in target else field_value(study, entry.field)
            value = replaced(as_list(entry.field, whole, study), entry.indices, value)
        target[leaf] = value
    return study.with_kind(data)


def replaced(whole: Any, indices: tuple[int, ...], value: Any) -> Any:
    """A nested tuple with one entry replaced."""
    if not indices:
        return value
    first, *rest = indices
    return (*whole[:first], replaced(whole[first], tuple(rest), value), *whole[first + 1 :])


def checked_value(study: Study, name: str, value: Any, path: str) -> Any:
    """A value as the field stores it (numbers as floats in float fields).

    Raises:
        StudyError: not allowed there, alone or with the other fields of the study.
    """
    data = set_value(study, name, as_tuples(value))
    try:
        changed = validate(data)
        if name.startswith(JUDGED_BY_STATUS):
            check_own_fields(changed)
            check_mechanism(changed)
        else:
            check_consistency(changed)
    except ValidationError as error:
        raise StudyError(f"{path}: {explained(error, data)}") from None
    except StudyError as error:
        raise StudyError(f"{path}: {error}") from None
    if name == "machine.kind":
        _check_exchange(study, changed, path)
    return known_field(name, changed)


def _check_exchange(study: Study, changed: Study, path: str) -> None:
    """Refuse another mechanism in a batch whose other fields do not suit it."""
    kind = changed.machine.kind
    if (changed.n_links, changed.n_pose) != (study.n_links, study.n_pose):
        alike = [x.name for x in MECHANISMS.values() if x.n_links == study.n_links]
        raise field_error(path, kind, f"machines of as many links: {', '.join(alike)}")
    if changed.motion.waypoints != study.motion.waypoints:
        raise StudyError(
            f"{path}: {kind!r} has its home elsewhere; write motion.waypoints that suit all"
        )


def overlaps(name: str, other: str) -> bool:
    """Whether one field is the other or an entry of it."""
    return name == other or name.startswith(f"{other}[") or other.startswith(f"{name}[")


def parse_section(
    model: type[T], written: Any, path: str, sizes: Mapping[str, int] | None = None
) -> T:
    """A section that is written at a place.

    Args:
        model: of the section.
        written: what stands there.
        path: the place, for messages.
        sizes: lengths of lists with one entry for each of something, if they are known.

    Raises:
        StudyError: a field that it has not, or a value that is not allowed.
    """
    try:
        return model.model_validate(as_tuples(written), context=sizes)
    except ValidationError as error:
        raise explain(error, model, written, path, sizes) from None


def as_tuples(value: Any) -> Any:
    """Lists as tuples, at any depth."""
    if isinstance(value, dict):
        return {name: as_tuples(x) for name, x in value.items()}
    return tuple(map(as_tuples, value)) if isinstance(value, (list, tuple)) else value


def _each_link_fields() -> frozenset[str]:
    """Fields that take one number for all links, or one for each."""
    fields = set()
    for section, outer in Study.model_fields.items():
        for leaf, info in getattr(outer.annotation, "model_fields", {}).items():
            depths = map(depth, alternatives(info.annotation))
            if 0 in depths and has_one_a_link(info.annotation):
                fields.add(f"{section}.{leaf}")
    return frozenset(fields)


EACH_LINK = _each_link_fields()
