"""Results whose fields say what they are: unit, text and axes, declared once.

From the declarations follow the variables of a file (`variables`), the JSON document (`document`)
and its schema (`studies.results.schema`).

    class Ringing(Labelled, command="ringing"):
        \"\"\"What rings, and how long.\"\"\"

        study: Study = told("the study")
        frequency: np.ndarray = labelled("Hz", "of each mode", "mode")

        @derived("1", "modes above 1 kHz")
        def n_high(self) -> int:
            return int((self.frequency > 1e3).sum())
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar, cast, dataclass_transform

import numpy as np

T = TypeVar("T")
R = TypeVar("R", bound="Labelled")

_LABEL = "label"


class Variable(NamedTuple):
    """One labelled array.

    data: numbers, booleans or text, one axis per name in dims; for writing, also `LazyArray`.
    dims: name of each axis; a one-dimensional variable named like its axis is its coordinate.
    units: SI symbol such as "m" or "Hz", "1" for none. Not "seconds": xarray turns that into dates.
    long_name: what it is, in words.
    flags: meaning of each number, for codes; flag_values and flag_meanings in the file, _ for " ".
    """

    data: Any
    dims: tuple[str, ...]
    units: str
    long_name: str
    flags: Mapping[int, str] | None = None


class Variables(dict[str, Variable]):
    """Variables of a file, which is made of more than one result."""

    def put(self, name: str, data: Any, unit: str, text: str, *dims: str) -> None:
        """Add a variable; arguments as in `Variable`."""
        self[name] = Variable(np.asarray(data), dims, unit, text)


@dataclasses.dataclass(frozen=True)
class Label:
    """What a field is.

    unit: SI symbol, "1" for none; "" for words and parts, which only documents hold.
    text: what it is, in words.
    dims: its axes, outermost first.
    file_name: of its variable; "": that of the field.
    flags: meaning of each number, for codes.
    is_in_document: whether documents hold it.
    """

    unit: str
    text: str
    dims: tuple[str, ...] = ()
    file_name: str = ""
    flags: Mapping[int, str] | None = None
    is_in_document: bool = True

    def __post_init__(self) -> None:
        if not self.text or (self.dims and not self.unit):
            raise TypeError(f"{self}: no {'unit' if self.text else 'text'}")


def labelled(
    unit: str,
    text: str,
    *dims: str,
    file_name: str = "",
    flags: Mapping[int, str] | None = None,
    is_in_document: bool = True,
    default: Any = dataclasses.MISSING,
) -> Any:
    """A field with numbers or labels, for files and documents; arguments as in `Label`."""
    if not unit:
        raise TypeError(f"{text}: no unit")
    label = Label(unit, text, dims, file_name, flags, is_in_document)
    return dataclasses.field(default=default, metadata={_LABEL: label})


def told(text: str, *, default: Any = dataclasses.MISSING) -> Any:
    """A field with words, a part of the result or a list of such, for documents."""
    return dataclasses.field(default=default, metadata={_LABEL: Label("", text)})


def unwritten(*, default: Any = dataclasses.MISSING) -> Any:
    """A field for further computing only."""
    return dataclasses.field(default=default, metadata={_LABEL: None})


class Derived(property):
    """A property with a label."""

    label: Label


def derived(
    unit: str, text: str, *dims: str, file_name: str = ""
) -> Callable[[Callable[[Any], T]], T]:
    """A property with a label; unit "": for documents only."""

    def make(compute: Callable[[Any], T]) -> T:
        found = Derived(compute)
        found.label = Label(unit, text, dims, file_name)
        return cast("T", found)  # what instances have

    return make


class Records(NamedTuple):
    """Fields that a document shows as a list of records.

    name: of the list; dims: over which axes; text: what a record is; where: field that tells which
    of them there are, "" for all.
    """

    name: str
    dims: tuple[str, ...]
    text: str
    where: str = ""


@dataclass_transform(
    frozen_default=True, eq_default=False, field_specifiers=(labelled, told, unwritten)
)
class Labelled:
    """Base of all results, which are frozen dataclasses whose fields all have labels.

    command: whose document it is, "" for parts of others; version: of the document's format.
    """

    COMMAND: ClassVar[str] = ""
    VERSION: ClassVar[int] = 1
    ROWS: ClassVar[Records | None] = None

    def __init_subclass__(cls, command: str = "", version: int = 1) -> None:
        super().__init_subclass__()
        dataclasses.dataclass(frozen=True, eq=False)(cls)
        cls.COMMAND, cls.VERSION = command, version
        for field in dataclasses.fields(cls):  # type: ignore[arg-type]
            if _LABEL not in field.metadata:
                raise TypeError(f"{cls.__name__}.{field.name}: no label")

    def replace(self: R, **changes: Any) -> R:
        """The same with other fields."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


def labels(kind: type[Labelled]) -> dict[str, Label]:
    """Fields and derived numbers of a result with their labels; fields first."""
    fields = {
        field.name: field.metadata[_LABEL]
        for field in dataclasses.fields(kind)  # type: ignore[arg-type]
        if field.metadata[_LABEL] is not None
    }
    more = {name: x.label for name, x in vars(kind).items() if isinstance(x, Derived)}
    return fields | more


def variables(result: Labelled) -> dict[str, Variable]:
    """What a file holds of a result: its labelled fields, and those of its parts."""
    found: dict[str, Variable] = {}
    for name, label in labels(type(result)).items():
        value = getattr(result, name)
        if isinstance(value, Labelled):
            found |= variables(value)
        elif label.unit and value is not None:
            data = np.asarray(value)
            data = data.astype(str) if data.dtype == object else data
            stored = Variable(data, label.dims, label.unit, label.text, label.flags)
            found[label.file_name or name] = stored
    return found


def document(result: Labelled) -> dict[str, Any]:
    """What a document holds of a result, as JSON knows it; None for what is not finite."""
    rows, whole = result.ROWS, {}
    for name, label in labels(type(result)).items():
        if label.is_in_document and not (rows and set(label.dims) & set(rows.dims)):
            whole[name] = plain(getattr(result, name))
    return whole if rows is None else whole | {rows.name: list(records(result, rows))}


def records(result: Labelled, rows: Records) -> Iterator[dict[str, Any]]:
    """Records of what has some of these axes, one for each place where there is one."""
    values = {
        name: (getattr(result, name), label.dims)
        for name, label in labels(type(result)).items()
        if label.is_in_document and set(label.dims) & set(rows.dims)
    }
    sizes = {
        axis: n for x, dims in values.values() for axis, n in zip(dims, np.shape(x), strict=True)
    }
    for place in np.ndindex(*(sizes[axis] for axis in rows.dims)):
        at = dict(zip(rows.dims, place, strict=True))
        if not rows.where or getattr(result, rows.where)[place]:
            yield {
                name: plain(np.asarray(x)[tuple(at[axis] for axis in dims if axis in at)])
                for name, (x, dims) in values.items()
            }


def plain(value: Any) -> Any:
    """A value as JSON holds it; None for numbers that are not finite."""
    if isinstance(value, Labelled):
        return document(value)
    if hasattr(value, "model_dump"):  # a study
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(entry) for entry in value]
    if isinstance(value, bytes):
        return value.decode()
    return None if isinstance(value, float) and not np.isfinite(value) else value
