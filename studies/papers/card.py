"""What a card of a paper is: claims with conditions, a study that tests them, open numbers.

A claim's condition is a comparison of a number that the study measures, so that the outcome follows
from the run and from nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from studies.job import Job
from studies.result import Result
from studies.results.labelled import Labelled, Variable, told
from studies.show.listing import Rows
from studies.show.report import Report
from studies.study.spec import Study

HOLDS, FAILS = "holds", "fails"


class Claim(Labelled):
    """One statement of a paper, in our words, and what decides it."""

    text: str = told("in our words")
    quantity: str = told("what decides it, with its unit")
    condition: str = told("on that quantity")


class Verdict(Labelled):
    """Outcome of a claim: `HOLDS` or `FAILS`."""

    claim: Claim = told("what the paper says")
    outcome: str = told("holds or fails")
    found: str = told("the numbers that decide")

    @property
    def cells(self) -> list[str]:
        """A row of the table of claims."""
        claim = self.claim
        return [claim.text, claim.quantity, claim.condition, self.outcome, self.found]


class PaperOutcome(Labelled, command="paper", version=2):
    """`claims.json` of `studies paper NAME`: what a paper claims, and what became of it."""

    card: str = told("first author and year")
    title: str = told("of the paper")
    source: str = told("where it appeared")
    read: str = told("what of it could be read")
    claims: list[Verdict] = told("in their order")
    left_open: tuple[str, ...] = told("numbers that the paper does not give")


def outcome_of(is_met: bool) -> str:
    """`HOLDS` or `FAILS`."""
    return HOLDS if is_met else FAILS


@dataclass(frozen=True, eq=False)
class CardResult(Result):
    """What the study of a card found, and how it is written."""

    FILES = "; data, tables and figures in the same folder"

    outcome: PaperOutcome
    study: Study  # baseline
    tables: dict[str, Rows]  # by name of their CSV file
    made: Report
    # runs by name of their HDF5 file: their study and variables
    stores: Mapping[str, tuple[Study, dict[str, Variable]]] = field(default_factory=dict)

    def document(self) -> PaperOutcome:
        return self.outcome

    def report(self) -> Report:
        return self.made

    def variables(self) -> dict[str, Variable]:
        return dict(next(iter(self.stores.values()))[1])


class PaperCard(NamedTuple):
    """A paper and the study that tests it."""

    name: str  # first author and year
    title: str
    source: str  # where it appeared, with its DOI
    read: str  # what of it could be read
    claims: tuple[Claim, ...]
    left_open: tuple[str, ...]  # numbers that a reader would need and the paper does not give
    run: Callable[[Job], CardResult]
