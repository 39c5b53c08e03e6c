"""What each file of tests may cost, a plugin of pytest: programs traced and processor time.

    make test                              fails if a file takes more than `budget.tsv` allows
    python -m tests.budget [FILE ...]      measures files, each alone and cold, and writes the table

Programs cost most of a suite that compiles much and runs little, and their number does not depend
on the machine. Processor time does, and on which programs other files have left: it is compared in
units of a fixed piece of work, strictly of all files together and roughly of each. The longest
files begin first, so that the workers end together.
"""

from __future__ import annotations

import ast
import csv
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import pytest

from tests import TOP

TABLE = TOP / "tests" / "budget.tsv"
#: JAX's name for lowering a program, once for each that is traced.
TRACED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
#: Processor time that no file need answer for [s].
LEAST = 4.0
#: Times the table's time that a file may take: alone it finds no program that others have compiled.
ROUGH = 2.0
#: Time of the fixed piece of work where the table was written [s].
WORK = 0.05


class Cost(NamedTuple):
    """Of all tests of a file."""

    programs: float = 0
    seconds: float = 0.0  # of processor time, children included

    def plus(self, programs: float, seconds: float) -> Cost:
        return Cost(self.programs + programs, self.seconds + seconds)


#: What a file may cost over what was measured: another worker beside it makes processors slower.
SLACK = Cost(1.25, 2.0)


def read_table() -> dict[str, Cost]:
    """Allowed costs by file."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        _, *rows = csv.reader(file, delimiter="\t")
    return {name: Cost(int(programs), float(seconds)) for name, programs, seconds in rows}


def excesses(spent: dict[str, Cost], allowed: dict[str, Cost], speed: float) -> list[str]:
    """Sentences about files that cost more than they may.

    Args:
        spent: by file.
        allowed: by file.
        speed: time of the fixed piece of work here over that where the table was written [1].
    """
    found = []
    spent = {name: x for name, x in spent.items() if name.startswith("tests/")}  # not campaigns
    for name, cost in sorted(spent.items()):
        limit = allowed.get(name)
        if limit is None:
            found.append(f"{name} has no row in tests/budget.tsv: python -m tests.budget {name}")
            continue
        seconds = ROUGH * max(limit.seconds, LEAST) * max(speed, 1.0)
        if cost.programs > limit.programs:
            found.append(f"{name}: {cost.programs} programs traced, {limit.programs} allowed")
        if cost.seconds > seconds:
            found.append(f"{name}: {cost.seconds:.0f} s of processor time, {seconds:.0f} allowed")
    total = sum(x.seconds for x in spent.values())
    seconds = sum(x.seconds for x in allowed.values()) * max(speed, 1.0)
    if total > seconds:
        found.append(f"all files: {total:.0f} s of processor time, {seconds:.0f} allowed")
    return found


def fixed_work() -> float:
    """Processor time of a fixed piece of work [s], the least of three."""
    text = "x = f(a * (b + 1.0), [c[k] for k in d if k > 2])\n" * 1500

    def once() -> float:
        began = time.process_time()
        ast.parse(text)
        return time.process_time() - began

    return min(once() for _ in range(3))


class Budget:
    """Counts in each worker, judges in the process that has started them."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._is_worker = hasattr(config, "workerinput")
        self._programs = 0
        self.spent: defaultdict[str, Cost] = defaultdict(Cost)
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, duration_secs: float, **_: Any) -> None:
        self._programs += event == TRACED

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Files that cost most first."""
        cost = {name: x.seconds for name, x in read_table().items()}
        items.sort(key=lambda item: -cost.get(_file(item), math.inf))

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> object:
        programs, seconds = self._programs, _processor_time()
        result = yield
        name = _file(item)
        self.spent[name] = self.spent[name].plus(
            self._programs - programs, _processor_time() - seconds
        )
        return result

    @pytest.hookimpl(optionalhook=True)  # of pytest-xdist
    def pytest_testnodedown(self, node: Any) -> None:
        for name, cost in getattr(node, "workeroutput", {}).get("spent", {}).items():
            self.spent[name] = self.spent[name].plus(*cost)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self._is_worker:
            self._config.workeroutput["spent"] = {x: tuple(y) for x, y in self.spent.items()}
            return
        if out := os.environ.get("STUDIES_TESTS_SPENT"):
            Path(out).write_text(json.dumps(self.spent), encoding="utf-8")
        elif "long" not in self._config.option.markexpr.replace("not long", ""):
            self.faults = excesses(self.spent, read_table(), fixed_work() / WORK)
            if self.faults and not session.exitstatus:
                session.exitstatus = pytest.ExitCode.TESTS_FAILED

    faults: list[str] = []  # noqa: RUF012

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        for fault in self.faults:
            terminalreporter.write_line(f"budget: {fault}", red=True)


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Budget(config), "budget")


def _file(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


def _processor_time() -> float:
    return sum(os.times()[:4])


def measured(name: str) -> Cost:
    """What a file costs in a process of its own that finds no program kept."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "spent.json"
        more = {"STUDIES_TESTS_SPENT": str(out), "JAX_COMPILATION_CACHE_DIR": folder}
        subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", name],
            env=os.environ | more,
            cwd=TOP,
            stdout=subprocess.DEVNULL,
            timeout=1800,
        )
        spent = json.loads(out.read_text(encoding="utf-8"))
    return Cost(*spent.get(name, ()))


def measure(files: list[str]) -> None:
    """Write what files may cost, or all of them."""
    there = [str(x.relative_to(TOP)) for x in sorted((TOP / "tests").rglob("test_*.py"))]
    table = {name: cost for name, cost in read_table().items() if name in there}
    names, work = files or there, WORK / fixed_work()
    with ThreadPoolExecutor(2) as pool:
        for name, cost in zip(names, pool.map(measured, names), strict=True):
            seconds = SLACK.seconds * work * cost.seconds
            table[name] = Cost(math.ceil(SLACK.programs * cost.programs), math.ceil(seconds))
            print(name, *table[name], flush=True)
    rows = [("file", *Cost._fields)]
    rows += [(x, *map("{:g}".format, y)) for x, y in sorted(table.items())]
    text = "".join("\t".join(map(str, row)) + "\n" for row in rows)
    TABLE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    measure(sys.argv[1:])
