"""All checks of a study, in order, and their outcome kept for later reports."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

import numpy as np

from studies import __version__, passport
from studies.config import processor_text, require_configured
from studies.engine.preflight import check_run
from studies.errors import StudyError
from studies.passport import Passport
from studies.results.labelled import Labelled, derived, told, unwritten
from studies.study.spec import Study, paper_study
from studies.verify.links import check_links
from studies.verify.loops import check_loops
from studies.verify.machine import check_machine
from studies.verify.outside import check_outside
from studies.verify.rows import Assumption
from studies.verify.stepping import check_stepping
from studies.verify.trajectories import check_trajectories

#: What is checked, in this order, by names for progress.
CHECKS: dict[str, Callable[[Study], list[Assumption]]] = {
    "links and patches": check_links,
    "trajectories and shapers": check_trajectories,
    "mechanics": check_machine,
    "time steps, kernels, metrics": check_stepping,
    "digital loop": check_loops,
    "figures of others": check_outside,
}


class ModelVerification(Labelled, command="verify", version=2):
    """What `studies verify --json` prints: every assumption of the model, what it was checked
    against and how far apart both are.
    """

    study: Study = unwritten()
    table: tuple[Assumption, ...] = told("a row for each assumption")

    @derived("", "whether no row failed; the exit code is 1 otherwise")
    def is_passed(self) -> bool:
        return all(row.is_passed for row in self.table)

    @derived("", "the outcome as later reports show it")
    def summary(self) -> Passport:
        checked = [row for row in self.table if not row.left_out]
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


def verify_study(
    study: Study | None = None, on_progress: Callable[[str], None] = lambda _: None
) -> ModelVerification:
    """Check every assumption of the model on a study's machine, motion and controller.

    Args:
        study: to verify; None: the paper's machine.
        on_progress: called with what is checked next.

    Returns:
        ModelVerification: a row per assumption; its outcome is kept for later reports.

    Raises:
        StudyError: a study that cannot run.

    Example:
        >>> verify_study(load_study("mine.toml")).is_passed  # doctest: +SKIP
        True
    """
    require_configured()
    study = study or paper_study()
    check_run(study)
    rows: list[Assumption] = []
    for name, check in CHECKS.items():
        on_progress(name)
        try:
            rows += check(study)
        except (StudyError, FloatingPointError, np.linalg.LinAlgError, ValueError) as error:
            rows.append(
                Assumption(
                    assumption=name,
                    against="-",
                    source="-",
                    difference=np.inf,
                    allowed=0.0,
                    note=f"it could not be checked: {error}",
                )
            )
    found = ModelVerification(study, tuple(rows))
    passport.keep(study, found.summary)
    return found
