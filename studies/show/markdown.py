"""Markdown: escaped text, tables, figures."""

from __future__ import annotations

import re
from collections.abc import Iterable
from urllib.parse import quote

from studies.errors import printable

#: What Markdown takes for a mark wherever it stands (not [ alone, or _ inside a word).
_MARKS = re.compile(
    r"[\\`*|#]|<(?=[A-Za-z/!?])|&(?=[#\w])|\](?=[(\[:])|(?<!\w)_|_(?!\w)",
)
#: What it takes for one at the begin of a line.
_FIRST_MARKS = re.compile(r"^(\d*)([-+.)](?=\s|$)|[>=~]|--)")


def literal(text: str) -> str:
    """A user's text, such as a title, escaped for Markdown, on one line."""
    line = printable(" ".join(text.split()))
    return _FIRST_MARKS.sub(r"\1\\\2", _MARKS.sub(r"\\\g<0>", line))


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    names = list(header)
    return "\n".join([_row(names), _row(["---"] * len(names)), *(_row(row) for row in rows)])


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def picture(name: str, caption: str) -> str:
    """Line of a figure, a paragraph of its own.

    Args:
        name: of its PNG or GIF file, in the same folder as the text.
        caption: Markdown.
    """
    return f"![{caption}]({quote(name)})"
