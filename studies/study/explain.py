"""What a field of a study allows, in words, for error messages and template comments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from studies.errors import StudyError, field_error, nearest, nearest_field, shown, shown_name
from studies.study.choices import OneOf
from studies.study.sizes import OneEach, depth

_SIGNS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
_WORDS = {bool: "true or false", str: "text", float: "a finite number", int: "a whole number"}
_PLURALS = {
    bool: "values true or false",
    int: "whole numbers",
    float: "finite numbers",
    str: "texts",
    dict: "tables",
}

#: Sections beyond those of a study; commands of the same name read them.
COMMANDS = ("sweep", "tune", "fit")
#: Fields that take over what others had.
SUCCESSORS = {"sweep.screen": "sweep.keep"}


def unit_of(info: FieldInfo) -> str:
    """Unit of a field, "" if it has none."""
    extra = info.json_schema_extra
    unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
    return "" if unit == "-" else unit


def choices_of(annotation: Any, metadata: Iterable[Any] = ()) -> tuple[Any, ...]:
    """Values of a choice field; () for others."""
    tables = [item.names for item in metadata if isinstance(item, OneOf)]
    literal = get_args(annotation) if get_origin(annotation) is Literal else ()
    return tables[0] if tables else literal


def allowed_values(
    annotation: Any, metadata: Iterable[Any] = (), sizes: Mapping[str, int] | None = None
) -> str:
    """What a type with its limits allows: "a number > 0 and <= 100", "'a' or 'b'", "3 numbers".

    annotation: the type of a field or of an entry. metadata: its limits, as pydantic keeps them.
    sizes: lengths of lists with one entry for each of something, if they are known.
    """
    names = choices_of(annotation, metadata)
    if names:
        notes = [f", or {item.note}" for item in metadata if isinstance(item, OneOf) and item.note]
        choices = " or ".join(filter(None, (", ".join(map(repr, names[:-1])), repr(names[-1]))))
        return "".join([choices, *notes])
    for item in metadata:
        if hasattr(item, "allowed"):  # describes itself
            return str(item.allowed)
    origin, arguments = get_origin(annotation), get_args(annotation)
    if hasattr(annotation, "__metadata__"):
        return allowed_values(arguments[0], _limits(annotation), sizes)
    if origin in (Union, UnionType):
        arguments = tuple(x for x in arguments if x is not type(None))  # left out
        if len(arguments) == 1:
            return allowed_values(arguments[0], metadata, sizes)
        mark = _mark(_limits(arguments[-1]))
        is_number = depth(arguments[0]) == 0
        if mark and is_number and get_args(arguments[-1])[0] == tuple[arguments[0], ...]:  # type: ignore[valid-type]
            number = arguments[0]
            inner = get_args(number)[0] if hasattr(number, "__metadata__") else number
            limits = _range(_limits(number))
            each = f", each {limits}" if limits else ""
            return f"{_WORDS[inner]}, or a list of {_count(mark, sizes)}{each}"
        return ", or ".join(allowed_values(each, metadata, sizes) for each in arguments)
    if origin is dict:
        return f"a table{' of one entry or more' if _bound(metadata, 'min_length') else ''}"
    if origin is tuple:
        return _entries(arguments, metadata, sizes)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"a section with fields {', '.join(annotation.model_fields)}"
    return " ".join(filter(None, (_WORDS[annotation], _range(metadata))))


def _mark(metadata: Iterable[Any]) -> OneEach | None:
    return next((item for item in metadata if isinstance(item, OneEach)), None)


def _count(mark: OneEach, sizes: Mapping[str, int] | None) -> str:
    """How many entries, in words: "3", or "one per link"."""
    return str(sizes[mark.of]) if sizes else f"one per {mark.of}"


def _entries(
    arguments: tuple[Any, ...], metadata: Iterable[Any], sizes: Mapping[str, int] | None
) -> str:
    """A list: how many entries, and of what."""
    if not arguments:
        return "an empty list"
    entry = arguments[0]
    inner = get_args(entry)[0] if hasattr(entry, "__metadata__") else entry
    inner = dict if get_origin(inner) is dict else inner
    least, most = _bound(metadata, "min_length"), _bound(metadata, "max_length")
    mark = _mark(metadata)
    if mark:
        count = f"{_count(mark, sizes)} " if sizes else f"{_count(mark, sizes)}, "
    elif arguments[-1] is not Ellipsis:
        count = f"{len(arguments)} "
    elif most is not None:
        count = f"{least or 0} to {most} "
    else:
        count = f"{least} or more " if least else "a list of "
    if get_origin(inner) is tuple:
        own = _entries(get_args(inner), _limits(entry), sizes).removeprefix("a list of ")
        return f"{count}lists, each of {own}"
    if get_origin(inner) is Literal:
        return count + allowed_values(inner, (), sizes)
    limits = _range(_limits(entry))
    return f"{count}{_PLURALS[inner]}" + (f", each {limits}" if limits else "")


def _limits(annotation: Any) -> list[Any]:
    """Limits of an `Annotated` type; pydantic keeps them in a FieldInfo there."""
    limits: list[Any] = []
    for item in getattr(annotation, "__metadata__", ()):
        limits += item.metadata if isinstance(item, FieldInfo) else [item]
    return limits


def _bound(metadata: Iterable[Any], name: str) -> Any:
    values = (getattr(item, name, None) for item in metadata)
    return next((value for value in values if value is not None), None)


def _range(metadata: Iterable[Any]) -> str:
    limits = [
        f"{sign} {value:g}"
        for name, sign in _SIGNS
        if (value := _bound(metadata, name)) is not None
    ]
    longest = _bound(metadata, "max_length")
    if longest is not None:
        limits.append(f"of at most {longest} characters")
    if _bound(metadata, "pattern") is not None:  # the only one there is
        limits.append("without NUL characters")
    return " and ".join(limits)


def explain(
    error: ValidationError,
    study: type[BaseModel],
    data: dict[str, Any],
    inside: str = "",
    sizes: Mapping[str, int] | None = None,
) -> StudyError:
    """The first fault that pydantic found, in the words of the study file.

    error: what validation raised. study: the outermost model. data: what was validated.
    inside: name of the section that the model describes, "" for a whole study.
    sizes: see `allowed_values`.
    """
    fault = error.errors(include_url=False)[0]
    location = list(fault["loc"])
    model, used, info = study, 0, None
    for used, part in enumerate(location, 1):
        info = model.model_fields.get(str(part))
        if info is None:
            return _unknown(study, model, location[:used], fault["input"], inside)
        inner = info.annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            break
        model = inner
    if info is None:
        return field_error(inside or "study", fault["input"], allowed_values(study, (), sizes))
    is_missing = fault["type"] == "missing"
    return _bad_value(info, location[:used], location[used:], is_missing, data, inside, sizes)


def _unknown(
    study: type[BaseModel], model: type[BaseModel], location: list[Any], value: Any, inside: str
) -> StudyError:
    name = str(location[-1])
    prefix = "".join(f"{part}." for part in [inside, *location[:-1]] if part != "")
    field = prefix + name
    own = nearest(name, model.model_fields)
    close = prefix + own if own else nearest_field(field, _fields(study, inside))
    close = SUCCESSORS.get(field, close)
    hint = f"did you mean {close!r}?" if close else ""
    where = f"in [{prefix.rstrip('.')}]" if prefix else "at the top"
    if not prefix and name in COMMANDS:
        hint = f"`studies {name}` reads that; a study alone has none"
    hint = hint or f"allowed: {where}: {', '.join(model.model_fields)}"
    return StudyError(f"{shown_name(field)} = {shown(value)}: unknown field; {hint}")


def _fields(study: type[BaseModel], inside: str) -> list[str]:
    """Names of all fields of its sections, as in a file."""
    return [
        f"{inside}.{section}.{leaf}".lstrip(".")
        for section, info in study.model_fields.items()
        for leaf in getattr(info.annotation, "model_fields", ())
    ]


def _bad_value(
    info: FieldInfo,
    name: list[Any],
    entries: list[Any],
    is_missing: bool,
    data: dict[str, Any],
    inside: str,
    sizes: Mapping[str, int] | None,
) -> StudyError:
    annotation, metadata = info.annotation, list(info.metadata)
    if is_missing and not entries:
        unit = unit_of(info)
        allowed = allowed_values(annotation, metadata, sizes)
        text = f"{_dotted(inside, name)}: missing; allowed: {allowed}"
        return StudyError(f"{text} [{unit}]" if unit else text)
    value: Any = data
    for part in name:
        value = value[part]
    # an entry of a list is named by its index if its type is clear
    for part in entries[:-1] if is_missing else entries:
        if get_origin(annotation) is dict and isinstance(part, str):
            annotation, metadata, value = get_args(annotation)[1], [], value[part]
            name = [*name, part]
            continue
        if get_origin(annotation) is not tuple or not isinstance(part, int):
            break
        arguments = get_args(annotation)
        annotation = arguments[0] if arguments[-1] is Ellipsis else arguments[part]
        metadata, value = [], value[part]
        if hasattr(annotation, "__metadata__"):
            annotation, metadata = get_args(annotation)[0], _limits(annotation)
        name = [*name, part]
    choices = choices_of(annotation, metadata)
    hint = nearest(value, choices) if isinstance(value, str) else ""
    allowed = allowed_values(annotation, metadata, sizes)
    return field_error(_dotted(inside, name), value, allowed, unit_of(info), hint)


def _dotted(inside: str, name: list[Any]) -> str:
    return ".".join(str(part) for part in [inside, *name] if part != "")
