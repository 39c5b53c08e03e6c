"""The verb `tune`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.cluster.connect import TIMEOUT, Place
from studies.verbs import verb

if TYPE_CHECKING:
    from studies.tuning.audit import Audit
    from studies.tuning.findings import TuneFindings
    from studies.tuning.spec import TuneSpec


@verb
def tune(
    what: TuneSpec | str | Path,
    out: str | Path | None = None,
    *,
    audit: bool = False,
    workers: Place = None,
    worker_timeout: float = TIMEOUT,
    resume: bool = False,
    progress: bool = True,
) -> TuneFindings | Audit:
    """Tune parameters of a study by gradients, within limits, for many machines at once.

    Args:
        what: tuning file (TOML), name of a ready-made one, or what `load` made of it.
        out: folder for the results.
        audit: only check derivatives against finite differences; writes no files.
        workers: number of processes on this machine, a Dask scheduler's tcp://HOST:PORT, or its
            file; default: this process.
        worker_timeout: restart workers silent for so long [s].
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        The best designs and how they were judged on fresh machines; or the audit.

    Raises:
        StudyError: the folder holds something else or cannot be written to; a fault of the study;
            contradictory limits (everything is written nevertheless).

    Example:
        >>> tune("tune", "tuned").report()  # doctest: +SKIP
    """
    from studies.errors import StudyError
    from studies.job import checked_out, working
    from studies.study.files import as_given
    from studies.tuning.audit import audited
    from studies.tuning.folder import CHECKED, fixed_part
    from studies.tuning.run import refuse_violated, tune_phases, tune_request, tuned_into
    from studies.tuning.spec import TuneSpec, load_tuning

    spec = as_given(what, TuneSpec, load_tuning)
    if audit:
        if out is not None or resume or workers is not None:
            raise StudyError("--audit: writes no files; leave --out, --resume and --workers out")
        return audited(spec)
    with working(
        "tune",
        checked_out(out),
        tune_request(spec),
        tune_phases(spec),
        resume,
        progress,
        CHECKED,
        fixed_part,
    ) as job:
        return refuse_violated(tuned_into(spec, job, workers, worker_timeout), job)
