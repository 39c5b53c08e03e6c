"""Parameter studies of a flexible 3-PRR manipulator: files, batches, command line."""

from studies.config import configure, info
from studies.errors import StudyError
from studies.spec import Study, load_study, paper_study, parse_study

__all__ = [
    "Study",
    "StudyError",
    "configure",
    "info",
    "load_study",
    "paper_study",
    "parse_study",
]
