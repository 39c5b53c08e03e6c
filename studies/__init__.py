"""Parameter studies of a flexible 3-PRR manipulator: files, batches, command line."""

from typing import TYPE_CHECKING

from studies.lazy import lazily

if TYPE_CHECKING:
    from studies.config import configure, info
    from studies.engine.results import load
    from studies.engine.runs import Run, chord_deflection, run_study
    from studies.engine.sweep import run_sweep
    from studies.errors import StudyError
    from studies.extensions import extend
    from studies.space.spec import load_sweep, parse_sweep
    from studies.study.cases import as_arrays, build_case, build_structure
    from studies.study.spec import Study, load_study, paper_study, parse_study

__all__ = [
    "as_arrays",
    "build_case",
    "build_structure",
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
        "as_arrays": "studies.study.cases",
        "build_case": "studies.study.cases",
        "build_structure": "studies.study.cases",
        "Run": "studies.engine.runs",
        "Study": "studies.study.spec",
        "StudyError": "studies.errors",
        "chord_deflection": "studies.engine.runs",
        "configure": "studies.config",
        "extend": "studies.extensions",
        "info": "studies.config",
        "load": "studies.engine.results",
        "load_study": "studies.study.spec",
        "load_sweep": "studies.space.spec",
        "paper_study": "studies.study.spec",
        "parse_study": "studies.study.spec",
        "parse_sweep": "studies.space.spec",
        "run_study": "studies.engine.runs",
        "run_sweep": "studies.engine.sweep",
    },
)
