"""The verb `sweep`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from studies.cluster.connect import TIMEOUT, Place
from studies.verbs import verb

if TYPE_CHECKING:
    from studies.space.spec import SweepSpec
    from studies.sweeps.dry_run import PlannedSweep
    from studies.sweeps.result import SweepResult


@verb
def sweep(
    what: SweepSpec | str | Path,
    out: str | Path | None = None,
    *,
    dry_run: bool = False,
    report: bool = False,
    workers: Place = None,
    worker_timeout: float = TIMEOUT,
    resume: bool = False,
    progress: bool = True,
) -> SweepResult | PlannedSweep:
    """Run thousands of cases from one file; finished cases survive any interruption.

    Args:
        what: sweep file (TOML), name of a ready-made one, or what `load` made of it.
        out: folder for the results.
        dry_run: show what would run, and how long it would take.
        report: also write a report with figures, HTML.
        workers: number of processes on this machine, a Dask scheduler's tcp://HOST:PORT, or its
            file; default: this process, for many cases all cores.
        worker_timeout: restart workers silent for so long [s].
        resume: go on with what is in the folder, if anything, or extend it.
        progress: show how far it is.

    Returns:
        All cases, or those that `sweep.keep` asks for; of a dry run, the plan.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished cases stay.

    Example:
        >>> sweep("gains", "gains").best("residual_rms")  # doctest: +SKIP
    """
    from studies.errors import StudyError
    from studies.job import again, checked_out, working
    from studies.publish import EXPLORER, REPORT
    from studies.result import in_folder
    from studies.space.spec import SweepSpec, load_sweep
    from studies.study.files import as_given
    from studies.sweeps.dry_run import PlannedSweep
    from studies.sweeps.run import make_plan, sweep_phases, swept_into
    from studies.sweeps.say import write_sweep_report

    spec = as_given(what, SweepSpec, load_sweep)
    if dry_run:
        if resume and out is None:
            raise StudyError("--resume: name the folder with --out")
        if workers is not None:
            raise StudyError("--dry-run: plans for this process only; leave the workers out")
        if report:
            raise StudyError("--report: --dry-run produces no results; leave one of them out")
        return PlannedSweep(make_plan(spec, Path(out) if out is not None and resume else None))
    out = checked_out(out)
    with working("sweep", out, None, sweep_phases(spec, report), resume, progress) as job:
        done = swept_into(spec, job, workers, worker_timeout)
        if report:
            job.begin("report")
            write_sweep_report(in_folder(done, out, out / REPORT))
        if done.n_run:  # a page of fewer cases
            (out / EXPLORER).unlink(missing_ok=True)
    if done.lost_text:
        text = f"{done.lost_text} were left out, see above; retry them with: {again()}"
        print(f"studies: {text}", file=sys.stderr)
    return done
