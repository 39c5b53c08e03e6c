"""The verb `twin`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.study.spec import Study
    from studies.twin.result import TwinResult


@verb
def twin(
    what: Study | str | Path,
    out: str | Path | None = None,
    *,
    case: int | str | None = None,
    resume: bool = False,
    progress: bool = True,
) -> TwinResult:
    """Repeat the loop with a machine in Exudyn and the exported controller, and compare.

    Args:
        what: study, its file, ready-made design, folder of a tuning or sweep.
        out: folder for the results.
        case: case of a sweep (number or id:...) or family of a tuning.
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        Both runs, what their difference is made of, damping and gain margin of both.

    Raises:
        StudyError: Exudyn or a C compiler is missing, or a study that the twin cannot repeat.

    Example:
        >>> twin("paper", "twin").plot()  # doctest: +SKIP
    """
    from studies.twin.multibody import load_exudyn

    load_exudyn()  # before anything that takes long
    from studies.engine.design import as_design
    from studies.job import make_request, working
    from studies.twin.compare import check_supported
    from studies.twin.law import check_compiler
    from studies.twin.run import DECISIVE, PHASES, compared_with_twin

    check_compiler()
    study = as_design(what, case).study
    check_supported(study)
    request = make_request({"study": study.model_dump(mode="json")}, DECISIVE)
    with working("twin", out, request, PHASES, resume, progress) as job:
        return compared_with_twin(study, job)
