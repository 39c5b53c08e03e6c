"""Mutants: what they change, which tests judge them, and what became of them."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from itertools import islice

import pytest

from campaigns.mutants import (
    BY_HAND,
    Mutant,
    Verdict,
    lines_of_code,
    located,
    mutants,
    mutated,
    plan,
    read,
    relocated,
    sample,
    statements,
)
from campaigns.reach import PACKAGES, Seen
from tests import TOP

RECORD = TOP / "campaigns" / "mutants.tsv"
SOURCES = {
    path.relative_to(TOP).as_posix(): path.read_text(encoding="utf-8")
    for package in PACKAGES
    for path in sorted((TOP / package).rglob("*.py"))
}


def campaign(work, tests, count, *options, limit):
    """Map tests, judge mutants by them, and read the record; in a process without JAX."""
    record = work / "record.tsv"
    for command in (
        ("map", work, *tests),
        ("run", work, record, "--count", count, "--budget", 20, *options),
    ):
        subprocess.run(
            [sys.executable, "-m", "campaigns.mutants", *map(str, command)],
            cwd=TOP,
            check=True,
            timeout=limit,
        )
    return read(record)


@pytest.mark.parametrize(
    ("source", "changed"),
    [
        ("a + b", {"a - b"}),
        ("(a) * (b)", {"(a) / (b)"}),
        ("a @ b", {"a @ - b"}),
        ("a < b", {"a <= b", "a >= b"}),
        ("a is None", {"a is not None"}),
        ("a and b", {"a or b"}),
        ("-a", {"a"}),
        ("not a", {"a"}),
        ("f(x, y)", {"f(y, x)"}),
        ("jnp.sin(x)", {"jnp.cos(x)"}),
        ("0.5", {"1.0"}),
        ("0.0", {"1.0"}),
        ("7", {"8"}),
        ("True", {"False"}),
        ("b if a else c", {"b if not (a) else c"}),
        ("[a for a in b if c]", {"[a for a in b if not (c)]"}),
        ("hypot(x, y)", set()),
        ("f('text', 'x')", set()),
        ("f'{1 + 2}'", set()),
        ("f(strict=True)", set()),
        ("x", set()),
    ],
)
def test_changes_of_an_expression(source, changed):
    text = f"é = {source}\n"
    assert {mutated(text, x) for x in mutants(text)} == {f"é = {x}\n" for x in changed}


@pytest.mark.parametrize(
    ("statement", "changed"),
    [
        ("while a:\n        f()", {"while not (a):\n        f()", "while a:\n        pass"}),
        ("x += a", {"pass"}),
        ("raise ValueError(f(1, 2), '3' + x)", {"pass"}),
        ("x: Array | None = 1", {"x: Array | None = 2"}),
        ("assert a < 1", set()),
        ('"""Text 1 + 1."""', set()),
        ("if TYPE_CHECKING:\n        x = 1", set()),
    ],
)
def test_changes_of_a_statement(statement, changed):
    text = f"@f(1)\ndef g(x: a + b) -> c + d:\n    {statement}\n"
    found = {mutated(text, x) for x in mutants(text)}
    assert found == {text.replace(statement, x) for x in changed}


def test_every_mutant_is_another_program():
    for mutant in islice(sample(SOURCES, seed=0), 80):
        source = SOURCES[mutant.file]
        assert ast.dump(ast.parse(mutated(source, mutant))) != ast.dump(ast.parse(source)), mutant


def test_a_sample_is_spread_in_proportion_to_lines_and_grows():
    drawn = list(islice(sample(SOURCES, seed=1), 300))
    assert len({x[:4] for x in drawn}) == 300 and drawn != list(islice(sample(SOURCES, 2), 300))
    assert drawn[:40] == list(islice(sample(SOURCES, seed=1), 40))
    count = Counter(x.file for x in drawn)
    size = {file: lines_of_code(source) for file, source in SOURCES.items()}
    share = 300 / sum(size.values())
    large = [file for file in SOURCES if share * size[file] > 1]
    assert len(large) > 60 and all(abs(count[x] - share * size[x]) < 1.5 for x in large)


def test_a_mutant_is_judged_by_tests_that_execute_its_statement():
    text = "A = 1\n\n\ndef f(x=2):\n    if x:\n        return x + 3\n    return 4\n"
    lines = {x.before: statements(text, x) for x in mutants(text)}
    assert lines == {"1": {5, 6, 7}, "2": {5, 6, 7}, "x": {5}, "+": {6}, "3": {6}, "4": {7}}
    beam, observers, machines = (
        f"tests/jaxmodel/test_{x}.py" for x in ("beam", "observers", "machines")
    )
    file = "jaxmodel/beam.py"
    seen = {
        beam: {"slow": Seen(9.0, True, {file: [5, 6]})},
        observers: {
            "quick": Seen(0.1, True, {file: [6]}),
            "failed": Seen(0.1, False, {file: [6]}),
            "elsewhere": Seen(0.1, True, {file: [7], "jaxmodel/loop.py": [6]}),
        },
        machines: {"quick": Seen(0.2, True, {file: [6]})},
    }
    mutant = Mutant(file, 6, 0, "", "", "")
    first, slow = {machines: ["quick"], observers: ["quick"]}, {beam: ["slow"]}
    assert plan(seen, mutant, {6}, 10.0) == [first, {}, slow]
    # those about the module come first, and what is too slow for the rest of the budget is left out
    assert plan(seen, mutant, {6}, 9.0) == [first, {}, {}]
    assert plan(seen, mutant, {6}, 0.25) == [{machines: ["quick"]}, {}, {}]
    assert plan(seen, mutant, {6}, 1.0, {"quick"}) == [{}, {}, slow]


def test_a_mutant_of_the_record_is_found_where_its_line_is_now():
    text = "def f(x):\n    y = x + 1\n    return y - x + 2\n"
    (drawn,) = (x for x in mutants(text, "f.py") if (x.line, x.before) == (3, "+"))
    later = "A = 1\n\n\n" + text
    found = located(later, drawn, "return y - x + 2")
    assert (found.line, mutated(later, found)) == (6, later.replace("+ 2", "- 2"))
    assert located(text.replace("+ 2", "+ 3"), drawn, "return y - x + 2") is None
    by_hand = Mutant("f.py", 2, 8, BY_HAND, "x + 1", "1")
    found = located(later, by_hand, "y = x + 1")
    assert mutated(later, found) == later.replace("x + 1", "1")
    killed = Verdict("killed", "a test", 1, 1.0, "return y - x + 2")
    moved = relocated({drawn: killed}, {"f.py": later})
    assert moved == {drawn._replace(line=6): killed}
    assert relocated({drawn: killed}, {"f.py": ""}) == {drawn: killed}


def test_mutants_in_short(tmp_path):
    """Of one module, judged by its own tests."""
    tests = ["tests/jaxmodel/test_controller.py"]
    found = campaign(tmp_path, tests, 3, "--of", "jaxmodel/controller.py", limit=240)
    assert len(found) == 3


@pytest.mark.parametrize("package", PACKAGES)
def test_most_mutants_of_the_record_are_killed(package):
    """Survivors that few tests have judged yet included."""
    rows = {x: verdict for x, verdict in read(RECORD).items() if x.file.startswith(package)}
    count = Counter(verdict.outcome for verdict in rows.values())
    assert set(count) <= {"killed", "survived", "equivalent"}
    assert all(x.by for x in rows.values() if x.outcome in ("killed", "equivalent"))
    assert len(rows) >= 300 and count["killed"] >= 0.9 * (len(rows) - count["equivalent"])


def test_every_large_module_of_the_physics_has_mutants():
    rows = read(RECORD)
    texts = {x: y for x, y in SOURCES.items() if x.startswith("jaxmodel/")}
    large = {file for file, text in texts.items() if lines_of_code(text) >= 100}
    assert large <= {mutant.file for mutant in rows}


@pytest.mark.long
def test_mutants_at_length(tmp_path):
    tests = [f"tests/jaxmodel/test_{name}.py" for name in ("shaper", "motion", "beam")]
    files = [f"jaxmodel/{name}.py" for name in ("shaper", "motion", "beam", "trigonometry")]
    found = campaign(tmp_path, tests, 20, "--of", *files, limit=1800)
    count = Counter(verdict.outcome for verdict in found.values())
    assert len(found) >= 15 and count["killed"] >= 0.7 * len(found)
