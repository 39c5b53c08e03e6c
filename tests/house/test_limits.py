"""What may not grow: `.ci/limits.py`, and what files of tests cost, `tests/budget.py`."""

import importlib
import sys

import pytest

from tests import TOP, budget
from tests.budget import LEAST, Cost, excesses


@pytest.fixture(scope="module")
def limits():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOP / ".ci"))
        yield importlib.import_module("limits")
    for name in ("limits", "code_lines"):
        sys.modules.pop(name, None)


COUNTS = {"code lines": 50, "NamedTuples": 7, "public names": 3}


def test_nothing_is_said_where_all_is_at_its_limit(limits):
    assert limits.faults(COUNTS, COUNTS, COUNTS) == []
    assert limits.faults(COUNTS, COUNTS, {}) == []  # without a history
    lowered = {what: limit - 1 for what, limit in COUNTS.items()}
    assert limits.faults(lowered, COUNTS, COUNTS) == []


@pytest.mark.parametrize("what", COUNTS)
def test_what_is_above_its_limit_is_named_with_its_cure(limits, what):
    (fault,) = limits.faults(COUNTS | {what: COUNTS[what] + 1}, COUNTS, COUNTS)
    assert fault == f"{what}: {COUNTS[what] + 1}, limit {COUNTS[what]}; {limits.CURE[what]}"


@pytest.mark.parametrize("what", ["NamedTuples", "public names"])
def test_a_limit_that_rises_is_refused(limits, what):
    (fault,) = limits.faults(COUNTS, COUNTS | {what: COUNTS[what] + 1}, COUNTS)
    assert fault == f".ci/limits.tsv: the limit of {what} was {COUNTS[what]}; limits only fall"


def test_code_lines_may_rise_by_what_is_granted_only(limits):
    most = COUNTS["code lines"] + sum(limits.GRANTS.values())
    assert limits.faults(COUNTS, COUNTS | {"code lines": most}, COUNTS) == []
    (fault,) = limits.faults(COUNTS, COUNTS | {"code lines": most + 1}, COUNTS)
    assert "the limit of code lines was 50; limits only fall" in fault


def test_every_limit_has_a_cure(limits):
    table = limits.read((TOP / limits.TABLE).read_text(encoding="utf-8"))
    assert set(table) == set(limits.CURE)
    assert limits.faults(COUNTS, limits.read("what\tlimit\ncode lines\t49\n"), {})


# --- the budget of tests --------------------------------------------------------------------------

ALLOWED = {
    "tests/a.py": Cost(10, 10.0),
    "tests/small.py": Cost(0, 1.0),
    "tests/c.py": Cost(9, 14.0),
}


def test_files_may_cost_what_the_table_allows():
    assert excesses(ALLOWED, ALLOWED, 1.0) == []
    assert excesses({"tests/small.py": Cost(0, 2 * LEAST)}, ALLOWED, 1.0) == []
    assert excesses({"campaigns/test_long.py": Cost(900, 900.0)}, ALLOWED, 1.0) == []


@pytest.mark.parametrize(
    "name, cost, said",
    [
        ("tests/b.py", Cost(), "tests/b.py has no row in tests/budget.tsv: python -m tests.budget"),
        ("tests/a.py", Cost(11, 20.0), "tests/a.py: 11 programs traced, 10 allowed"),
        ("tests/a.py", Cost(10, 21.0), "tests/a.py: 21 s of processor time, 20 allowed"),
        ("tests/small.py", Cost(0, 9.0), "tests/small.py: 9 s of processor time, 8 allowed"),
    ],
)
def test_files_that_cost_more_are_named(name, cost, said):
    (fault,) = excesses({name: cost}, ALLOWED, 1.0)
    assert fault.startswith(said)


def test_a_slow_machine_may_take_longer_and_a_fast_one_as_long():
    spent = {"tests/a.py": Cost(10, 30.0)}
    assert excesses(spent, ALLOWED, 1.5) == []
    assert "20 allowed" in excesses(spent, ALLOWED, 0.5)[0]
    assert "28 allowed" in excesses(spent, ALLOWED, 1.4)[0]
    # programs do not depend on the machine
    assert "10 allowed" in excesses({"tests/a.py": Cost(11, 1.0)}, ALLOWED, 2.0)[0]


def test_both_faults_of_a_file_are_said():
    found = excesses({"tests/a.py": Cost(11, 21.0)}, ALLOWED, 1.0)
    assert ["programs" in x for x in found] == [True, False]


def test_all_files_together_may_not_take_longer_than_the_table():
    spent = {"tests/a.py": Cost(10, 16.0), "tests/c.py": Cost(9, 9.0)}
    assert excesses(spent, ALLOWED, 1.0) == []
    spent["tests/small.py"] = Cost(0, 1.0)
    assert excesses(spent, ALLOWED, 1.0) == ["all files: 26 s of processor time, 25 allowed"]
    assert excesses(spent, ALLOWED, 1.1) == []


def test_the_table_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "TABLE", tmp_path / "budget.tsv")
    budget.TABLE.write_text("file\tprograms\tseconds\ntests/a.py\t10\t20\n")
    assert budget.read_table() == {"tests/a.py": Cost(10, 20.0)}
