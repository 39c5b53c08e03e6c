"""Reports: Markdown texts, and the same as self-contained web pages.

A page is one HTML file that contains its figures, the files it refers to and the versions that made
it. It runs no scripts and loads nothing, so it opens offline, in an email, and in many years.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Mapping
from contextlib import ExitStack
from mimetypes import guess_type
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from markdown_it import MarkdownIt
from markdown_it.token import Token

from studies import config
from studies.show.markdown import literal
from studies.show.templates import render
from studies.store import replacing
from studies.study.spec import Study
from studies.study.template import study_template

_PARSER = MarkdownIt("commonmark", {"html": False, "xhtmlOut": False}).enable("table")

#: Where a name in a table may go on in the next line.
_JOINT = re.compile(r"(?<=[A-Za-z][_./])(?=\w)|(?<=\w)(?=\[)")
#: Images with more pixels than this across keep a readable width on a narrow screen.
WIDE = 550
#: Heading level of sections.
HEADING = ("heading_open", "h2")


def page(
    text: str, images: Mapping[str, bytes], files: Mapping[str, str], facts: Mapping[str, Any]
) -> str:
    """A Markdown text as a self-contained web page.

    Args:
        text: with figures in separate paragraphs (`picture`); HTML in it is shown as text.
        images: bytes of each figure, PNG or GIF, by its name in the text.
        files: texts to append, by title.
        facts: versions and the like, for a table before the files.

    Returns:
        HTML.

    Raises:
        ValueError: a figure without its image.
    """
    tokens = _arranged(_PARSER.parse(text), images)
    tokens = _with_contents(tokens, ["Versions", *files])
    body = _PARSER.renderer.render(tokens, _PARSER.options, {})
    return render(
        "show/page.html",
        title=_title(tokens),
        body=body,
        facts=facts,
        files=[(title, _anchor(title), content) for title, content in files.items()],
    )


def _with_contents(tokens: list[Token], more: list[str]) -> list[Token]:
    """Add anchors to section headings, and links to them before the first section."""
    starts = [k for k, token in enumerate(tokens) if (token.type, token.tag) == HEADING]
    if not starts:
        return tokens
    titles = [_plain(tokens[k + 1].children) for k in starts]
    for k, title in zip(starts, titles, strict=True):
        tokens[k].attrSet("id", _anchor(title))
    links = " · ".join(f"[{literal(title)}](#{_anchor(title)})" for title in [*titles, *more])
    contents = _PARSER.parse(f"{links}")
    contents[0].attrSet("class", "contents")
    return [*tokens[: starts[0]], *contents, *tokens[starts[0] :]]


def _anchor(title: str) -> str:
    """Name of a section in links to it."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _arranged(tokens: list[Token], images: Mapping[str, bytes]) -> list[Token]:
    """Put tables into scrolling boxes, and turn paragraphs with one image into figures."""
    arranged: list[Token] = []
    is_table = False
    for k, token in enumerate(tokens):
        if token.type == "table_open":
            is_table = True
            arranged.append(Token("box_open", "div", 1, {"class": "table"}, block=True))
        inside = token.children or []
        if [child.type for child in inside] == ["image"]:
            tokens[k - 1].tag = tokens[k + 1].tag = "figure"
            begin, end = (Token(f"caption_{n}", "figcaption", n) for n in (1, -1))
            token.children = [*inside, begin, *(inside[0].children or []), end]
        for child in inside:
            if child.type == "text":  # keep a number and its sign on one line
                child.content = re.sub(" (?=[%†])", "\N{NO-BREAK SPACE}", child.content)
            if child.type == "image":
                child.children = [Token("text", "", 0, content=_plain(child.children))]
                name = unquote(str(child.attrs["src"]))
                child.attrSet("src", _data_uri(name, images))
                if _is_wide(images[name]):
                    child.attrSet("class", "wide")
        arranged.append(token)
        if is_table and token.children:
            token.children = [part for child in token.children for part in _breakable(child)]
        if token.type == "table_close":
            is_table = False
            arranged.append(Token("box_close", "div", -1, block=True))
    return arranged


def _breakable(token: Token) -> list[Token]:
    """A text with places to break long names, so that a table of many columns fits the page."""
    if token.type != "text":
        return [token]
    parts = [Token("text", "", 0, content=part) for part in _JOINT.split(token.content)]
    wbr = Token("html_inline", "", 0, content="<wbr>")
    return [parts[0], *(x for part in parts[1:] for x in (wbr, part))]


def _is_wide(image: bytes) -> bool:
    """Whether an image is as wide as a page: too small to read if a narrow screen shrinks it."""
    is_png = image.startswith(b"\x89PNG")
    width = int.from_bytes(image[16:20], "big") if is_png else int.from_bytes(image[6:8], "little")
    return width > WIDE


def _data_uri(name: str, images: Mapping[str, bytes]) -> str:
    if name not in images:
        raise ValueError(f"the report shows {name!r}, which is not among its images")
    kind = guess_type(name)[0] or "image/png"
    return f"data:{kind};base64,{b64encode(images[name]).decode()}"


def _title(tokens: list[Token]) -> str:
    """Text of the first heading."""
    for k, token in enumerate(tokens):
        if token.type == "heading_open":
            return _plain(tokens[k + 1].children)
    return "report"


def _plain(inline: list[Token] | None) -> str:
    """Text without markup, for places that accept nothing else."""
    return "".join(token.content for token in inline or [])


def report_files(
    folder: Path, text: str, study: Study | Mapping[str, str], name: str = "report"
) -> dict[str, str]:
    """What `write_report` writes: contents by file name.

    Args:
        folder: where the figures of the text are.
        text: Markdown.
        study: the study reported on, or the files to append, by title.
        name: of the files.

    Raises:
        ValueError: a figure that is not in the folder.
    """
    children = (child for token in _PARSER.parse(text) for child in token.children or [])
    names = {unquote(str(child.attrs["src"])) for child in children if child.type == "image"}
    images = {file: (folder / file).read_bytes() for file in names if (folder / file).is_file()}
    files = {"Study file": study_template(study)} if isinstance(study, Study) else study
    html = page(text, images, files, config.origin())
    return {f"{name}.md": text, f"{name}.html": html}


def write_report(
    folder: Path, text: str, study: Study | Mapping[str, str], name: str = "report"
) -> None:
    """Write a report as Markdown and as a web page, both or neither.

    Args:
        folder: where to write, and where the figures of the text are.
        text: Markdown.
        study: the study reported on, or the files to append, by title.
        name: of the files.

    Raises:
        StudyError: a file cannot be written.
        ValueError: a figure that is not in the folder.
    """
    with ExitStack() as stack:
        for file, content in report_files(folder, text, study, name).items():
            stack.enter_context(replacing(folder / file)).write_text(content, encoding="utf-8")
