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
    object: "values",
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
        return f"a section with fields {', '.join(written_fields(annotation))}"
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
    is_section = isinstance(inner, type) and issubclass(inner, BaseModel)
    inner = dict if is_section or get_origin(inner) is dict else inner
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
    model: type[BaseModel],
    data: Any,
    inside: str = "",
    sizes: Mapping[str, int] | None = None,
) -> StudyError:
    """The first fault that pydantic found, in the words of the study file.

    error: what validation raised. model: the outermost one. data: what was validated.
    inside: name of the section that the model describes, "" for a whole study.
    sizes: see `allowed_values`.
    """
    faults = error.errors(include_url=False)
    # what a field is missing for is a misspelt one
    fault = next((x for x in faults if x["type"] == "extra_forbidden"), faults[0])
    fault = fault if faults[0]["type"] == "missing" else faults[0]
    annotation: Any = model
    metadata, unit, value = list[Any](), "", data
    name: list[Any] = [inside] if inside else []
    is_missing = fault["type"] == "missing"
    # an entry of a list is named by its index if its type is clear
    for part in fault["loc"]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            info = written_fields(annotation).get(str(part))
            if info is None:
                return _unknown(model, annotation, name, str(part), fault["input"], inside)
            annotation, metadata, unit = info.annotation, list(info.metadata), unit_of(info)
        elif get_origin(annotation) is dict and isinstance(part, str):
            annotation, metadata = get_args(annotation)[1], []
        elif get_origin(annotation) is tuple and isinstance(part, int) and not is_missing:
            arguments = get_args(annotation)
            annotation = arguments[0] if arguments[-1] is Ellipsis else arguments[part]
            metadata = []
        else:
            break
        annotation, metadata = _plain(annotation, metadata)
        name = [*name, shown_name(str(part)) if isinstance(part, str) else part]
        is_there = not isinstance(value, dict) or part in value
        if is_missing and not is_there:
            allowed = allowed_values(annotation, metadata, sizes)
            text = f"{_dotted(name)}: missing; allowed: {allowed}"
            return StudyError(f"{text} [{unit}]" if unit else text)
        value = value[part] if is_there else fault["input"]  # of a key that is no text
    hint = nearest(value, _choices_within(annotation, metadata)) if isinstance(value, str) else ""
    allowed = allowed_values(annotation, metadata, sizes)
    return field_error(_dotted(name) or "study", value, allowed, unit, hint)


def written_fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Fields of a section by their names in files."""
    return {info.alias or name: info for name, info in model.model_fields.items()}


def _plain(annotation: Any, metadata: list[Any]) -> tuple[Any, list[Any]]:
    """A type without its limits and without None, and the limits."""
    if hasattr(annotation, "__metadata__"):
        return get_args(annotation)[0], _limits(annotation)
    others = [x for x in get_args(annotation) if x is not type(None)]
    if get_origin(annotation) in (Union, UnionType) and len(others) == 1:
        return _plain(others[0], metadata)
    return annotation, metadata


def _choices_within(annotation: Any, metadata: list[Any]) -> list[str]:
    """Texts that a type allows, also as one of several."""
    branches = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()
    own = [x for x in choices_of(annotation, metadata) if isinstance(x, str)]
    return own + [name for x in branches for name in _choices_within(x, [])]


def _unknown(
    outermost: type[BaseModel],
    model: type[BaseModel],
    name: list[Any],
    leaf: str,
    value: Any,
    inside: str,
) -> StudyError:
    section = _dotted(name)
    field = f"{section}.{leaf}".lstrip(".")
    own = nearest(leaf, [*written_fields(model), *(() if section else COMMANDS)])
    close = (
        f"{section}.{own}".lstrip(".") if own else nearest_field(field, _fields(outermost, inside))
    )
    close = SUCCESSORS.get(field, close)
    hint = f"did you mean {close!r}?" if close else ""
    where = f"in [{section}]" if section else "at the top"
    if not section and leaf in COMMANDS:
        hint = f"`studies {leaf}` reads that; a study alone has none"
    hint = hint or f"allowed: {where}: {', '.join(written_fields(model))}"
    return StudyError(f"{shown_name(field)} = {shown(value)}: unknown field; {hint}")


def _fields(study: type[BaseModel], inside: str) -> list[str]:
    """Names of all fields of its sections, as in a file."""
    return [
        f"{inside}.{section}.{leaf}".lstrip(".")
        for section, info in study.model_fields.items()
        for leaf in getattr(info.annotation, "model_fields", ())
    ]


def _dotted(name: list[Any]) -> str:
    return ".".join(map(str, name))
