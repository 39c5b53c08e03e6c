"""What a command tells of its result, as data: page, console and notebook print the same.

Each feature has one function `say(result) -> Report`, in its module `say`. Texts may have `code`
between backticks and **strong** words; lines of a long one are joined.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from rich.console import Console

from studies.errors import field_error, nearest
from studies.show.listing import Rows, print_rows
from studies.study.spec import Study


@dataclass(frozen=True)
class Drawing:
    """A figure: the name of its file, what it shows, and what draws it; None: it is there."""

    name: str
    caption: str
    draw: Callable[[], Any] | None  # Matplotlib, which takes long to import, is not needed here


@dataclass(frozen=True)
class Items:
    """A list of texts."""

    texts: Sequence[str]

    def __bool__(self) -> bool:
        return bool(self.texts)


#: Name of the figure of a machine, and what it shows.
MACHINE = "machine"
CAPTION = (
    "The machine at its first way-point, and its links to scale, each from its face and, below, "
    "from its edge; blue: links under control, grey: the others, orange: actuators, green: "
    "sensors, on opposite faces, red: the path of the platform's reference point, enlarged where "
    "it is short, black cross: a payload's centre of mass"
)
#: What stands below a heading; what is empty is left out.
Part = str | Rows | Drawing | Items | None


@dataclass(frozen=True)
class Chapter:
    """A heading, and what stands below it."""

    title: str
    parts: Sequence[Part]


@dataclass(frozen=True)
class Report:
    """What is told: the result in sentences first, then what was asked, and what to do next."""

    title: str
    result: Sequence[str]  # empty texts are left out
    question: str
    next_steps: str
    top: Sequence[Part]  # below these
    chapters: Sequence[Chapter | None]
    files: Mapping[str, Study | str]  # to append, by title; the first study is the one reported on
    caveat: str = ""  # what is to be said of margins, if there are any; "": they leave stretch out

    def __post_init__(self) -> None:
        object.__setattr__(self, "result", [text for text in self.result if text])

    @property
    def parts(self) -> list[Part]:
        """All of them, in order."""
        return [*self.top, *(x for chapter in self.chapters if chapter for x in chapter.parts)]

    def lines(self) -> list[str]:
        """The result and the caveat, a sentence a line."""
        return [plain(text) for text in [*self.result, self.caveat] if text]

    def plot(self, name: str = "") -> Any:
        """A figure of Matplotlib, by name; default: the first.

        Raises:
            StudyError: there is none.
        """
        found = {x.name: x.draw for x in self.parts if isinstance(x, Drawing) and x.draw}
        if name not in ("", *found) or not found:
            raise field_error("name", name, ", ".join(found) or "none", hint=nearest(name, found))
        draw = found[name] if name else next(iter(found.values()))
        return draw()


def chapter(title: str, *parts: Part) -> Chapter | None:
    """A heading with what is not empty of some parts; None if all are."""
    shown = [part for part in parts if part]
    return Chapter(title, shown) if shown else None


def listed(*parts: Part) -> Report:
    """Parts alone, for the console."""
    return Report("", (), "", "", parts, (), {})


def drawing(
    draw: Callable[..., Any], *arguments: Any, name: str = "", height: float = 0.0
) -> Drawing:
    """A figure whose caption is what its function says of itself.

    Args:
        draw: what draws it, its last argument the axes if `height` is given.
        arguments: of that function.
        name: of its file; default: the function's.
        height: [inch] of a figure with one pair of axes.
    """

    def on_axes() -> Any:
        from studies.show.figures import one_panel

        figure, axes = one_panel(height)
        draw(*arguments, axes)
        return figure

    caption = (inspect.getdoc(draw) or "").partition("\n\nArgs:")[0]
    made = on_axes if height else partial(draw, *arguments)
    return Drawing(name or draw.__name__, caption, made)


def machine(study: Study | Callable[[], Study], more: str = "") -> Drawing:
    """The sketch of a machine: of a study, or one that a function makes; more: to be said of it."""

    def draw() -> Any:
        from studies.show.sketch import sketch

        return sketch(study() if callable(study) else study)

    return Drawing(MACHINE, f"{CAPTION}. {more}" if more else CAPTION, draw)


def sentence(text: str) -> str:
    """A text with a capital, but for names such as `residual_rms`, and a full stop."""
    start = text[:2] if text.startswith("**") else ""
    rest = text.removeprefix(start)
    closed = rest if rest.rstrip("*").endswith((".", "!", "?", ":")) else f"{rest}."
    first = rest[:1] if "_" in rest.partition(" ")[0] else rest[:1].upper()
    return start + first + closed[1:] if rest else ""


def print_report(report: Report, console: Console) -> None:
    """Print the result, a sentence a line, and the texts and tables below it."""
    for part in [*report.lines(), *report.parts]:
        if isinstance(part, Rows):
            print_rows(part, console)
        elif isinstance(part, str) and part:
            style = "bold red" if part.startswith("**") else None
            console.print(plain(part), soft_wrap=True, style=style)


def plain(text: str) -> str:
    """A text without marks, on one line."""
    return " ".join(text.replace("**", "").replace("`", "").split())
