"""Reports as web pages, and all other templates (Jinja2).

A page is one HTML file that contains its figures, the files it refers to and the versions that made
it. It loads nothing, and its only script sorts tables, so it opens offline, in an email, and in
many years. One template, `show/page.html`, prints every `Report`; `show/card.html` prints the same
for a notebook.

Other templates are in the folder of the module that fills them. Whatever a value contains is shown
as text. A name without a value is an error.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from studies import config, passport
from studies.errors import printable
from studies.publish import FAULT, REPORT
from studies.show import figures
from studies.show.listing import Rows
from studies.show.report import MACHINE, Drawing, Report, plain, sentence
from studies.study.margin import GUESSED
from studies.study.spec import Study
from studies.study.template import own_text, study_template

_ROOT = Path(__file__).parents[1]
#: Where a name in a table may go on in the next line.
_JOINT = re.compile(r"(?<=[A-Za-z][_./])(?=\w)|(?<=\w)(?=\[)")
#: Words that are code or strong.
_MARKED = re.compile(r"`([^`]+)`|\*\*(.+?)\*\*")
#: Images with more pixels than this across keep a readable width on a narrow screen.
WIDE = 550
#: Rows of a card's table, and width [inch] and resolution [1/inch] of its picture.
MOST, CARD_WIDTH, CARD_DPI = 6, 5.6, 90


def _short(value: float, digits: int = 4) -> str:
    """A number with this many significant digits."""
    return f"{value:.{digits}g}"


def _breakable(text: str) -> Markup:
    """A text with places to break long names, so that a table of many columns fits the page."""
    return Markup("<wbr>").join(_JOINT.split(_unbroken(text)))


def _unbroken(text: str) -> str:
    """A text with each number and its sign on one line."""
    return re.sub(" (?=[%†])", "\N{NO-BREAK SPACE}", text)


def prose(text: str) -> Markup:
    """A text of this program, with `code` and **strong** words, in one piece."""
    return Markup(_marked(str(escape(_unbroken(" ".join(text.split()))))))


def _marked(text: str) -> str:
    def mark(found: re.Match[str]) -> str:
        return f"<code>{found[1]}</code>" if found[1] else f"<b>{_marked(found[2])}</b>"

    return _MARKED.sub(mark, text)


def _anchor(title: str) -> str:
    """Name of a section in links to it."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


#: How templates write values: `{{ value | name }}`.
FILTERS: dict[str, Callable[..., str]] = {
    "short": _short,
    "breakable": _breakable,
    "prose": prose,
    "sentence": sentence,
    "anchor": _anchor,
}


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_ROOT),
        undefined=StrictUndefined,
        finalize=lambda value: printable(value) if type(value) is str else value,
        autoescape=select_autoescape(["html"], default=False),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(FILTERS)
    return environment


def render(name: str, /, **values: Any) -> str:
    """Fill in a template.

    Args:
        name: of its file, relative to `studies`: "show/page.html".
        values: by the names it uses; FILTERS are always available.

    Raises:
        jinja2.UndefinedError: a name without a value.
    """
    return _environment().get_template(name).render(values)


def page(report: Report, folder: Path | None = None) -> str:
    """A report as a self-contained web page.

    Args:
        report: what it tells.
        folder: with its figures, PNG or GIF; None: a page without images.

    Returns:
        HTML.

    Raises:
        ValueError: a figure that is not in the folder.
    """
    script = (_ROOT / "show" / "page.js").read_text(encoding="utf-8")
    about = next((x for x in report.files.values() if isinstance(x, Study)), None)
    return render(
        "show/page.html",
        report=report,
        caveat=report.caveat or GUESSED,
        script=Markup(script),
        digest=b64encode(sha256(script.encode()).digest()).decode(),
        image=lambda name, caption: _image(folder, name, caption),
        facts=config.origin() | _verified(about),
        files={title: _file(content) for title, content in report.files.items()},
    )


def write_report(report: Report, folder: Path, has_pdf: bool = False) -> None:
    """Write the figures of a report and its page into a folder.

    Raises:
        StudyError: a file cannot be written.
    """
    drawn = [part for part in report.parts if isinstance(part, Drawing)]
    drawings = {part.name: part.draw for part in drawn if part.draw}
    figures.draw(folder, drawings, has_pdf)
    (folder / REPORT).write_text(page(report, folder), encoding="utf-8")


def card(report: Report) -> str:
    """A report as a notebook shows it: its result, the first rows of its table, a small picture."""
    table = next((x for x in report.parts if isinstance(x, Rows)), Rows([], []))
    drawings = [x for x in report.parts if isinstance(x, Drawing)]
    shown = next((x for x in drawings if x.name != MACHINE), drawings[0] if drawings else None)
    image = ""
    if shown and shown.draw:
        with figures.styled():
            image = inline_image(_png(shown.draw()), shown.caption)
    rows = table.rows[:MOST]
    return render("show/card.html", report=report, image=image, heads=table.heads, rows=rows)


def _png(figure: Figure) -> bytes:
    figure.set_figwidth(min(CARD_WIDTH, figure.get_figwidth()))
    image = BytesIO()
    figure.savefig(image, format="png", dpi=CARD_DPI)
    return image.getvalue()


def _file(content: Study | str) -> tuple[str, str]:
    """What a page shows of a file, and the rest, which it folds."""
    if isinstance(content, str):
        return content, ""
    return own_text(content) or "# Every field has its default.\n", study_template(content)


def _verified(study: Study | None) -> dict[str, str]:
    """What `studies verify` found about the study of a report under the present code."""
    found = passport.find(study)
    text = found.text if found else "not with this code: `studies verify STUDY`"
    return {} if study is None else {"verified": text}


def _image(folder: Path | None, name: str, caption: str) -> Markup:
    if folder is None:
        return Markup()
    file = folder / (name if name.endswith(".gif") else f"{name}.png")
    if (fault := folder / f"{name}{FAULT}").is_file():
        return Markup("<p>{}</p>").format(fault.read_text(encoding="utf-8"))
    if not file.is_file():
        raise ValueError(f"the report shows {name!r}, which is not among its images")
    return inline_image(file.read_bytes(), caption)


def inline_image(data: bytes, caption: str) -> Markup:
    """An image inside its page.

    Args:
        data: of a PNG or GIF file.
        caption: for those who cannot see it; may have `code`.
    """
    is_png = data.startswith(b"\x89PNG")
    width = int.from_bytes(data[16:20], "big") if is_png else int.from_bytes(data[6:8], "little")
    return Markup('<img src="data:image/{};base64,{}" alt="{}"{}>').format(
        "png" if is_png else "gif",
        b64encode(data).decode(),
        plain(caption),
        Markup(' class="wide"') if width > WIDE else "",
    )
