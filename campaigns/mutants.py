"""Mutation testing: small faults put into the packages, one at a time; does a quick test fail?

    python -m campaigns.mutants map WORK [FILE ...]
    python -m campaigns.mutants run WORK RECORD --count 300 [--of studies/fitting]
    python -m campaigns.mutants check WORK RECORD [--of ...]

`map` runs the quick tests, or the files named, and notes which statements each executes and how
long it takes. `run` draws mutants, spread over the modules in proportion to their lines of code,
and runs on each the tests that execute its statement, those about its module and quick ones first,
until one fails or those within the budget have passed; mutants that the record holds as `waiting`,
made by hand, are judged first. `check` judges those that were killed once more, each by the test
that killed it and then, where WORK has a map, by others. WORK holds a copy of the checkout as it
was at first; begin a new one after a change. The record is a table of one line per mutant; what it
holds is not computed anew, but for survivors that more tests within the budget could judge. Its
column `code` finds the line again where lines before it have come or gone.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import csv
import json
import multiprocessing
import os
from bisect import bisect
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from campaigns import reach
from campaigns.reach import PACKAGES, Ended, Seen
from tests import TOP

#: In place of an operator: any change within a line, thought out by a person.
BY_HAND = "by hand"
#: Tests of the text of the sources, which any change could fail.
OF_TEXT = tuple(f"tests/house/test_{x}.py" for x in ("house", "words", "sizes", "package"))
#: What takes the place of an operator.
OPERATORS: dict[type[ast.AST], tuple[str, ...]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "//"),
    ast.Pow: ("**", "*"),
    ast.MatMult: ("@", "@ -"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.Lt: ("<", "<=", ">="),
    ast.LtE: ("<=", "<", ">"),
    ast.Gt: (">", ">=", "<="),
    ast.GtE: (">=", ">", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}
_PAIRS = (
    *("sin cos", "min max", "minimum maximum", "any all", "argmin argmax", "floor ceil"),
    *("zeros ones", "real imag", "zeros_like ones_like", "sinh cosh", "amin amax", "sum prod"),
)
#: What takes the place of a function.
FUNCTIONS = {x: y for pair in _PAIRS for x, y in (pair.split(), reversed(pair.split()))}
#: Functions whose first two arguments may change places.
SYMMETRIC = {"maximum", "minimum", "max", "min", "hypot"}
#: Rounds of tests: the longest of each [s].
ROUNDS = (1.0, 4.0, float("inf"))
#: Processor time beyond what the tests take by themselves [s], and the factor on that.
GRACE, SLACK = 60.0, 4.0
#: Processor time for all tests of a file [s].
MAP_LIMIT = 900.0


#: Tests by file, one round after another.
Rounds = list[dict[str, list[str] | None]]


class Mutant(NamedTuple):
    """One change of the code."""

    file: str  # in the checkout
    line: int
    column: int
    operator: str
    before: str
    after: str


class Verdict(NamedTuple):
    """What became of a mutant; a line of the record, after the mutant."""

    outcome: str  # killed, survived or, by hand, waiting or equivalent
    by: str  # the test that failed, or why the mutant is equivalent
    tests: int  # that have judged it
    seconds: float  # of processor time
    code: str  # the line without the change


# Mutants


def mutants(source: str, file: str = "") -> list[Mutant]:
    """All mutants of a module, in the order of its text."""
    finder = _Finder(source, file)
    finder.visit(ast.parse(source))
    return sorted(set(finder.found))


def mutated(source: str, mutant: Mutant) -> str:
    """The module with the change."""
    lines = source.encode().splitlines(keepends=True)
    start = sum(map(len, lines[: mutant.line - 1])) + mutant.column
    text = source.encode()
    before = mutant.before.encode()
    assert text[start : start + len(before)] == before
    return (text[:start] + mutant.after.encode() + text[start + len(before) :]).decode()


class _Finder(ast.NodeVisitor):
    """Collects mutants, except in annotations, texts, raised errors, decorators and assertions."""

    def __init__(self, source: str, file: str) -> None:
        self._text, self._file = source.encode(), file
        lines = self._text.splitlines(keepends=True)
        self._starts = [sum(map(len, lines[:k])) for k in range(len(lines) + 1)]
        self._is_in_function = False
        self.found: list[Mutant] = []

    def _span(self, node: Any) -> tuple[int, int]:
        return (
            self._starts[node.lineno - 1] + node.col_offset,
            self._starts[node.end_lineno - 1] + node.end_col_offset,
        )

    def _add(self, operator: str, start: int, end: int, after: str) -> None:
        line = bisect(self._starts, start)
        before = self._text[start:end].decode()
        column = start - self._starts[line - 1]
        self.found.append(Mutant(self._file, line, column, operator, before, after))

    def _replace(self, operator: str, node: ast.AST, after: str) -> None:
        self._add(operator, *self._span(node), after)

    def _source(self, node: ast.AST) -> str:
        start, end = self._span(node)
        return self._text[start:end].decode()

    def _exchange(self, operator: ast.AST, left: ast.AST, right: ast.AST) -> None:
        """The operator between two operands; there are but brackets and spaces beside it."""
        before, *others = OPERATORS.get(type(operator), ("",))
        gap = self._span(left)[1], self._span(right)[0]
        at = self._text.find(before.encode(), *gap)
        for after in others:
            self._add("operator", at, at + len(before), after)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        is_of_types = isinstance(node.op, ast.BitOr) and not self._is_in_function
        if not is_of_types:
            self._exchange(node.op, node.left, node.right)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        operands = [node.left, *node.comparators]
        for operator, left, right in zip(node.ops, operands, operands[1:], strict=False):
            self._exchange(operator, left, right)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._exchange(node.op, *node.values[:2])
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub | ast.Not | ast.Invert):
            name = "sign" if isinstance(node.op, ast.USub) else "condition"
            self._replace(name, node, self._source(node.operand))
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._replace("constant", node, str(not value))
        elif isinstance(value, int):
            self._replace("number", node, str(value + 1))
        elif isinstance(value, float | complex):
            self._replace("number", node, repr(2 * value or 1.0))

    def visit_Call(self, node: ast.Call) -> None:
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if len(node.args) > 1 and name not in SYMMETRIC:
            self._swap(*node.args[:2])
        if name in FUNCTIONS:
            end = self._span(node.func)[1]
            self._add("function", end - len(name), end, FUNCTIONS[name])
        self.generic_visit(node)

    def _swap(self, left: ast.expr, right: ast.expr) -> None:
        first, second = self._source(left), self._source(right)
        is_text = any(isinstance(getattr(x, "value", None), str) for x in (left, right))
        if not is_text and not isinstance(left, ast.Starred) and first != second:
            between = self._text[self._span(left)[1] : self._span(right)[0]].decode()
            start, end = self._span(left)[0], self._span(right)[1]
            self._add("arguments", start, end, f"{second}{between}{first}")

    def _condition(self, node: Any) -> None:
        if "TYPE_CHECKING" not in ast.unparse(node.test):
            self._replace("condition", node.test, f"not ({self._source(node.test)})")
            self.generic_visit(node)

    visit_If = visit_While = visit_IfExp = _condition  # noqa: N815

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for condition in node.ifs:
            self._replace("condition", condition, f"not ({self._source(condition)})")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):  # a docstring
            self._replace("statement", node, "pass")
            self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._replace("statement", node, "pass")
        self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        self._replace("statement", node, "pass")

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer, self._is_in_function = self._is_in_function, True
        for part in (*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body):
            self.visit(part)
        self._is_in_function = outer

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value:
            self.visit(node.value)

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg != "strict":  # of zip: an assertion
            self.visit(node.value)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Texts stay."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """What tests cannot fail by."""


def lines_of_code(source: str) -> int:
    """Without blank lines, comments and docstrings."""
    texts = {
        line
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    lines = enumerate(source.splitlines(), start=1)
    return sum(k not in texts and line.strip()[:1] not in ("", "#") for k, line in lines)


def sample(sources: dict[str, str], seed: int) -> Iterator[Mutant]:
    """Mutants, each of the module that lags furthest behind its share of the lines of code.

    sources: by file. Of each place, one mutant at most. A change of the code leaves those drawn
    elsewhere.
    """
    waiting = {file: _drawn(source, file, seed) for file, source in sources.items()}
    size = {file: lines_of_code(sources[file]) for file in sources if waiting[file]}
    drawn = dict.fromkeys(size, 0)
    while size:
        total = sum(drawn.values()) + 1
        file = max(size, key=lambda x: total * size[x] / sum(size.values()) - drawn[x])
        yield waiting[file].pop()
        drawn[file] += 1
        if not waiting[file]:
            del size[file], drawn[file]


def _drawn(source: str, file: str, seed: int) -> list[Mutant]:
    """The mutants of a module by a hash of their text, one for each place."""
    lines = source.splitlines()

    def rank(mutant: Mutant) -> bytes:
        return sha256(repr((seed, lines[mutant.line - 1], mutant[2:])).encode()).digest()

    places = {mutant[1:4]: mutant for mutant in sorted(mutants(source, file), key=rank)}
    return list(places.values())


# Tests of a mutant


def statements(source: str, mutant: Mutant) -> set[int]:
    """Lines of the statements one of which a test should execute to notice the mutant.

    The statement itself in a function; the whole function for a default, otherwise the module.
    """
    tree, place = ast.parse(source), (mutant.line, mutant.column)
    around = [
        node
        for node in ast.walk(tree)  # outer ones first
        if isinstance(node, ast.stmt) and _begin(node) <= place < _end(node)
    ]
    functions = [node for node in around if isinstance(node, ast.FunctionDef)]
    if functions and functions[0] is not around[-1]:
        return {around[-1].lineno}
    wider = functions[0] if functions else tree
    inner = [x for node in ast.walk(wider) if isinstance(node, ast.FunctionDef) for x in node.body]
    return {x.lineno for node in inner for x in ast.walk(node) if isinstance(x, ast.stmt)}


def _begin(node: ast.stmt) -> tuple[int, int]:
    return node.lineno, node.col_offset


def _end(node: ast.stmt) -> tuple[int, int]:
    return node.end_lineno or 0, node.end_col_offset or 0


def plan(
    seen: dict[str, dict[str, Seen]],
    mutant: Mutant,
    lines: set[int],
    budget: float,
    passed: Iterable[str] = (),
) -> Rounds:
    """Rounds of tests that execute one of the lines, as many as the budget allows.

    Those of files about the module itself come first, then the quickest; one that is too slow for
    what is left is passed over. Where no test executes any, as of a table that is made on import,
    those about the module do instead, or any.

    Args:
        seen: tests by file.
        budget: processor time that they take without mutants [s].
        passed: left out.
    """
    direct = _direct(mutant.file, seen)
    every = [
        (
            file not in direct,
            test.seconds,
            file,
            node,
            lines & {*test.statements.get(mutant.file, ())},
        )
        for file, tests in seen.items()
        for node, test in tests.items()
        if test.passed
    ]
    able = [x for x in every if x[-1]] or [x for x in every if not x[0]] or every
    rounds: Rounds = [{} for _ in ROUNDS]
    for _, seconds, file, node, _ in sorted(able, key=lambda x: x[:4]):
        if node in passed or (seconds > budget and any(rounds)):  # one at least
            continue
        budget -= seconds
        place = next(k for k, longest in enumerate(ROUNDS) if seconds <= longest)
        nodes = rounds[place].setdefault(file, [])
        assert nodes is not None
        nodes.append(node)
    return rounds


def _direct(file: str, tests: Iterable[str]) -> set[str]:
    """Tests named after a module or importing it."""
    name = file.removesuffix(".py").replace("/", ".")
    line, own = f"from {name} import", f"test_{name.rpartition('.')[2]}.py"
    return {x for x in tests if Path(x).name == own or line in (TOP / x).read_text("utf-8")}


# Commands


def map_tests(work: Path, files: list[str]) -> None:
    """Note what tests execute, of named files or of all that are not noted yet."""
    base = _base(work)
    for file in files:
        (base / file).write_bytes((TOP / file).read_bytes())
        Passed(work).forget(file)
    tests = sorted(str(path.relative_to(base)) for path in (base / "tests").rglob("test_*.py"))
    for file in files or [x for x in tests if not _notes(work, x).exists() and x not in OF_TEXT]:
        ended = reach.run(base, [{file: None}], MAP_LIMIT)
        _notes(work, file).write_text(json.dumps(ended.tests), encoding="utf-8")
        spent = sum(test.seconds for test in ended.tests.values())
        print(f"{file}: {len(ended.tests)} tests, {spent:.0f} s {ended.failed}", flush=True)


def run(
    work: Path, record: Path, count: int, seed: int, budget: float, jobs: int, of: list[str]
) -> None:
    """Judge the mutants that the record lacks, and write it after each."""
    sources = _sources(_base(work), of)
    seen, rows, passed = _seen(work), relocated(read(record), sources), Passed(work)
    drawn = {_key(x): x for x in islice(sample(sources, seed), count)}
    waiting = {_key(x): x for x, verdict in _found(rows, sources) if verdict.outcome == "waiting"}
    tasks = {}
    for key, mutant in {**waiting, **drawn}.items():
        if key not in rows or rows[key].outcome in ("waiting", "survived"):
            lines = statements(sources[mutant.file], mutant)
            tasks[mutant] = plan(seen, mutant, lines, budget, passed.of(key))
    for mutant, ended in _judged(work, tasks, budget, jobs):
        key = _key(mutant)
        passed.add(key, ended)
        before = rows.get(key)
        is_new = before is None or before.outcome == "waiting"
        rows[key] = verdict(ended, code_of(sources, mutant), None if is_new else before)
        write(record, rows)
        print(*key, *rows[key], sep="  ", flush=True)


def check(work: Path, record: Path, budget: float, jobs: int, of: list[str]) -> None:
    """Judge the killed mutants of the record again, and print those that come back to life."""
    sources, seen, rows = _sources(_base(work), of), _seen(work), read(record)
    tasks = {}
    for mutant, before in _found(rows, sources):
        if before.outcome == "killed":
            lines = statements(sources[mutant.file], mutant)
            killer = {before.by.partition("::")[0]: [before.by]}
            tasks[mutant] = [killer, *plan(seen, mutant, lines, budget)]
    gone = sum(x.file in sources and v.outcome == "killed" for x, v in rows.items()) - len(tasks)
    alive = 0
    for mutant, ended in _judged(work, tasks, budget, jobs):
        alive += not ended.failed
        print(*mutant, ended.failed or "ALIVE", sep="  ", flush=True)
    print(f"{len(tasks)} judged again, {alive} alive; the code of {gone} is gone")


def _seen(work: Path) -> dict[str, dict[str, Seen]]:
    """What the map holds: tests by file."""
    return {
        path.relative_to(work / "map").as_posix().removesuffix(".json"): {
            node: Seen(*test) for node, test in json.loads(path.read_text("utf-8")).items()
        }
        for path in sorted((work / "map").rglob("*.json"))
    }


def _sources(top: Path, of: list[str]) -> dict[str, str]:
    """Modules of the packages, or of the files and folders named, with code that can fail."""
    paths = [x for package in PACKAGES for x in sorted((top / package).rglob("*.py"))]
    texts = {x.relative_to(top).as_posix(): x.read_text(encoding="utf-8") for x in paths}
    return {x: y for x, y in texts.items() if not of or x.startswith(tuple(of))}


def code_of(sources: dict[str, str], mutant: Mutant) -> str:
    """The line that a mutant begins in."""
    return sources[mutant.file].splitlines()[mutant.line - 1].strip()


def _found(
    rows: dict[Mutant, Verdict], sources: dict[str, str]
) -> Iterator[tuple[Mutant, Verdict]]:
    """Mutants of a record where their lines are now; without those whose code has changed."""
    for mutant, verdict in rows.items():
        if mutant.file in sources:
            found = located(sources[mutant.file], mutant, verdict.code)
            if found is not None:
                yield found, verdict


def relocated(rows: dict[Mutant, Verdict], sources: dict[str, str]) -> dict[Mutant, Verdict]:
    """A record whose mutants stand where their lines are now; where these are gone, as before."""
    moved: dict[Mutant, Verdict] = {}
    for mutant, verdict in rows.items():
        source = sources.get(mutant.file, "")
        moved[_key(located(source, mutant, verdict.code) or mutant)] = verdict
    return moved


def located(source: str, mutant: Mutant, code: str) -> Mutant | None:
    """A mutant of a record in the present text of its module; None if its line has changed."""
    lines = source.splitlines()
    places = [k for k, line in enumerate(lines, start=1) if line.strip() == code]
    at = min(places, key=lambda k: abs(k - mutant.line), default=0)
    if not at:
        return None
    if mutant.operator == BY_HAND:
        column = lines[at - 1].find(mutant.before)
        return mutant._replace(line=at, column=len(lines[at - 1][:column].encode()))
    same = [x for x in mutants(source, mutant.file) if x.line == at and _key(x)[3:] == mutant[3:]]
    return min(same, key=lambda x: abs(x.column - mutant.column), default=None)


def _judged(
    work: Path, tasks: dict[Mutant, Rounds], budget: float, jobs: int
) -> Iterator[tuple[Mutant, Ended]]:
    """Mutants with how their tests ended, as they end."""
    reach.load_libraries()
    fork = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(jobs, mp_context=fork) as pool:
        calls = {
            pool.submit(judge, work, mutant, rounds, budget): mutant
            for mutant, rounds in tasks.items()
            if any(rounds)
        }
        for call in as_completed(calls):
            yield calls[call], call.result()


def judge(work: Path, mutant: Mutant, rounds: Rounds, budget: float) -> Ended:
    """Run tests on a copy with a mutant."""
    top = work.resolve() / f"mutant-{os.getpid()}"
    reach.copy(top, _base(work))
    path = top / mutant.file
    for compiled in path.parent.glob(f"__pycache__/{path.stem}.*"):  # as old and as long, perhaps
        compiled.unlink()
    path.write_text(mutated(path.read_text(encoding="utf-8"), mutant), encoding="utf-8")
    return reach.run(top, rounds, GRACE + SLACK * budget, work.resolve() / "programs")


def verdict(ended: Ended, code: str, before: Verdict | None) -> Verdict:
    """Of tests that have run, after others that have passed."""
    tests = len(ended.tests) + (before.tests if before else 0)
    seconds = sum(x.seconds for x in ended.tests.values()) + (before.seconds if before else 0.0)
    outcome = "killed" if ended.failed else "survived"
    return Verdict(outcome, ended.failed, tests, round(seconds, 1), code)


class Passed:
    """Tests that have let mutants pass, kept in a file."""

    def __init__(self, work: Path) -> None:
        self._path = work / "passed.json"
        self._nodes: dict[str, list[str]] = (
            json.loads(self._path.read_text("utf-8")) if self._path.exists() else {}
        )

    def of(self, mutant: Mutant) -> set[str]:
        return set(self._nodes.get(str(mutant), ()))

    def add(self, mutant: Mutant, ended: Ended) -> None:
        nodes = self._nodes.setdefault(str(mutant), [])
        nodes += [node for node, test in ended.tests.items() if test.passed]
        self._write()

    def forget(self, file: str) -> None:
        """The tests of a file, which have changed."""
        for nodes in self._nodes.values():
            nodes[:] = [node for node in nodes if not node.startswith(f"{file}::")]
        self._write()

    def _write(self) -> None:
        self._path.write_text(json.dumps(self._nodes), encoding="utf-8")


def _base(work: Path) -> Path:
    """The copy of the checkout, made at first."""
    base = work.resolve() / "base"
    if not base.exists():
        work.mkdir(parents=True, exist_ok=True)
        reach.copy(base, TOP)
        for package in PACKAGES:
            compileall.compile_dir(base / package, quiet=1)
    return base


def _notes(work: Path, file: str) -> Path:
    path = work / "map" / f"{file}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _key(mutant: Mutant) -> Mutant:
    """As the record says it, without line breaks."""
    before, after = (" ".join(text.split()) for text in (mutant.before, mutant.after))
    return mutant._replace(before=before, after=after)


def read(record: Path) -> dict[Mutant, Verdict]:
    """A record; empty if there is none."""
    if not record.exists():
        return {}
    with record.open(encoding="utf-8", newline="") as file:
        _, *rows = csv.reader(file, delimiter="\t", quoting=csv.QUOTE_NONE)
    return {
        Mutant(file, int(line), int(column), *change): Verdict(
            outcome, by, int(tests), float(seconds), code
        )
        for file, line, column, *change, outcome, by, tests, seconds, code in rows
    }


def write(record: Path, rows: dict[Mutant, Verdict]) -> None:
    """Replace a record."""
    lines = [(*Mutant._fields, *Verdict._fields), *(x + y for x, y in sorted(rows.items()))]
    text = "".join("\t".join(map(str, line)) + "\n" for line in lines)
    temporary = record.with_suffix(".tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(record)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m campaigns.mutants")
    commands = parser.add_subparsers(dest="command", required=True)
    mapping, running, checking = map(commands.add_parser, ("map", "run", "check"))
    mapping.add_argument("work", type=Path)
    mapping.add_argument("files", nargs="*", help="tests")
    running.add_argument("--count", type=int, default=300)
    running.add_argument("--seed", type=int, default=0)
    for command in (running, checking):
        command.add_argument("work", type=Path)
        command.add_argument("record", type=Path)
        command.add_argument("--budget", type=float, default=60.0, help="of tests for each [s]")
        command.add_argument("--jobs", type=int, default=2, help="mutants judged side by side")
        command.add_argument("--of", nargs="*", default=[], help="files or folders, by default all")
    options = vars(parser.parse_args())
    {"map": map_tests, "run": run, "check": check}[options.pop("command")](**options)


if __name__ == "__main__":
    main()
