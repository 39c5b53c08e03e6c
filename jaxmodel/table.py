"""Named entries of one kind, extensible by users."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Generic, NamedTuple, Protocol, TypeVar


class PartError(ValueError):
    """A part that violates its contract; the message says which and how."""


class Parameter(NamedTuple):
    """An entry's own field in the study file, `[control.laws.NAME]`,
    `[drive.kinds.NAME]` or `[machine.kinds.NAME]`; one number, or one a link."""

    name: str
    default: float
    unit: str
    text: str
    low: float  # smallest value allowed
    high: float


def check_parameters(place: str, parameters: Iterable[Parameter]) -> None:
    """Raise PartError for parameters that are invalid; `place` names their entry in messages."""
    seen: set[str] = set()
    if not isinstance(parameters, (tuple, list)):
        raise PartError(f"{place}: parameters = {parameters!r}; expected a tuple of Parameter")
    for x in parameters:
        if not isinstance(x, Parameter):
            raise PartError(f"{place}: parameters: {x!r}; expected a Parameter")
        for kind, expected, fields in (
            (str, "a text", (x.name, x.unit, x.text)),
            ((int, float), "a number", (x.default, x.low, x.high)),
        ):
            for value in fields:
                if not isinstance(value, kind):
                    raise PartError(f"{place}: {value!r} in {x!r}; expected {expected}")
        if not x.name.isidentifier() or x.name in seen:
            raise PartError(f"{place}: parameter {x.name!r}; expected a unique name")
        if not x.low <= x.default <= x.high:
            raise PartError(
                f"{place}: parameter {x.name!r}: default {x.default:g}; "
                f"allowed: {x.low:g} to {x.high:g}"
            )
        seen.add(x.name)


def is_real(value: Any) -> bool:
    """Whether a value is a real number, or an array of them."""
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    return isinstance(value, (int, float)) or (kind != "" and kind in "fiu")


class Named(Protocol):
    """An entry of a table."""

    @property
    def name(self) -> str: ...


_Entry = TypeVar("_Entry", bound=Named)


class Table(Mapping[str, _Entry], Generic[_Entry]):
    """Entries by name, in the order they were added."""

    def __init__(
        self,
        kind: str,
        entries: Iterable[_Entry],
        check: Callable[[_Entry], None] = lambda entry: None,
    ) -> None:
        """
        Args:
            kind: what an entry is called.
            entries: the initial ones, at least one.
            check: raises `PartError` for an entry that violates its contract.
        """
        self.kind, self._check = kind, check
        self._entries = {entry.name: entry for entry in entries}

    def __getitem__(self, name: str) -> _Entry:
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def position(self, name: str) -> int:
        """Position of an entry, which stands for it in arrays."""
        return list(self._entries).index(name)

    def add(self, entry: _Entry) -> None:
        """Add an entry.

        Raises:
            PartError: it has the wrong type, its name is taken or invalid, or it violates its
                contract.
        """
        kind = type(next(iter(self._entries.values())))
        if not isinstance(entry, kind):
            raise PartError(f"{self.kind} {entry!r}: expected a {kind.__name__}")
        name = entry.name
        if not isinstance(name, str):
            raise PartError(f"{self.kind} {name!r}: expected a text as its name")
        plain = name.replace("-", "_")
        if not plain.isidentifier() or name.startswith("_") or hasattr(dict, name):
            raise PartError(f"{self.kind} {name!r}: letters, digits, - and _ are allowed in a name")
        self._check(entry)
        if self._entries.setdefault(name, entry) is not entry:
            raise PartError(f"{self.kind} {name!r}: this name is taken; choose another")
