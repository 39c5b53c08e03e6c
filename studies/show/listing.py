"""Tables of texts on a console, of which nothing is cut however narrow it is."""

from __future__ import annotations

import re
from typing import NamedTuple

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table

#: Where a text may go on in the next line: at spaces, and inside names such as `drive.pulse_force`.
_BREAK = re.compile(r"(?<=[._])(?=[A-Za-z])|(?<=\w)(?=\[)|(?<= )")
#: Characters that a column needs beside its text, and a table beside its columns.
_BESIDE_COLUMN, _BESIDE_TABLE = 3, 1


class Rows(NamedTuple):
    """A table to print, or to write into a report."""

    heads: list[str]
    rows: list[list[str]]

    def __bool__(self) -> bool:
        return bool(self.rows)


def print_rows(listing: Rows, console: Console) -> None:
    """Print a table; where it is too wide, with its rows as columns, as many at a time as fit."""
    if not listing.rows or _least_width(listing) <= console.width:
        _print_table(listing, console)
        return
    count = len(listing.rows)
    parts = [_turned(listing, 0, count)]
    while count > 1 and max(map(_least_width, parts)) > console.width:
        count -= 1
        parts = [_turned(listing, k, count) for k in range(0, len(listing.rows), count)]
    for part in parts:
        _print_table(part, console)


def _turned(listing: Rows, first: int, count: int) -> Rows:
    """Some rows as columns, the headings as the first column."""
    columns = zip(listing.heads, *listing.rows[first : first + count], strict=True)
    heads, *rows = map(list, columns)
    return Rows(heads, rows)


def _print_table(listing: Rows, console: Console) -> None:
    table = Table()
    columns = _columns(listing)
    widths = _widths(columns, console.width)
    folded = [
        ["\n".join(_lines(text, width)) for text in column]
        for column, width in zip(columns, widths, strict=True)
    ]
    for (head, *_), width in zip(folded, widths, strict=True):
        table.add_column(head, min_width=width, overflow="fold")
    for row in zip(*(column[1:] for column in folded), strict=True):
        table.add_row(*row)
    console.print(table)


def _columns(listing: Rows) -> list[list[str]]:
    return [list(column) for column in zip(listing.heads, *listing.rows, strict=True)]


def _least_width(listing: Rows) -> int:
    """Characters across that a table needs if every text is folded as far as it can be."""
    return _total([max(map(_least, column)) for column in _columns(listing)])


def _total(widths: list[int]) -> int:
    return sum(widths) + _BESIDE_COLUMN * len(widths) + _BESIDE_TABLE


def _least(text: str) -> int:
    return max(cell_len(piece.rstrip()) for piece in _BREAK.split(text))


def _widths(columns: list[list[str]], available: int) -> list[int]:
    """Of each column: what its texts need for one line, from the left on, as far as it goes."""
    widths = [max(map(_least, column)) for column in columns]
    spare = available - _total(widths)
    for k, column in enumerate(columns):
        more = min(max(map(cell_len, column)) - widths[k], max(spare, 0))
        widths[k], spare = widths[k] + more, spare - more
    return widths


def _lines(text: str, width: int) -> list[str]:
    """A text in lines of at most so many characters, unless a piece of it is longer."""
    lines = [""]
    for piece in _BREAK.split(text):
        if cell_len((lines[-1] + piece).rstrip()) > width and lines[-1]:
            lines.append("")
        lines[-1] += piece
    return [line.rstrip() for line in lines]
