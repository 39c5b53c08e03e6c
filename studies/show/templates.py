"""Rendering of templates (Jinja2): reports, pages, C code.

A template is in the folder of the module that fills it: `report.md` next to `report.py`. In
Markdown, a paragraph can break its lines anywhere, and blocks leave no trace: `paragraphs` joins
each paragraph into one line.

To add one, write the template and call `render` with the values it names. A name without a value
is an error.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from studies.show.markdown import literal, picture, table
from studies.show.units import count_text, headed, number, span
from studies.study.entries import links_text
from studies.study.labels import describe
from studies.study.margin import margin_in_db

_ROOT = Path(__file__).parents[1]
#: Lines of Markdown with these beginnings stand alone.
_ALONE = ("#", "|", "![", "```")


def _short(value: float, digits: int = 4) -> str:
    """A number with this many significant digits."""
    return f"{value:.{digits}g}"


def _percent(share: float, digits: int = 3) -> str:
    """A share in percent."""
    return f"{100 * share:.{digits}g} %"


def _change(after: float, before: float) -> str:
    """A relative change in percent."""
    return f"{100 * (after / before - 1):+.3g} %"


#: How templates write values: `{{ value | name }}`.
FILTERS: dict[str, Callable[..., str]] = {
    "short": _short,
    "percent": _percent,
    "change": _change,
    "number": number,
    "count": count_text,
    "headed": headed,
    "span": span,
    "links": links_text,
    "literal": literal,
    "margin": margin_in_db,
    "status": describe,
}


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_ROOT),
        undefined=StrictUndefined,
        autoescape=select_autoescape(["html"], default=False),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(FILTERS)
    environment.globals.update(table=table, picture=picture)
    return environment


def render(name: str, /, **values: Any) -> str:
    """Fill in a template.

    Args:
        name: of its file, relative to `studies`: "tuning/report.md".
        values: by the names it uses; FILTERS, `table` and `picture` are always available.

    Returns:
        The text; Markdown with each paragraph on one line.

    Raises:
        jinja2.UndefinedError: a name without a value.
    """
    text = _environment().get_template(name).render(values)
    return paragraphs(text) if name.endswith(".md") else text


def paragraphs(text: str) -> str:
    """Markdown with each paragraph and list entry on one line, and one empty line between.

    Entries keep their depth, and code between lines of ``` stays as it is.
    """
    blocks: list[str] = [""]
    is_code = False
    for line in text.splitlines():
        is_code ^= line.startswith("```")
        is_entry = line.lstrip().startswith("- ")
        if not is_code and not line.startswith("|"):
            depth = len(line) - len(line.lstrip()) if is_entry else 0
            line = " " * depth + " ".join(line.split())
        is_alone = is_code or line.startswith(_ALONE) or blocks[-1].startswith(_ALONE)
        if line and blocks[-1] and not is_alone and not is_entry:
            blocks[-1] += f" {line}"
        elif line or blocks[-1]:
            blocks.append(line)
    return "\n".join(blocks).strip("\n") + "\n"
