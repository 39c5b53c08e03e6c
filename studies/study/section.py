"""A section of a file: its fields, checked and frozen, with their units in words."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

#: What can be free: tunings move what a designer decides, fits also what is found by measuring.
DESIGN, MACHINE = "design", "machine"


def described(default: Any, unit: str, text: str, free: str = "", **bounds: Any) -> Any:
    extra = {"unit": unit, "free": free}
    return Field(default, description=text, json_schema_extra=extra, **bounds)  # type: ignore[arg-type]


class Section(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, validate_default=True
    )

    def __hash__(self) -> int:
        """Equal for equal sections; pydantic's own fails for tables, such as `control.laws`."""
        return hash(_hashable(dict(self)))


def _hashable(value: Any) -> Any:
    """Something of equal values that can be hashed: tables, at any depth, without their order."""
    if isinstance(value, dict):
        return frozenset((name, _hashable(entry)) for name, entry in value.items())
    return tuple(map(_hashable, value)) if isinstance(value, tuple | list) else value
