"""Reports as web pages, and all other templates (Jinja2).

A page is one HTML file that contains its figures, the files it refers to and the versions that made
it. It runs no scripts and loads nothing, so it opens offline, in an email, and in many years.

A template is in the folder of the module that fills it: `report.html` next to `report.py`. That of
a report extends `show/page.html` with the blocks `title`, `summary` and `sections`, and writes
tables and figures with the two macros of `show/macros.html`. Whatever a value contains is shown as
text. A name without a value is an error.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from studies import config, passport
from studies.errors import printable
from studies.publish import FAULT
from studies.show.units import count_text, headed, number, span
from studies.study.entries import links_text
from studies.study.labels import describe
from studies.study.margin import GUESSED, margin_in_db, robustness_text
from studies.study.spec import Study
from studies.study.template import own_text, study_template

_ROOT = Path(__file__).parents[1]
#: Where a name in a table may go on in the next line.
_JOINT = re.compile(r"(?<=[A-Za-z][_./])(?=\w)|(?<=\w)(?=\[)")
#: Images with more pixels than this across keep a readable width on a narrow screen.
WIDE = 550


def _short(value: float, digits: int = 4) -> str:
    """A number with this many significant digits."""
    return f"{value:.{digits}g}"


def _percent(share: float, digits: int = 3) -> str:
    return f"{100 * share:.{digits}g} %"


def _change(after: float, before: float) -> str:
    """A relative change in percent."""
    return f"{100 * (after / before - 1):+.3g} %"


def _breakable(text: str) -> str:
    """A text with places to break long names, so that a table of many columns fits the page."""
    if isinstance(text, Markup):
        return text
    return Markup("<wbr>").join(_JOINT.split(text))


def _unbroken(text: str) -> Markup:
    """Keep a number and its sign on one line."""
    return Markup(re.sub(" (?=[%†])", "\N{NO-BREAK SPACE}", str(text)))


def code(text: str) -> Markup:
    """A text of this program, in which `names` stand between backticks."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _anchor(title: str) -> str:
    """Name of a section in links to it."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


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
    "margin": margin_in_db,
    "robustness": robustness_text,
    "status": describe,
    "breakable": _breakable,
    "unbroken": _unbroken,
    "code": code,
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
    environment.globals["left_out"] = GUESSED
    return environment


def render(name: str, /, **values: Any) -> str:
    """Fill in a template.

    Args:
        name: of its file, relative to `studies`: "tuning/report.html".
        values: by the names it uses; FILTERS are always available.

    Raises:
        jinja2.UndefinedError: a name without a value.
    """
    return _environment().get_template(name).render(values)


def page(
    name: str,
    folder: Path | None,
    appended: Study | Mapping[str, Study | str],
    /,
    **values: Any,
) -> str:
    """A report as a self-contained web page.

    Args:
        name: of its template.
        folder: with its figures, PNG or GIF; None: a page without images.
        appended: studies and texts to append, by title; or the study reported on. The first study
            is that whose verification counts.
        values: of the template.

    Returns:
        HTML.

    Raises:
        ValueError: a figure that is not in the folder.
    """
    titles: list[str] = []

    def section(title: str) -> Markup:
        titles.append(title)
        return Markup('<h2 id="{}">{}</h2>').format(_anchor(title), title)

    files = {"Study file": appended} if isinstance(appended, Study) else appended
    about = next((x for x in files.values() if isinstance(x, Study)), None)
    return render(
        name,
        **values,
        section=section,
        titles=titles,
        image=lambda file, caption: _image(folder, file, caption),
        facts=config.origin() | _verified(about),
        files={title: _file(content) for title, content in files.items()},
    )


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


def _image(folder: Path | None, file: str, caption: str) -> Markup:
    if folder is None:
        return Markup()
    if (fault := (folder / file).with_suffix(FAULT)).is_file():
        return Markup("<p>{}</p>").format(fault.read_text(encoding="utf-8"))
    if not (folder / file).is_file():
        raise ValueError(f"the report shows {file!r}, which is not among its images")
    return inline_image((folder / file).read_bytes(), caption)


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
        caption.replace("`", ""),
        Markup(' class="wide"') if width > WIDE else "",
    )
