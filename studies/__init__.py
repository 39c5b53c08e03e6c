"""Parameter studies of a flexible 3-PRR manipulator: files, batches, command line."""

from studies.config import configure, info
from studies.errors import StudyError
from studies.runs import Run, chord_deflection, run_study
from studies.spec import Study, load_study, paper_study, parse_study

__all__ = [
    "Run",
    "Study",
    "StudyError",
    "chord_deflection",
    "configure",
    "info",
    "load_study",
    "paper_study",
    "parse_study",
    "run_study",
]
