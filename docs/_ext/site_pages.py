"""Parts of the site that follow from the program: members of tuples, `llms.txt`, the root."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from jupyter_cache import get_cache
from reference import members_text
from sphinx.application import Sphinx

#: Inline formulas with more characters than this get a box of their own.
LONG = 40
REDIRECT = '<!DOCTYPE html><meta http-equiv="refresh" content="0; url={}"><title>{}</title>\n'


def spread_notebooks(app: Sphinx, env: Any, names: list[str]) -> None:
    """Read notebooks, which run, apart from each other: neighbours are read by one process."""
    notebooks = [name for name in names if name.startswith("notebooks/")]
    others = [name for name in names if name not in notebooks]
    step = max(1, len(others) // max(1, len(notebooks)))
    for k, name in enumerate(notebooks):
        others.insert(k * (step + 1), name)
    names[:] = others
    get_cache(env.mystnb_config.execution_cache_path).get_cache_limit()  # or readers race for it


def add_members(
    app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]
) -> None:
    """Add to the docstring of a tuple what the comments beside its members say."""
    lines[:] = [line.replace("|", "\\|") for line in lines]  # absolute values, no substitutions
    if what == "class" and hasattr(found, "_fields"):
        for member, text in members_text(inspect.getsource(found)).items():
            safe = re.sub(r"([*|_\\])", r"\\\1", text)
            lines += ["", f"- ``{member}``: {safe}"]
        lines.append("")


def shorten(app: Sphinx, what: str, name: str, found: Any, *rest: Any) -> tuple[str, str] | None:
    """The arguments of a study are its sections, which the field reference has."""
    return ("(**sections)", "") if what == "class" and hasattr(found, "model_fields") else None


def leave_out(
    app: Sphinx, what: str, name: str, found: Any, skip: bool, options: Any
) -> bool | None:
    """Members of tuples have no docstrings of their own."""
    return True if type(found).__name__ == "_tuplegetter" else None


def show_math(translator: Any, node: nodes.Element) -> None:
    """A formula as MathML, which browsers show without a script."""
    is_block = isinstance(node, nodes.math_block)
    text = tex2mathml(node.astext(), as_block=is_block)
    text = text.replace("<mo>'</mo>", "<mo>\u2032</mo>")
    if is_block:
        text = f'<div class="formula">{text}</div>'
    elif len(node.astext()) > LONG:  # a line may be shorter, and formulas do not break
        text = f'<span class="formula">{text}</span>'
    translator.body.append(text)
    raise nodes.SkipNode


def write_root(app: Sphinx, error: Exception | None) -> None:
    """Write `index.html`, which leads to the start page, and `llms.txt`, a list of all pages."""
    if error or app.builder.format != "html":
        return
    start = app.builder.get_target_uri(app.config.root_doc)
    out = Path(app.outdir)
    (out / "index.html").write_text(REDIRECT.format(start, app.config.project), encoding="utf-8")
    names = [app.config.root_doc, *app.env.toctree_includes[app.config.root_doc]]
    lines = [_line(app, name) for name in names]
    (out / "llms.txt").write_text("\n".join([f"# {app.config.project}", "", *lines, ""]), "utf-8")


def _line(app: Sphinx, name: str) -> str:
    """Title, address and first paragraph of a page."""
    title = app.env.titles[name].astext()
    first = next(app.env.get_doctree(name).findall(nodes.paragraph), None)
    text = " ".join(first.astext().split()) if first else ""
    return f"- [{title}]({app.builder.get_target_uri(name)}): {text}"


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_html_math_renderer("mathml", (show_math, None), (show_math, None))
    app.connect("env-before-read-docs", spread_notebooks)
    app.connect("autodoc-process-docstring", add_members)
    app.connect("autodoc-process-signature", shorten)
    app.connect("autodoc-skip-member", leave_out)
    app.connect("build-finished", write_root)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
