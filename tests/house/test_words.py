"""The field's words in all that users read: documents, notebooks, help, messages, reports."""

from __future__ import annotations

import ast
import json
import re

import pytest
import typer

from studies.cli import app
from tests import TOP
from tests.documents import NOTEBOOKS, PAGES
from tests.house.test_house import SOURCES

DOCUMENTS = [
    *PAGES,
    *sorted((TOP / "studies").glob("*/report.html")),
    *sorted((TOP / "studies" / "specs").glob("*.toml")),
]
#: Pattern of what is not the field's word, what to write, and where the pattern finds it.
PHRASES = (
    (r"told apart|tell \w+ apart", "identifiable, distinguish", "they cannot be told\napart"),
    (r"knock(s|ed|ing)?|blows?", "impulse", "rings after a knock"),
    (r"believ(e|es|ed|ing)", "nominal model, assumed", "what it believes"),
    (r"departures?", "model mismatch", "all departures"),
    (r"study itself|study's own", "baseline", "relative to the study\nitself"),
    (r"what was asked|(?-i:Asked):|# asked|came out", "question, result", "## Asked"),
    (r"free numbers?", "parameter, design variable", "18 free numbers"),
    (r"(the|all|many|several|twelve|\d+) starts", "starting points", "all starts"),
    (r"(each|every|per) start", "starting point", "from every start"),
    (r"(the|a|an|each|this) front", "Pareto front", "along the front"),
    (r"leak(s|ed|ing|age)?", "observation spillover", "modes leak in"),
    (r"shaped command|end of the command|command's end", "reference trajectory", "shaped command"),
    (r"after the command", "after the reference trajectory, the move", "50 ms after the command"),
    (r"spoilt", "invalidated", "effects spoilt by it"),
    (r"for ever", "hangs", "it stops for ever"),
    (r"done before", "already computed", "3 done before"),
    (r"doubles left out", "duplicates", "2 doubles left out"),
    (r"an? own", "of your own", "for an own machine"),
)
ANY = re.compile(
    rf"(?<![\w-])({'|'.join(pattern for pattern, _, _ in PHRASES)})(?![\w-])", re.IGNORECASE
)
#: A document with the first also has the second.
BESIDE = {"EMC": "efficient modal control", "shortening": "geometric stiffening"}


def prose_of_template(text):
    """A template's text and the strings in its expressions, but file names."""

    def strings(found):
        kept = " ".join(x for x in re.findall(r'"([^"]*)"', found[0]) if not re.search(r"\.\w", x))
        return kept + "\n" * (found[0].count("\n") - kept.count("\n"))

    text = re.sub(r"\{[{%].*?[%}]\}", strings, text, flags=re.DOTALL)
    return re.sub(r"</?\w[^>\n]*>", "", text)


def findings(text):
    """Forbidden phrases, each with its line and what to write."""
    flat = text.replace("\n", " ")  # phrases may be broken across lines; the length stays
    if not ANY.search(flat):
        return []
    return [
        f"{text.count(chr(10), 0, found.start()) + 1}: {found[0]!r}: write {words}"
        for pattern, words, _ in PHRASES
        for found in re.finditer(rf"(?<![\w-])({pattern})(?![\w-])", flat, re.IGNORECASE)
    ]


def missing(text):
    """Words of the field that belong beside others and are not there."""
    return [f"{x!r} without {y!r}" for x, y in BESIDE.items() if x in text and not in_text(y, text)]


def in_text(words, text):
    return re.search(words.replace(" ", r"[\s-]+"), text, re.IGNORECASE)


def prose_of(tree):
    """Strings of several words, but docstrings, with their lines; fields of f-strings as {}."""
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    parts = {
        id(x) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for x in node.values
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            text = "".join(x.value if isinstance(x, ast.Constant) else "{}" for x in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value if not {id(node)} & (docstrings | parts) else ""
        else:
            continue
        if " " in text:
            yield node.lineno, text


def public_docstrings():
    """Docstrings of what `jaxmodel` and `studies` export."""
    stubs = [TOP / package / "__init__.pyi" for package in ("jaxmodel", "studies")]
    faces = [ast.parse(stub.read_text(encoding="utf-8")) for stub in stubs]
    names = {x.value for tree in faces for x in ast.walk(tree) if isinstance(x, ast.Constant)}
    for path, tree in SOURCES.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name in names:
                yield f"{path.relative_to(TOP)}: {node.name}", ast.get_docstring(node) or ""


def help_texts(command, name="studies"):
    """Help of a command, of its options, and of the commands below it."""
    yield name, command.help or ""
    for parameter in command.params:
        yield f"{name} {parameter.name}", getattr(parameter, "help", None) or ""
    for below in getattr(command, "commands", {}).values():
        yield from help_texts(below, f"{name} {below.name}")


def cells(path):
    """Texts of a notebook: markdown, and the comments and strings of its code."""
    for k, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            code = re.sub(r"^%.*", "", text, flags=re.MULTILINE)
            strings = [found for _, found in prose_of(ast.parse(code))]
            text = "\n".join([*re.findall(r"#.*", code), *strings])
        yield f"{path.name}, cell {k}", text


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(TOP)))
def test_documents_and_report_templates(path):
    text = path.read_text(encoding="utf-8")
    text = prose_of_template(text) if path.name == "report.html" else text
    assert findings(text) + missing(text) == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks(path):
    texts = dict(cells(path))
    found = [f"{where}, line {x}" for where, text in texts.items() for x in findings(text)]
    assert found + missing("\n".join(texts.values())) == []


def test_messages_labels_and_descriptions():
    found = []
    for path, tree in SOURCES.items():
        for line, text in prose_of(tree):
            found += [f"{path.relative_to(TOP)}:{line}, its line {x}" for x in findings(text)]
    assert found == []


def test_help_and_public_docstrings():
    helps = dict(help_texts(typer.main.get_command(app)))
    assert {"studies tune", "studies sweep out"} <= set(helps)
    texts = helps | dict(public_docstrings())
    assert len(texts) > len(helps) + 20
    assert [f"{where}, line {x}" for where, text in texts.items() for x in findings(text)] == []


@pytest.mark.parametrize("example", [example for _, _, example in PHRASES])
def test_planted_phrases_are_found(example):
    (found,) = findings(f"Two lines,\nthen {example}.")
    assert found.startswith("2: ")
    ((line, text),) = prose_of(ast.parse(f"raise ValueError(f'{{name}}: ' {example!r})"))
    assert line == 1 and findings(text)


def test_words_beside_others():
    assert missing("The chord's shortening: EMC") == [
        "'EMC' without 'efficient modal control'",
        "'shortening' without 'geometric stiffening'",
    ]
    assert missing("Geometric\nstiffening (shortening)") == []


def test_words_that_only_look_alike_are_left_alone():
    harmless = (
        "starts at 0; for every own run; the frontier; unbelievable; blown; in front; knockout"
    )
    assert findings(harmless) == []
