"""The result of a sweep: its cases, as numbers, table, figures and report."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.engine.folder import read_manifest
from studies.engine.results import SweepData, read_sweep
from studies.result import Result, in_folder
from studies.results.labelled import Labelled, Variable
from studies.screen.run import ScreenOutcome
from studies.show.units import count_text
from studies.verbs import verb

if TYPE_CHECKING:
    import pandas
    import xarray


@dataclass(frozen=True, eq=False)
class SweepResult(Result):
    """A sweep in its folder, finished or not, and what one call has run of it."""

    n_cases: int = 0
    n_run: int = 0  # cases, in this call
    compile_time: float = 0.0  # [s]
    run_time: float = 0.0  # [s]
    executor: str = ""  # that ran the last chunks; "" if there were none
    # numbers of cases that were given up, with the reason in the folder
    lost: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    screen: ScreenOutcome | None = None  # how its best designs were found; None: all are kept

    def after(self, before: SweepResult) -> SweepResult:
        """The same with what was run before it."""
        return replace(
            self,
            n_run=before.n_run + self.n_run,
            compile_time=before.compile_time + self.compile_time,
            run_time=before.run_time + self.run_time,
        )

    @cached_property
    def found(self) -> SweepData:
        """The cases as they are in the folder; what of it is not among them, is warned of."""
        assert self.folder is not None
        data = read_sweep(self.folder)
        for note in data.notes:
            warnings.warn(note, stacklevel=3)
        return data

    @property
    def lost_text(self) -> str:
        """What was given up, "" for nothing."""
        texts = [f"{len(self.lost)} of {self.n_cases} cases"] if len(self.lost) else []
        if self.screen is not None and self.screen.lost:
            texts.append(f"{len(self.screen.lost)} of {self.screen.screen.n_shards} shards")
        return " and ".join(texts)

    @property
    def is_good(self) -> bool:
        return not self.lost_text

    def variables(self) -> dict[str, Variable]:
        return self.found.variables

    def document(self) -> Labelled:
        from studies.sweeps.documents import show_document

        return show_document(self.found, is_failed=False)

    @property
    def data(self) -> xarray.Dataset:
        from studies.engine.dataset import as_dataset

        return as_dataset(self.found)

    def table(self) -> pandas.DataFrame:
        """All cases, a row each, as `studies.sweeps.show.table`."""
        from studies.sweeps.show import table

        return table(self.found)

    @verb
    def best(self, by: str, subject_to: str = "", count: int = 10) -> pandas.DataFrame:
        """The best cases by a metric, as `studies.sweeps.show.best_cases`."""
        from studies.sweeps.show import best_cases

        return best_cases(self.found, by, subject_to, count)

    def sensitivity(self, by: str) -> Any:
        """Which parameters matter, as `studies.sweeps.sensitivity.analyse`."""
        from studies.sweeps.sensitivity import analyse

        return analyse(self.found, by)

    def plot(self, name: str = "", x: str | None = None, hue: str | None = None) -> Any:
        """A figure for Matplotlib: name is its metric or axis, as `studies.sweeps.plots.plot`."""
        from studies.sweeps.plots import plot
        from studies.sweeps.show import ranking

        return plot(self.found, x, name or ranking(self.found), hue)

    def lines(self) -> list[str]:
        return [] if self.screen is None else super().lines()

    def told(self) -> list[str]:
        run = f"{count_text(self.n_run, 'case')} in {self.run_time:.1f} s"
        taken = f"{run} and {self.compile_time:.1f} s of compiling; "
        results = f"{taken}results: {self.folder}/results.h5"
        return [results, *super().told()]


def read_result(folder: str | Path) -> SweepResult:
    """The result of a sweep in its folder.

    Raises:
        StudyError: no sweep there, or results of another version.
    """
    read_manifest(Path(folder))
    return in_folder(SweepResult(), Path(folder))
