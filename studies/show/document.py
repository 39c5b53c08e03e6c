"""JSON documents: what reading commands print with --json, and what folders keep.

A document names its format, its numbers are in SI units under their names in files, and what is not
a finite number is null. Every format has a JSON schema in `studies/schemas`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import typer

from studies.errors import field_error, nearest

_SCHEMAS = Path(__file__).parents[1] / "schemas"

#: The option of every reading command.
AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="print one JSON document; `studies schema` describes it")
]


def json_text(command: str, content: Mapping[str, Any], version: int = 1) -> str:
    """Text of a document.

    Args:
        command: that writes it; the format is `flexlink-COMMAND`.
        content: by name; arrays, tuples and NumPy's numbers become lists and numbers.
        version: of the format.
    """
    whole = {"format": f"flexlink-{command}", "format_version": version, **content}
    return json.dumps(plain(whole), indent=1, allow_nan=False) + "\n"


def print_document(command: str, content: Mapping[str, Any]) -> None:
    """Print a document, all that standard output gets; arguments as `json_text`."""
    sys.stdout.write(json_text(command, content))


def plain(value: Any) -> Any:
    """A value as JSON holds it; None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, bytes):
        return value.decode()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def documented() -> list[str]:
    """Commands that have a schema."""
    return sorted(path.stem for path in _SCHEMAS.glob("*.json"))


def schema(command: str) -> dict[str, Any]:
    """JSON schema (2020-12) of the document that a command prints with --json, or writes.

    Args:
        command: such as "best"; "sweep" is the plan of `studies sweep --dry-run --json`,
            "spillover" and "fit" are `certificate.json` and `fit.json`.

    Raises:
        StudyError: a command without one.
    """
    if command not in documented():
        hint = nearest(str(command), documented())
        raise field_error("command", command, ", ".join(documented()), hint=hint)
    content: dict[str, Any] = json.loads((_SCHEMAS / f"{command}.json").read_text("utf-8"))
    return content
