"""JSON schemas of results (2020-12), from the declarations of their fields."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from studies.results.labelled import Label, Labelled, labels

#: Types that JSON has; numbers that are not finite are null.
_SIMPLE: dict[Any, Any] = {
    bool: "boolean",
    int: "integer",
    float: ["number", "null"],
    str: "string",
    type(None): "null",
}
_KINDS = {"b": "boolean", "i": "integer", "u": "integer", "U": "string", "f": ["number", "null"]}


def schema_of(kind: type[Labelled]) -> dict[str, Any]:
    """Schema of the document of a result."""
    rules = _object(kind)
    formed = {
        "format": {"const": f"flexlink-{kind.COMMAND}"},
        "format_version": {"const": kind.VERSION},
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"flexlink-{kind.COMMAND}",
        "description": " ".join((kind.__doc__ or "").split()),
        **rules,
        "properties": formed | rules["properties"],
        "required": [*formed, *rules["required"]],
    }


def _object(kind: type[Labelled]) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    of_rows: dict[str, Any] = {}
    over = () if kind.ROWS is None else kind.ROWS.dims
    for name, label in labels(kind).items():
        if not label.is_in_document:
            continue
        rest = [axis for axis in label.dims if axis not in over]
        is_in_row = len(rest) < len(label.dims)
        rule = _labelled(_annotation(kind, name), label, len(rest))
        (of_rows if is_in_row else entries)[name] = rule
    if kind.ROWS is not None:
        listed = {"type": "array", "items": _closed(of_rows), "description": kind.ROWS.text}
        entries[kind.ROWS.name] = listed
    return _closed(entries)


def _closed(properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _annotation(kind: type[Labelled], name: str) -> Any:
    """Type of a field, or of what a property returns."""
    compute = getattr(getattr(kind, name, None), "fget", None)
    return get_type_hints(compute)["return"] if compute else get_type_hints(kind)[name]


def _labelled(annotation: Any, label: Label, depth: int) -> dict[str, Any]:
    rule = _rule(annotation, depth) | {"description": label.text}
    return rule | ({"unit": label.unit} if label.unit not in ("", "1") else {})


def _rule(annotation: Any, depth: int = 0) -> dict[str, Any]:
    """Rule of a type; depth: number of axes of an array."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if annotation in _SIMPLE:
        return {"type": _SIMPLE[annotation]}
    if annotation is np.ndarray or origin is np.ndarray:
        return _nested(_leaf(inner), depth)
    if origin is Literal:
        return {"enum": list(inner)}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_rule(one, depth) for one in inner]}
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": _rule(inner[1], depth)}
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return {"type": "array", "items": _rule(inner[0], depth)}
    if isinstance(annotation, type) and issubclass(annotation, Labelled):
        return _object(annotation)
    if hasattr(annotation, "model_dump"):  # a study
        return {"type": "object"}
    if annotation is Any:
        return {}
    raise TypeError(f"{annotation}: JSON has no such type")


def _leaf(inner: tuple[Any, ...]) -> dict[str, Any]:
    """Rule of an array's entries, by its type if that names one."""
    scalar = get_args(inner[1]) if len(inner) == 2 else ()
    kind = np.dtype(scalar[0]).kind if scalar and scalar[0] is not Any else "f"
    return {"type": _KINDS[kind]}


def _nested(leaf: dict[str, Any], depth: int) -> dict[str, Any]:
    return reduce(lambda rule, _: {"type": "array", "items": rule}, range(depth), leaf)
