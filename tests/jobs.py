"""A job that says nothing."""

from rich.console import Console

from studies.job import Job
from studies.phases import Phases


def quiet_job(folder=None, names=("only",)):
    """A job in a folder, or in none, with phases of these names."""
    return Job(folder, Phases(Console(quiet=True), names, True))
