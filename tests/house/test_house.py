"""Rules of the house that no linter knows."""

from __future__ import annotations

import ast
import inspect
from collections import defaultdict

import pytest
import typer

from studies import cli
from studies.commands import documented
from studies.errors import StudyError
from studies.job import KINDS
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


# --- verbs ----------------------------------------------------------------------------------------

#: All but `bench`, which needs neither a study nor a folder.
VERBS = {verb.__name__: verb for verb in cli.VERBS if verb.__name__ != "bench"}
#: What one verb calls otherwise than another: its own kind of file; the margin of a gain or a disk.
OWN = {"what", "margin"}


def arguments(verb):
    return inspect.signature(verb).parameters.values()


@pytest.mark.parametrize("name", VERBS)
def test_verbs_take_their_arguments_in_one_order(name):
    first, second, *options = arguments(VERBS[name])
    assert (first.name, second.name, second.default) == ("what", "out", None)
    assert {first.kind, second.kind} == {inspect.Parameter.POSITIONAL_OR_KEYWORD}
    assert {x.kind for x in options} == {inspect.Parameter.KEYWORD_ONLY}
    names = [x.name for x in (first, second, *options)]
    assert name not in KINDS or names[-2:] == ["resume", "progress"]
    about, texts = documented(VERBS[name])
    assert about and sorted(texts) == sorted(names) and all(texts.values())


def test_work_that_is_resumed_has_a_verb_of_that_name():
    assert VERBS.keys() >= KINDS.keys()
    assert {name for name, x in VERBS.items() if "resume" in documented(x)[1]} == KINDS.keys()


def test_an_option_is_the_same_wherever_it_stands():
    found = defaultdict(set)
    for verb in VERBS.values():
        for x in arguments(verb):
            found[x.name].add((x.default, x.annotation))
    assert {name for name, kinds in found.items() if len(kinds) > 1} == OWN


@pytest.mark.parametrize("verb", cli.VERBS, ids=lambda verb: verb.__name__)
def test_a_command_has_the_options_of_its_verb(verb):
    command = typer.main.get_command(cli.app).commands[verb.__name__]
    names = [x.name for x in arguments(verb)] + ["precision"] * cli.VERBS[verb] + ["as_json"]
    assert [x.name for x in command.params] == names
    for x in command.params:
        flag = "--json" if x.name == "as_json" else f"--{x.name.replace('_', '-')}"
        assert x.opts == (["what"] if x.name == "what" else [flag]), x.name
        assert x.secondary_opts in ([], [flag.replace("--", "--no-")])


@pytest.mark.parametrize("name", VERBS)
def test_verbs_refuse_arguments_of_another_type_before_any_work(name, tmp_path):
    """In Python; the command line has read them by then."""
    verb, strange = VERBS[name], object()
    plain = [
        x
        for x in arguments(verb)
        if x.annotation.split(" | ")[0] in ("str", "bool", "int", "float")
    ]
    assert plain
    for x in plain:
        given = {"what": "paper", "out": tmp_path / "out"} | {x.name: strange}
        with pytest.raises(
            StudyError, match=f"^(WHAT|--{x.name.replace('_', '-')}) = .*; allowed: "
        ):
            verb(**given)
        if "float" in x.annotation:
            with pytest.raises(StudyError, match="= nan; allowed: a finite number"):
                verb(**given | {x.name: float("nan")})
    with pytest.raises(StudyError, match="--out = 3; allowed: a text or a path"):
        verb("paper", 3)
    assert not (tmp_path / "out").exists()
