"""One run from a study or a design, with its file and its report."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from studies.engine.design import deviation, load_design
from studies.engine.runs import Run, run_study
from studies.errors import StudyError
from studies.single.report import check_results, write_results
from studies.study.labels import describe
from studies.study.spec import Study, load_study


class Replay(NamedTuple):
    """A rerun case of a sweep, compared with the sweep's results."""

    run: Run
    stored_status: int | None  # of the sweep; None if there is none
    difference: float  # largest difference of a metric, relative to the metric's size [1]
    metric: str  # which one; "" for none

    @property
    def agrees(self) -> bool:
        """Whether the status is that of the sweep, if there is one."""
        return self.stored_status in (None, self.run.status)

    @property
    def notes(self) -> list[str]:
        """The comparison as a sentence; [] if there is nothing to compare with."""
        if self.stored_status is None:
            return []
        which = f" ({self.metric})" if self.metric else ""
        fault = [] if self.agrees else ["CAUTION: the sweep and this run end differently."]
        return [
            *fault,
            f"the sweep has: {describe(self.stored_status)}; largest relative difference of a "
            f"metric: {self.difference:.1e}{which}",
        ]


def simulate(
    study: Study | str | Path, out: str | Path | None = None, has_report: bool = False
) -> Run:
    """Run a study with full trajectories, and write the requested files.

    Args:
        study: what to run; or its file, or the name of a ready one.
        out: HDF5 file for trajectories and metrics; None: nothing is written.
        has_report: whether to also write the report next to that file.

    Raises:
        StudyError: a fault of the study, or a file that cannot be written.
    """
    file = _checked(out, has_report)
    name = "STUDY" if isinstance(study, Study) else str(study)
    run = run_study(study if isinstance(study, Study) else load_study(study))
    if file is not None:
        write_results(file, run, has_report, name=name)
    return run


def replay(
    design: str | Path,
    case: int | str | None = None,
    out: str | Path | None = None,
    has_report: bool = False,
) -> Replay:
    """Rerun one case of a sweep with full trajectories, and compare with the sweep's results.

    Args:
        design: study file, folder of a tuning or a sweep.
        case: as in `load_design`.
        out, has_report: as in `simulate`.

    Raises:
        StudyError: as `load_design` and `simulate`.
    """
    file = _checked(out, has_report)
    found = load_design(design, case)
    run = run_study(found.study)
    if found.stored:
        again = Replay(run, int(found.stored["status"]), *deviation(run, found.stored))
    else:
        again = Replay(run, None, 0.0, "")
    if file is not None:
        name = str(design) if case is None else f"{design} --case {case}"
        write_results(file, run, has_report, again.notes, name)
    return again


def _checked(out: str | Path | None, has_report: bool) -> Path | None:
    """The file to write, after checking that it can be written."""
    if out is None:
        if has_report:
            raise StudyError(
                "--report: is written next to the trajectories; name their file with --out"
            )
        return None
    check_results(Path(out), has_report)
    return Path(out)
