"""Conditions on cases by truth tables: every operator, connective and function."""

import numpy as np
import pytest

from studies.errors import StudyError
from studies.space.condition import evaluate

A = np.array([-1.0, 0.0, 1.0, 2.0])
NAMES = {
    "a": A,
    "n": np.array([1, 2, 3, 4]),
    "is_on": np.array([True, False, True, False]),
    "kind": np.array(["zv", "ei", "zv", "none"]),
    "list.of[1]": np.array([5.0, 6.0, 7.0, 8.0]),
}
T, F = True, False


def truth(text):
    return evaluate(text, NAMES.__getitem__, "here").tolist()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("a < 0", [T, F, F, F]),
        ("a <= 0", [T, T, F, F]),
        ("a > 0", [F, F, T, T]),
        ("a >= 0", [F, T, T, T]),
        ("a == 0", [F, T, F, F]),
        ("a != 0", [T, F, T, T]),
        ("0 < a", [F, F, T, T]),
        ("0 <= a", [F, T, T, T]),
        ("0 > a", [T, F, F, F]),
        ("0 >= a", [T, T, F, F]),
        ("0 == a", [F, T, F, F]),
        ("0 != a", [T, F, T, T]),
        # chains
        ("0 <= a < 2", [F, T, T, F]),
        ("-1 < a <= 1", [F, T, T, F]),
        ("0 < a < 2 < n", [F, F, T, F]),
        # lists
        ("a in [0, 2]", [F, T, F, T]),
        ("a not in [0, 2]", [T, F, T, F]),
        ("kind in ['zv', 'none']", [T, F, T, T]),
        ("n in (1,)", [T, F, F, F]),
        # texts and flags
        ("kind == 'zv'", [T, F, T, F]),
        ("kind != 'zv'", [F, T, F, T]),
        ("is_on", [T, F, T, F]),
        ("not is_on", [F, T, F, T]),
        ("is_on == true", [T, F, T, F]),
        ("is_on != false", [T, F, T, F]),
        # connectives: not binds before and, and before or
        ("is_on and a > 0", [F, F, T, F]),
        ("is_on or a > 0", [T, F, T, T]),
        ("not a > 0 and is_on", [T, F, F, F]),
        ("a > 1 or is_on and a < 0", [T, F, F, T]),
        ("(a > 1 or is_on) and a < 0", [T, F, F, F]),
        # arithmetic
        ("a + n == 4", [F, F, T, F]),
        ("n - a == 2", [T, T, T, T]),
        ("a - n == -2", [T, T, T, T]),
        ("a * n == 8", [F, F, F, T]),
        ("n / 2 == 1.5", [F, F, T, F]),
        ("2 / n < 1", [F, F, T, T]),
        ("n ** 2 == 9", [F, F, T, F]),
        ("2 ** a == 0.5", [T, F, F, F]),
        ("-a == 1", [T, F, F, F]),
        ("+a == 1", [F, F, T, F]),
        ("a + 2 * n == 10", [F, F, F, T]),
        ("-a ** 2 == -4", [F, F, F, T]),
        # functions
        ("abs(a) == 1", [T, F, T, F]),
        ("abs(a - 1) >= 1", [T, T, F, T]),
        ("min(a, 1) == 1", [F, F, T, T]),
        ("max(a, 1) == 1", [T, T, T, F]),
        ("max(a, n, 3) == 3", [T, T, T, F]),
        ("min(n, 3, 4 - a) == 3", [F, F, T, F]),
        ("list.of[1] > 6", [F, F, T, T]),
        ("n ** 0.5 < 2", [T, T, T, F]),
    ],
)
def test_truth_of_conditions(text, wanted):
    assert truth(text) == wanted


def test_missing_numbers_are_unequal_to_everything():
    def lookup(_):
        return np.array([np.nan, 1.0])

    for text, wanted in (("x < 2", [F, T]), ("x > 2", [F, F]), ("x == x", [F, T])):
        assert evaluate(text, lookup, "here").tolist() == wanted
    assert evaluate("x != 1", lookup, "here").tolist() == [T, F]


def test_constants_need_no_name():
    assert truth("1 < 2") is True and truth("2 < 1") is False and truth("not 1 == 1.0") is False


@pytest.mark.parametrize("text", ["a", "a + 1", "is_on + 1 > a > kind", "kind < 1", "kind == 1"])
def test_what_is_neither_true_nor_false_is_refused(text):
    with pytest.raises(StudyError, match="^here = "):
        truth(text)
