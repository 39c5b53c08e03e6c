"""The one exception that a user is meant to read, and how its message is built."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

#: More of a value than this is not shown [characters].
LONGEST = 120


class StudyError(Exception):
    """A mistake in what was asked for; its text is one complete message for the user."""


def field_error(
    field: str, value: object, allowed: str, unit: str = "", hint: str = ""
) -> StudyError:
    """Build the error `field = value; allowed: ... [unit]; did you mean ...?`, to be raised.

    field: the name as the user wrote it. value: what was given. allowed: the range or the names.
    unit: unit of the range, "" for none. hint: the nearest valid name, "" for none (see `nearest`).
    """
    message = f"{field} = {shown(value)}; allowed: {allowed}"
    if unit:
        message += f" [{unit}]"
    if hint:
        message += f"; did you mean {hint!r}?"
    return StudyError(message)


def shown(value: object) -> str:
    """A value as a study file writes it, on one line and shortened to `LONGEST` characters."""
    text = _text(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 4] + " ..."


def shown_name(name: str) -> str:
    """A name as it is where it is one, else quoted; shortened to `LONGEST` characters."""
    text = name if name.replace(".", "").replace("_", "").isalnum() else repr(name)
    return text if len(text) <= LONGEST else text[: LONGEST - 4] + " ..."


def _text(value: object, depth: int = LONGEST) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        # what is nested deeper than a text is long is not shown anyway
        return "[" + ", ".join(_text(entry, depth - 1) for entry in value if depth) + "]"
    return repr(value) if isinstance(value, str) else str(value)


def nearest(name: str, names: Iterable[str]) -> str:
    """The entry of `names` most like `name` regardless of case, or "" where none is close."""
    by_lower = {candidate.lower(): candidate for candidate in names}
    close = get_close_matches(name.lower(), by_lower, n=1)
    return by_lower[close[0]] if close else ""
