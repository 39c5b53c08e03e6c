"""Fields whose values are names from a table that users can extend."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

#: Note that messages add to the names of extensible tables.
OWN = "one of your own with studies --with FILE.py"


class OneOf:
    """Annotation of a text field: one of the current names of a table."""

    def __init__(self, names: Callable[[], Iterable[str]], note: str = "") -> None:
        """
        Args:
            names: of the table.
            note: what messages add to the names.
        """
        self._names, self.note = names, note

    @property
    def names(self) -> tuple[str, ...]:
        """Allowed names."""
        return tuple(self._names())

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return handler(schema) | {"enum": list(self.names)}

    def _checked(self, name: str) -> str:
        if name not in self.names:
            raise PydanticCustomError("one_of", "not in the table")
        return name
