"""The verb `verify`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.study.spec import Study
    from studies.verify.result import ModelVerification


@verb
def verify(
    what: Study | str | Path = "paper",
    out: str | Path | None = None,
    *,
    resume: bool = False,
    progress: bool = True,
) -> ModelVerification:
    """Check every assumption of the model on a study's machine, motion and controller.

    Args:
        what: study, its file or ready-made design.
        out: folder for the results.
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        A row per assumption; the outcome is kept for later reports. `is_good`: whether no row
        failed.

    Raises:
        StudyError: a study that cannot run.

    Example:
        >>> verify("mine.toml").is_passed  # doctest: +SKIP
    """
    from studies.engine.design import as_design
    from studies.engine.preflight import check_run
    from studies.job import make_request, working
    from studies.verify.run import DECISIVE, PHASES, verified

    study = as_design(what).study
    check_run(study)
    request = make_request({"study": study.model_dump(mode="json")}, DECISIVE)
    with working("verify", out, request, PHASES, resume, progress) as job:
        return verified(study, job)
