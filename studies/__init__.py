"""Parameter studies of a flexible 3-PRR manipulator: files, batches, command line."""

from typing import TYPE_CHECKING

from studies.lazy import lazily

if TYPE_CHECKING:
    from studies.config import configure, info
    from studies.errors import StudyError
    from studies.extensions import extend
    from studies.runs import Run, chord_deflection, run_study
    from studies.spec import Study, load_study, paper_study, parse_study
    from studies.sweeps.results import load
    from studies.sweeps.run import run_sweep
    from studies.sweeps.spec import load_sweep, parse_sweep

__all__ = [
    "Run",
    "Study",
    "StudyError",
    "chord_deflection",
    "configure",
    "extend",
    "info",
    "load",
    "load_study",
    "load_sweep",
    "paper_study",
    "parse_study",
    "parse_sweep",
    "run_study",
    "run_sweep",
]

__getattr__ = lazily(
    __name__,
    {
        "Run": "studies.runs",
        "Study": "studies.spec",
        "StudyError": "studies.errors",
        "chord_deflection": "studies.runs",
        "configure": "studies.config",
        "extend": "studies.extensions",
        "info": "studies.config",
        "load": "studies.sweeps.results",
        "load_study": "studies.spec",
        "load_sweep": "studies.sweeps.spec",
        "paper_study": "studies.spec",
        "parse_study": "studies.spec",
        "parse_sweep": "studies.sweeps.spec",
        "run_study": "studies.runs",
        "run_sweep": "studies.sweeps.run",
    },
)
