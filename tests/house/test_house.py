"""Rules of the house that no linter knows."""

from __future__ import annotations

import ast
from collections import defaultdict

from tests import TOP

SOURCES = {
    path: ast.parse(path.read_text(encoding="utf-8"))
    for package in ("jaxmodel", "studies")
    for path in sorted((TOP / package).rglob("*.py"))
}
#: Rows of tables: their columns are read by position.
ROWS = {"Variable", "Metric", "Total", "Parameter", "Target", "Table"}


def name_of(node):
    """Of what is called, or a base class."""
    return getattr(node, "id", getattr(node, "attr", ""))


def classes():
    return [node for tree in SOURCES.values() for node in ast.walk(tree) if is_class(node)]


def is_class(node):
    return isinstance(node, ast.ClassDef)


def test_a_class_name_means_one_thing():
    seen = defaultdict(int)
    for node in classes():
        seen[node.name] += 1
    assert {name for name, count in seen.items() if count > 1} == set()


def test_no_tuple_of_many_fields_is_filled_by_position():
    tuples = {node.name for node in classes() if "NamedTuple" in map(name_of, node.bases)} - ROWS
    found = [
        f"{path.relative_to(TOP)}:{node.lineno} {name_of(node.func)}"
        for path, tree in SOURCES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and name_of(node.func) in tuples
        and len(node.args) > 4
        and not any(isinstance(x, ast.Starred) for x in node.args)
    ]
    assert len(tuples) > 100 and found == []


def test_choices_from_tables_are_compared_with_their_names_nowhere_else():
    """No `law == "imsc"`: what sets an entry of a table apart stands in its table."""
    fields = ("law", "basis", "profile", "target")
    found = [
        f"{path.relative_to(TOP)}:{node.lineno}"
        for path, tree in SOURCES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Compare)
        and name_of(node.left) in fields
        and any(isinstance(x, ast.Constant) and isinstance(x.value, str) for x in node.comparators)
    ]
    assert found == []


def test_every_child_process_of_a_test_has_a_limit_of_time():
    endless = [
        f"{path.name}:{node.lineno}"
        for folder in ("tests", "docs/tests", "campaigns")
        for path in sorted((TOP / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func).split(".")[-2:]
        in (["subprocess", "run"], ["subprocess", "check_output"], ["process", "communicate"])
        and "timeout" not in {keyword.arg for keyword in node.keywords}
    ]
    assert endless == []


def test_formatting_has_no_exceptions():
    mark = "fmt: " + "skip"
    files = [
        path
        for folder in ("jaxmodel", "studies", "tests", "campaigns")
        for path in (TOP / folder).rglob("*.py")
    ]
    assert [path for path in files if mark in path.read_text(encoding="utf-8")] == []
