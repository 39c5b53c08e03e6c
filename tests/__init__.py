"""Tests, in folders that mirror the packages; `tests.house` has the rules of the code itself."""

from pathlib import Path

#: The checkout, and files that tests read.
TOP = Path(__file__).parents[1]
DATA = TOP / "tests" / "data"
