"""Exceptions and warnings meant for users, and how their messages are built."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping
from difflib import get_close_matches

#: Longer values are shortened to this [characters].
LONGEST = 120


class StudyError(Exception):
    """A mistake in the user's request; its text is one complete message for the user."""


class NoKernelError(StudyError):
    """A loop that cannot become a traced kernel; XLA's scan runs it instead."""


class NoKernelWarning(UserWarning):
    """XLA's scan runs a loop for which there is no traced kernel."""


class ModelWarning(UserWarning):
    """A simplification of the model that shows in this study."""


class CacheWarning(UserWarning):
    """Compiled programs are not cached."""


class ResolutionWarning(UserWarning):
    """Values are compared that the controller cannot measure."""


class DataWarning(UserWarning):
    """A file of measurements holds other than its entry says."""


class FigureWarning(UserWarning):
    """A figure could not be drawn; its page says so in its place."""


#: Warnings that the command line prints as one line.
OWN_WARNINGS = (
    NoKernelWarning,
    ModelWarning,
    CacheWarning,
    ResolutionWarning,
    DataWarning,
    FigureWarning,
)


def warn_of_model(text: str) -> None:
    """Say what a simplification of the model costs."""
    warnings.warn(text, ModelWarning, stacklevel=3)


def warn_of_scan(error: NoKernelError) -> None:
    """Say that XLA's scan replaces a kernel, and why."""
    text = f"{error}; XLA's scan runs instead, several times slower"
    warnings.warn(text, NoKernelWarning, stacklevel=3)


def field_error(
    field: str, value: object, allowed: str, unit: str = "", hint: str = ""
) -> StudyError:
    """Build the error `field = value; allowed: ... [unit]; did you mean ...?` to raise.

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


#: Control characters but line feeds and tabs, and what changes the direction of text.
_CONTROL = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """A text without terminal's control sequences: each of their characters as its escape."""
    return _CONTROL.sub(lambda match: ascii(match[0])[1:-1], text)


def shown_name(name: str) -> str:
    """A valid name unchanged, anything else quoted; shortened to `LONGEST` characters."""
    text = name if name.replace(".", "").replace("_", "").isalnum() else repr(name)
    return text if len(text) <= LONGEST else text[: LONGEST - 4] + " ..."


def _text(value: object, depth: int = LONGEST) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        # nesting deeper than the shown text is cut anyway
        return "[" + ", ".join(_text(entry, depth - 1) for entry in value if depth) + "]"
    return repr(value) if isinstance(value, str) else str(value)


def nearest(name: str, names: Iterable[str]) -> str:
    """The entry of `names` most like `name`, ignoring case, or "" if none is close."""
    return _closest(name.lower(), {candidate.lower(): candidate for candidate in names})


def nearest_field(name: str, fields: Iterable[str]) -> str:
    """The one of `fields`, such as `drive.kp`, most like `name`, or "" if none is close.

    A guess is mostly wrong in one part: so its own section first, then the last part in any.
    """
    section, _, leaf = name.lower().rpartition(".")
    whole = {field.lower(): field for field in fields}
    parts = [(*lower.rpartition("."), field) for lower, field in reversed(whole.items())]
    own = {last: field for where, _, last, field in parts if where == section}
    anywhere = {last: field for _, _, last, field in parts}  # the first section that has it
    turned = {"".join(sorted(last)): field for last, field in own.items()}  # pk for kp
    close = _closest(leaf, own) or turned.get("".join(sorted(leaf)), "")
    close = close or _closest(leaf, anywhere)
    return close if close or own else _closest(name.lower(), whole)


def _closest(wanted: str, found: Mapping[str, str]) -> str:
    close = get_close_matches(wanted, found, n=1)
    return found[close[0]] if close else ""
