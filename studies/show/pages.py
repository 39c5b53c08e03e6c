"""Reports: Markdown texts, and the same as web pages that need nothing else.

A page is one HTML file with its figures inside, the files it speaks of and the versions that made
it. It runs no script and loads nothing, so it opens offline, in a mail, and in many years.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from html import escape
from mimetypes import guess_type
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from markdown_it import MarkdownIt
from markdown_it.token import Token

from studies import config
from studies.store import replacing
from studies.study.spec import Study
from studies.study.template import study_template

_PARSER = MarkdownIt("commonmark", {"html": False, "xhtmlOut": False}).enable("table")
#: What Markdown takes for a mark wherever it stands (not [ alone, or _ inside a word).
_MARKS = re.compile(
    r"[\\`*|#]|<(?=[A-Za-z/!?])|&(?=[#\w])|\](?=[(\[:])|(?<!\w)_|_(?!\w)",
)
#: What it takes for one at the begin of a line.
_FIRST_MARKS = re.compile(r"^(\d*)([-+.)](?=\s|$)|[>=~]|--)")

#: What sections begin with.
HEADING = ("heading_open", "h2")

STYLE = """
:root { color-scheme: light; }
body {
  margin: 2rem auto; padding: 0 1.5rem; max-width: 72rem; background: #fff; color: #1a1a1a;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
h1, h2, h3 { line-height: 1.25; margin: 2rem 0 0.75rem; break-after: avoid; }
h1 { font-size: 1.75rem; margin-top: 0; }
h2 { font-size: 1.3rem; padding-bottom: 0.2rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1.1rem; }
p, ul, ol { max-width: 48rem; overflow-wrap: break-word; }
.contents { padding: 0.5rem 0; border-top: 1px solid #ccc; font-size: 0.9rem; line-height: 1.9; }
.contents a { white-space: nowrap; }
a { color: #0b3c6f; }
.table { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: 0.875rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.6rem; border-bottom: 1px solid #ddd; text-align: left; }
th { vertical-align: bottom; }
td, tbody th { vertical-align: top; }
thead th { border-bottom: 2px solid #888; }
tbody th { font-weight: normal; }
figure { margin: 1.5rem 0; max-width: 60rem; }
img { display: block; max-width: 100%; height: auto; }
figcaption { margin-top: 0.4rem; font-size: 0.9rem; color: #444; }
code, pre { font-family: ui-monospace, Menlo, Consolas, "DejaVu Sans Mono", monospace; }
code { font-size: 0.9em; }
pre { padding: 0.75rem; overflow-x: auto; background: #f6f6f6; font-size: 0.8rem; }
pre code { font-size: inherit; }
@page { margin: 16mm 14mm; }
@media print {
  body { margin: 0; padding: 0; max-width: none; font-size: 10pt; }
  p, ul, ol, figure { max-width: none; }
  p, li { orphans: 3; widows: 3; }
  a { color: inherit; text-decoration: none; }
  .contents { display: none; }
  .table { overflow: visible; }
  table { font-size: 7.5pt; }
  th, td { padding: 0.15rem 0.3rem; overflow-wrap: break-word; }
  thead { display: table-header-group; }
  tr, figure { break-inside: avoid; }
  tr:first-child { break-after: avoid; }
  tr:last-child { break-before: avoid; }
  figure { margin: 3mm 0; }
  img { max-height: 110mm; }
  pre { padding: 0; overflow: visible; background: none; font-size: 7.5pt; white-space: pre-wrap;
    overflow-wrap: anywhere; }
}
"""


def literal(text: str) -> str:
    """A user's text, such as a title, as Markdown shows it unchanged, on one line."""
    line = " ".join(text.split())
    return _FIRST_MARKS.sub(r"\1\\\2", _MARKS.sub(r"\\\g<0>", line))


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a Markdown table."""
    names = list(header)
    return [_row(names), _row(["---"] * len(names)), *(_row(row) for row in rows)]


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def opening(asked: str, found: str, following: str) -> list[str]:
    """First lines of a report: what was asked, what came out, what to do next; Markdown."""
    parts = (("Asked", asked), ("Came out", found), ("Next", following))
    return [line for head, text in parts for line in (f"**{head}:** {text}", "")]


def picture(name: str, caption: str) -> str:
    """Line of a figure, to stand alone.

    Args:
        name: of its PNG or GIF file, which lies beside the text.
        caption: Markdown.
    """
    return f"![{caption}]({quote(name)})"


def page(
    text: str, images: Mapping[str, bytes], files: Mapping[str, str], facts: Mapping[str, Any]
) -> str:
    """A Markdown text as a self-contained web page.

    Args:
        text: with figures in paragraphs of their own (`picture`); HTML in it is shown, not obeyed.
        images: bytes of each figure, PNG or GIF, by the name it has in the text.
        files: texts to append, by title.
        facts: versions and the like, for a table before them.

    Returns:
        HTML.

    Raises:
        ValueError: a figure without its image.
    """
    tokens = _arranged(_PARSER.parse(text), images)
    tokens = _with_contents(tokens, ["Versions", *files])
    body = _PARSER.renderer.render(tokens, _PARSER.options, {})
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(str(value))}</td></tr>\n'
        for name, value in facts.items()
    )
    appended = "".join(
        f'<h2 id="{_anchor(title)}">{escape(title)}</h2>\n'
        f"<pre><code>{escape(content)}</code></pre>\n"
        for title, content in files.items()
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(_title(tokens))}</title>\n<style>{STYLE}</style>\n</head>\n"
        f'<body>\n<main>\n{body}<h2 id="versions">Versions</h2>\n'
        f'<div class="table">\n<table>\n<tbody>\n{rows}</tbody>\n</table>\n</div>\n{appended}'
        "</main>\n</body>\n</html>\n"
    )


def _with_contents(tokens: list[Token], more: list[str]) -> list[Token]:
    """The same with anchors at the headings of sections, and links to them before the first."""
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
    """The same with tables in boxes that scroll, and paragraphs of one image as figures."""
    arranged: list[Token] = []
    for k, token in enumerate(tokens):
        if token.type == "table_open":
            arranged.append(Token("box_open", "div", 1, {"class": "table"}, block=True))
        inside = token.children or []
        if [child.type for child in inside] == ["image"]:
            tokens[k - 1].tag = tokens[k + 1].tag = "figure"
            begin, end = (Token(f"caption_{n}", "figcaption", n) for n in (1, -1))
            token.children = [*inside, begin, *(inside[0].children or []), end]
        for child in inside:
            if child.type == "text":  # a number and its sign stay on one line
                child.content = re.sub(" (?=[%†])", "\N{NO-BREAK SPACE}", child.content)
            if child.type == "image":
                child.children = [Token("text", "", 0, content=_plain(child.children))]
                child.attrSet("src", _data_uri(unquote(str(child.attrs["src"])), images))
        arranged.append(token)
        if token.type == "table_close":
            arranged.append(Token("box_close", "div", -1, block=True))
    return arranged


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
    """Text without marks, for places that take nothing else."""
    return "".join(token.content for token in inline or [])


def report_files(
    folder: Path, text: str, study: Study | Mapping[str, str], name: str = "report"
) -> dict[str, str]:
    """What `write_report` writes: contents by file name.

    Args:
        folder: where the figures of the text are.
        text: Markdown.
        study: whose report it is, or the files to append, by title.
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
        study: whose report it is, or the files to append, by title.
        name: of the files.

    Raises:
        StudyError: a file cannot be written.
        ValueError: a figure that is not in the folder.
    """
    with ExitStack() as stack:
        for file, content in report_files(folder, text, study, name).items():
            stack.enter_context(replacing(folder / file)).write_text(content, encoding="utf-8")
