"""One run from a study or a design, with its file and its report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.design import deviations, load_design
from studies.engine.run_data import run_attributes, run_variables
from studies.engine.runs import Run, run_study, uncontrolled_twin
from studies.errors import StudyError
from studies.publish import REPORT, check_target, publish
from studies.show.units import count_text
from studies.store import write_store
from studies.study.labels import describe
from studies.study.spec import Study, load_study

#: Drawn next to the file of a run.
FIGURES = ("deflection", "error", "voltage", "machine")


class Replay(NamedTuple):
    """A rerun case of a sweep, compared with all that the sweep has kept of it."""

    run: Run
    stored_status: int | None  # of the sweep; None if there is none
    differences: dict[str, tuple[float, float]]  # from `deviations`

    @property
    def agrees(self) -> bool:
        """Whether status and numbers are those of the sweep, if there is one."""
        return self.stored_status in (None, self._status) and not self._faults

    @property
    def _status(self) -> int:
        """Of this run; a sweep that does not keep the strain of patches does not warn of it."""
        is_unknown = "patch_strain_peak" not in self.differences
        return status.OK if is_unknown and self.run.status == status.STRAINED else self.run.status

    @property
    def _faults(self) -> list[str]:
        return [
            f"CAUTION: {name} differs by {100 * found:.3g} %; allowed: {100 * allowed:g} %."
            for name, (found, allowed) in self.differences.items()
            if not found <= allowed
        ]

    @property
    def notes(self) -> list[str]:
        """The comparison in sentences; [] if there is nothing to compare with."""
        if self.stored_status is None:
            return []
        is_same = self.stored_status == self._status
        ends = [] if is_same else ["CAUTION: the sweep and this run end differently."]
        metrics = {name: x for name, (x, _) in self.differences.items() if name in METRICS}
        worst = max(metrics, key=metrics.__getitem__, default="")
        return [
            *ends,
            *self._faults,
            f"the sweep has: {describe(self.stored_status)}; largest relative difference of a "
            f"metric: {metrics.get(worst, 0.0):.1e}{f' ({worst})' if worst else ''}; compared: "
            f"{count_text(len(self.differences), 'figure')}",
        ]


def simulate(
    study: Study | str | Path,
    out: str | Path | None = None,
    has_report: bool = False,
    has_margins: bool = False,
) -> Run:
    """Run a study with full trajectories, and write the requested files.

    Args:
        study: what to run; or its file, or the name of a ready one.
        out: HDF5 file for trajectories and metrics; None: nothing is written.
        has_report: whether to also write the report next to that file.
        has_margins: whether to also find disk, phase and delay margin.

    Raises:
        StudyError: a fault of the study, or a file that cannot be written.
    """
    file = _output_file(out, has_report)
    name = "STUDY" if isinstance(study, Study) else str(study)
    study = study if isinstance(study, Study) else load_study(study)
    run = run_study(study, has_margins=has_margins)
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
    file = _output_file(out, has_report)
    loaded = load_design(design, case)
    run = run_study(loaded.study)
    if loaded.stored:
        again = Replay(run, int(loaded.stored["status"]), deviations(run, loaded.stored))
    else:
        again = Replay(run, None, {})
    if file is not None:
        name = str(design) if case is None else f"{design} --case {case}"
        write_results(file, run, has_report, again.notes, name)
    return again


def write_results(
    out: Path, run: Run, has_report: bool, notes: Sequence[str] = (), name: str = "STUDY"
) -> None:
    """Write a run to its file and, if requested, its report next to it.

    Args:
        out: file of the run.
        run: with trajectories.
        has_report: whether to write the report.
        notes: sentences that the report adds.
        name: of the study on the command line, for commands in the report.

    Raises:
        StudyError: a file cannot be written.
    """
    with publish(out.parent) as staging:
        if has_report:
            from studies.show.pages import write_report
            from studies.single.say import say

            write_report(say(run, uncontrolled_twin(run), notes, name), staging)
            for file in [*staging.iterdir()]:
                end = ".html" if file.name == REPORT else f"-{file.name}"
                file.rename(staging / f"{out.stem}{end}")
        write_store(staging / out.name, run_variables(run), run_attributes(run.study))


def check_results(out: Path, has_report: bool) -> None:
    """Raise StudyError unless the files of a run can be written; call it before long work.

    Args:
        out: file of the run.
        has_report: whether its report will be written next to it.

    Raises:
        StudyError: a file cannot be written, or `out` has the name of one of the report.
    """
    if out.suffix == ".toml":
        raise StudyError(f"--out {out}: results are HDF5, not a study; name the file *.h5")
    check_target(out)
    names = [f"{out.stem}.html", *(f"{out.stem}-{name}.png" for name in FIGURES)]
    for name in names if has_report else []:
        if name == out.name:
            raise StudyError(f"--out {out}: --report writes a file of this name; name it *.h5")
        check_target(out.with_name(name))


def _output_file(out: str | Path | None, has_report: bool) -> Path | None:
    """The file to write, after checking that it can be written."""
    if out is None:
        if has_report:
            raise StudyError(
                "--report: is written next to the trajectories; name their file with --out"
            )
        return None
    check_results(Path(out), has_report)
    return Path(out)
