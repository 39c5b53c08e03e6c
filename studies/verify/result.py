"""The outcome of a verification."""

from __future__ import annotations

from datetime import datetime

from studies import __version__
from studies.config import processor_text
from studies.passport import Passport
from studies.result import Result
from studies.results.labelled import Labelled, derived, told, unwritten
from studies.study.spec import Study
from studies.verify.rows import Assumption


class ModelVerification(Labelled, Result, command="verify", version=3):
    """What `studies verify --json` prints: every assumption of the model, what it was checked
    against and how far apart both are.
    """

    study: Study = unwritten()
    rows: tuple[Assumption, ...] = told("a row for each assumption")

    @derived("", "whether no row failed; the exit code is 1 otherwise")
    def is_passed(self) -> bool:
        return all(row.is_passed for row in self.rows)

    @property
    def is_good(self) -> bool:
        return self.is_passed

    @derived("", "the outcome as later reports show it")
    def summary(self) -> Passport:
        checked = [row for row in self.rows if not row.left_out]
        failed = tuple(row.assumption for row in checked if not row.is_passed)
        return Passport(
            title=self.study.title,
            passed=len(checked) - len(failed),
            rows=len(checked),
            failed=failed,
            date=datetime.now().astimezone().date().isoformat(),
            version=__version__,
            processor=processor_text(),
        )
