"""The verb `commission`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.commission.findings import CommissionFindings
    from studies.commission.spec import MeasuredSpec


@verb
def commission(
    what: MeasuredSpec | str | Path,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    progress: bool = True,
) -> CommissionFindings:
    """Lead from measurements to verified firmware: fit, tune, certify, export.

    Ends with 1 and says why if the data do not support a controller.

    Args:
        what: file with measurements, wishes and processor (TOML), or what `load` made of it.
        out: folder for the results; each stage has one of its own in it.
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        What was found and chosen; `is_good`: whether there is firmware that can be used.

    Raises:
        StudyError: a fault of the file or the folder; a stage that cannot run.

    Example:
        >>> commission("measured.toml", "arm").summary  # doctest: +SKIP
    """
    from studies.commission.run import DECISIVE, PHASES, commissioned
    from studies.commission.spec import MeasuredSpec, load_measured
    from studies.export.firmware.build import check_tools
    from studies.job import CHECKED, checked_out, make_request, working
    from studies.study.files import as_given

    out = checked_out(out)
    measured = as_given(what, MeasuredSpec, load_measured)
    if measured.commission.processor:
        check_tools()
    request = make_request(measured.data, DECISIVE) | {"files": measured.fit.data_files()}
    checked = CHECKED | {"files": "set of data"}
    with working("commission", out, request, PHASES, resume, progress, checked) as job:
        return commissioned(measured, job)
