"""Named entries of one kind, extensible by users."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Generic, Protocol, TypeVar


class PartError(ValueError):
    """A part that violates its contract; the message says which and how."""


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
        plain = name.replace("-", "_")
        if not plain.isidentifier() or name.startswith("_") or hasattr(dict, name):
            raise PartError(f"{self.kind} {name!r}: letters, digits, - and _ are allowed in a name")
        self._check(entry)
        if self._entries.setdefault(name, entry) is not entry:
            raise PartError(f"{self.kind} {name!r}: this name is taken; choose another")
