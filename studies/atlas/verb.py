"""The verb `atlas`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.atlas.findings import AtlasFindings
    from studies.study.spec import Study


@verb
def atlas(
    what: Study | str | Path | None = None,
    out: str | Path | None = None,
    *,
    case: int | str | None = None,
    pdf: bool = False,
    resume: bool = False,
    progress: bool = True,
) -> AtlasFindings:
    """Map all subsets of controlled links and modes, workspace modes and platform error.

    Args:
        what: study, its file, ready-made design, folder of a tuning or sweep; default: the paper's
            design, each run with the ratios of its uncontrolled counterpart.
        out: folder for the results.
        case: case of a sweep (number or id:...) or family of a tuning.
        pdf: also write the figures as PDF.
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        What subsets remove, how links share in it, workspace, platform error.

    Raises:
        StudyError: a fault of the design or the folder; no setting in which all cases finish.

    Example:
        >>> atlas("pulse", "atlas").report()  # doctest: +SKIP
    """
    from studies.atlas.run import DECISIVE, PHASES, mapped
    from studies.atlas.subsets import atlas_sweep
    from studies.engine.design import as_design
    from studies.job import checked_out, make_request, working

    out, study = checked_out(out), as_design("paper" if what is None else what, case).study
    if what is None:
        study = study.change(control__ratio_source="own_run")
    atlas_sweep(study)  # refuses what has no subsets
    request = make_request({"study": study.model_dump(mode="json")}, DECISIVE)
    with working("atlas", out, request, PHASES, resume, progress) as job:
        return mapped(study, job, pdf)
