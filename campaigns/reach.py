"""Tests in a process of their own, which stops at a failure or notes what each test executes.

The process is forked from one that has loaded all libraries but none of the packages, so that it
begins within two seconds with the packages of the folder it is given.
"""

from __future__ import annotations

import ast
import builtins
import gc
import importlib
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
from contextlib import suppress
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import NamedTuple

import pytest

from tests import TOP

#: Loaded before forking; none of them starts a thread.
LIBRARIES = (
    *("jax", "jax.numpy", "jax.experimental.serialize_executable", "optax", "h5py", "h5netcdf"),
    *("pandas", "xarray", "scipy.linalg", "scipy.optimize", "scipy.io", "scipy.signal"),
    *("scipy.stats", "matplotlib.figure", "matplotlib.pyplot", "pydantic", "typer", "rich.console"),
    *("jinja2", "hypothesis", "llvmlite.binding", "llvmlite.ir"),
)
#: Whose statements are watched and changed.
PACKAGES = ("jaxmodel", "studies")
#: Of pytest; without those that keep a cache or collect garbage.
PLUGINS = ("pytest_timeout", "no:cacheprovider", "no:unraisableexception")
#: What a copy of the checkout leaves out.
ELSEWHERE = (
    *(".git", "_build", ".mypy_cache", ".ruff_cache", ".pytest_cache", ".hypothesis"),
    ".venv*",
)
#: The same of its top only: below, a package has this name.
ELSEWHERE_ON_TOP = ("results",)
#: Stands in place of the failing test where none could run.
STOPS = {2: "import of a test", 4: "import of conftest", -signal.SIGXCPU: "time limit"}
#: Called before each statement with its file and line.
_MARK = "__executed__"


class Seen(NamedTuple):
    """One test that has ended."""

    seconds: float  # of processor time, fixtures included
    passed: bool
    statements: dict[str, list[int]]  # executed first: lines by file of the packages


class Ended(NamedTuple):
    """How a run of tests ended."""

    tests: dict[str, Seen]  # by node
    failed: str  # the test that failed, or what stopped the run; "" for none


def copy(folder: Path, top: Path) -> None:
    """A checkout, anew, in a folder."""

    def left_out(place: str, names: list[str]) -> set[str]:
        more = ELSEWHERE_ON_TOP if Path(place) == top else ()
        return shutil.ignore_patterns(*ELSEWHERE, *more)(place, names)

    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(top, folder, symlinks=True, ignore=left_out)


def load_libraries() -> None:
    """Import them once, before any fork."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as studies.config does before JAX
    for name in LIBRARIES:
        importlib.import_module(name)
    gc.freeze()  # of these objects none need be looked at again


def run(
    top: Path,
    rounds: list[dict[str, list[str] | None]],
    limit: float,
    programs: Path | None = None,
) -> Ended:
    """Run tests until one fails.

    Args:
        top: a copy of the checkout.
        rounds: tests by file, one round after another; None for all of a file.
        limit: of processor time [s].
        programs: where compiled programs are kept. None: nowhere; statements that tests execute
            are noted, and failures stop nothing.
    """
    load_libraries()
    notes = top.with_name(f"{top.name}.jsonl")
    notes.write_text("", encoding="utf-8")
    child = multiprocessing.get_context("fork").Process(
        target=_child, args=(top, notes, rounds, int(limit), programs)
    )
    child.start()
    child.join(20 * limit)
    with suppress(ProcessLookupError):  # and all that its tests have started
        os.killpg(child.pid or 0, signal.SIGKILL)
    child.join()
    tests = {
        name: Seen(*seen) for name, *seen in map(json.loads, notes.read_text("utf-8").splitlines())
    }
    if not child.exitcode or (programs is None and child.exitcode == pytest.ExitCode.TESTS_FAILED):
        return Ended(tests, "")
    failed = [name for name, seen in tests.items() if not seen.passed]
    return Ended(tests, failed[0] if failed else STOPS.get(child.exitcode, "crash"))


def _child(
    top: Path,
    notes: Path,
    rounds: list[dict[str, list[str] | None]],
    limit: int,
    programs: Path | None,
) -> None:
    os.setsid()
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
    with top.with_name(f"{top.name}.log").open("w", encoding="utf-8") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    os.chdir(top)
    os.environ["PYTHONPATH"] = str(top)
    sys.path[:] = [str(top), *(x for x in sys.path if Path(x or TOP).resolve() != TOP)]
    for name in [x for x in sys.modules if x.partition(".")[0] in ("campaigns", "tests")]:
        del sys.modules[name]
    if programs:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(programs)
    else:
        _mark_statements(top)
        os.environ["STUDIES_TESTS_KEEP"] = "0"  # programs that are kept execute nothing
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    options = ["-q", "--tb=line", "-o", "timeout=0", *(x for name in PLUGINS for x in ("-p", name))]
    options += ["-x"] if programs else []
    worst = 0
    for tests in rounds:
        for file, nodes in tests.items():
            code = pytest.main([file, *options], plugins=[_Notes(notes, nodes)])
            worst = max(worst, 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else code)
            if worst and programs:
                break
    os._exit(worst)


_executed: set[tuple[str, int]] = set()


class _Notes:
    """Picks the tests and notes how each of them ends."""

    def __init__(self, path: Path, nodes: list[str] | None) -> None:
        self._path, self._nodes, self._passed = path, nodes, True

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        if self._nodes is not None:
            items[:] = [item for item in items if item.nodeid in self._nodes]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> object:
        _executed.clear()
        self._passed, began = True, _processor_time()
        result = yield
        lines: dict[str, list[int]] = {}
        for file, line in sorted(_executed):
            lines.setdefault(file, []).append(line)
        note = item.nodeid, round(_processor_time() - began, 3), self._passed, lines
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(note) + "\n")
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._passed &= not report.failed


def _processor_time() -> float:
    """Of this process and of those it has waited for [s]."""
    return sum(os.times()[:4])


def _mark_statements(top: Path) -> None:
    """Let functions in modules of the packages, imported from now on, note what they execute."""
    setattr(builtins, _MARK, lambda *statement: _executed.add(statement))
    plain = SourceFileLoader.get_code

    def marked(loader: SourceFileLoader, name: str) -> object:
        path = Path(loader.path)
        if not any(top / package in path.parents for package in PACKAGES):
            return plain(loader, name)
        marker = _Marker(path.relative_to(top).as_posix())
        tree = marker.visit(ast.parse(path.read_bytes()))
        return compile(ast.fix_missing_locations(tree), loader.path, "exec", dont_inherit=True)

    SourceFileLoader.get_code = marked  # type: ignore[method-assign,assignment]


class _Marker(ast.NodeTransformer):
    def __init__(self, file: str) -> None:
        self._file = file
        self._depth = 0

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self._depth += 1
        node.body = self._marked(node.body)
        self._depth -= 1
        return node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        for name, value in ast.iter_fields(node):
            if isinstance(value, list) and value and isinstance(value[0], ast.stmt):
                setattr(node, name, self._marked(value))
            elif isinstance(value, list):
                for part in value:
                    if isinstance(part, ast.ExceptHandler | ast.match_case):
                        self.generic_visit(part)
        return node

    def _marked(self, statements: list[ast.stmt]) -> list[ast.stmt]:
        found: list[ast.stmt] = []
        for statement in statements:
            if self._depth and not _is_docstring(statement):
                mark = ast.parse(f"{_MARK}({self._file!r}, {statement.lineno})").body
                found += [ast.copy_location(x, statement) for x in mark]
            found.append(self.visit(statement))
        return found


def _is_docstring(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
