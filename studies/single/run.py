"""One run from a study or a design, with its file and its report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.design import as_design, deviations
from studies.engine.run_data import run_attributes, run_variables
from studies.engine.runs import Run, run_study, uncontrolled_twin
from studies.errors import StudyError
from studies.publish import REPORT, check_target, publish
from studies.result import Result, in_folder
from studies.results.labelled import Variable
from studies.show.units import count_text
from studies.store import write_store
from studies.study.labels import describe
from studies.study.spec import Study
from studies.verbs import check_file

#: Drawn next to the file of a run.
FIGURES = ("deflection", "error", "voltage", "machine")


@dataclass(frozen=True, eq=False)
class Simulation(Result):
    """A run, and what a sweep has kept of it, if it is a case of one."""

    run: Run
    stored_status: int | None = None  # of the sweep; None if there is none
    differences: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # `deviations`
    name: str = "STUDY"  # of the study on the command line

    @cached_property
    def free(self) -> Run | None:
        """The same run without control; None if nothing acts."""
        return uncontrolled_twin(self.run)

    @property
    def is_good(self) -> bool:
        return self.agrees and (self.stored_status is not None or not self.run.status)

    def variables(self) -> dict[str, Variable]:
        return run_variables(self.run)

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


def simulated(
    what: Study | str | Path,
    out: str | Path | None = None,
    case: int | str | None = None,
    has_report: bool = False,
    has_margins: bool = False,
) -> Simulation:
    """Run a study and write the requested files; arguments and errors as `studies.simulate`."""
    file = _output_file(out, has_report)
    design = as_design(what, case)
    name = "STUDY" if isinstance(what, Study) else str(what)
    name = name if case is None else f"{name} --case {case}"
    run = run_study(design.study, has_margins=has_margins)
    again = Simulation(run, name=name)
    if design.stored:
        found = deviations(run, design.stored)
        again = Simulation(run, int(design.stored["status"]), found, name)
    if file is not None:
        write_results(file, again, has_report)
    return in_folder(again, file, file.with_suffix(".html") if file and has_report else None)


def write_results(out: Path, found: Simulation, has_report: bool) -> None:
    """Write a run to its file and, if requested, its report next to it.

    Args:
        out: file of the run.
        found: with trajectories.
        has_report: whether to write the report.

    Raises:
        StudyError: a file cannot be written.
    """
    with publish(out.parent) as staging:
        if has_report:
            from studies.show.pages import write_report

            write_report(found.report(), staging)
            for file in [*staging.iterdir()]:
                end = ".html" if file.name == REPORT else f"-{file.name}"
                file.rename(staging / f"{out.stem}{end}")
        run = found.run
        write_store(staging / out.name, run_variables(run), run_attributes(run.study))


def check_results(out: Path, has_report: bool) -> None:
    """Raise StudyError unless the files of a run can be written; call it before long work.

    Args:
        out: file of the run.
        has_report: whether its report will be written next to it.

    Raises:
        StudyError: another ending, or a file cannot be written.
    """
    check_file(out, ".h5", ".hdf5", ".nc")
    names = [f"{out.stem}.html", *(f"{out.stem}-{name}.png" for name in FIGURES)]
    for name in names if has_report else []:
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
