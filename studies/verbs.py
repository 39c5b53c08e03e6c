"""What all verbs have in common: their arguments are checked before any work."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from functools import wraps
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar, cast

from studies.errors import StudyError, field_error
from studies.publish import check_target

F = TypeVar("F", bound=Callable[..., Any])
#: By the words of an annotation: types of what is meant, and how it is called.
_KINDS: dict[str, tuple[Any, str]] = {
    "str": (str, "a text"),
    "Path": (Path, "a path"),
    "bool": (bool, "True or False"),
    "int": (Integral, "a whole number"),
    "float": (Real, "a number"),
    "None": (type(None), "None"),
    "Sequence": (list | tuple, "a list of numbers"),
    "Mapping": (Mapping, "numbers by name"),
    "Place": (Integral | str | Path | None, "a number of processes, a scheduler's address or file"),
}


def verb(function: F) -> F:
    """Check the types of a verb's arguments, where its annotations name plain ones.

    Raises:
        StudyError: an argument of another type, an empty name, or a number that is not finite.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        given = signature.bind(*arguments, **named).arguments
        for name, value in given.items():
            _check(name, value, str(signature.parameters[name].annotation))
        return function(*arguments, **named)

    return cast(F, call)


def _check(name: str, value: Any, annotation: str) -> None:
    parts = [part.partition("[")[0] for part in annotation.split(" | ")]
    if not {*parts} <= _KINDS.keys():  # types of its own, which a verb checks
        return
    label = name.upper() if name == "what" else f"--{name.replace('_', '-')}"
    kinds, words = zip(*(_KINDS[part] for part in parts), strict=True)
    if not isinstance(value, kinds) or (isinstance(value, bool) and "bool" not in parts):
        raise field_error(label, value, " or ".join(words))
    if name == "out" and value == "":
        raise StudyError("--out: an empty name; name a file or a folder")
    if isinstance(value, float) and not math.isfinite(value):
        raise field_error(label, value, "a finite number")
    if name == "worker_timeout" and not value > 0:
        raise field_error(label, value, "more than 0", "s")


def check_file(out: str | Path | None, *endings: str) -> None:
    """Refuse a file of another kind, or one that cannot be written; call it before long work.

    Raises:
        StudyError: if so.
    """
    if out is not None:
        check_target(out)
        if Path(out).suffix.lower() not in endings:
            raise field_error("--out", str(out), f"a file {', '.join(endings)}")
