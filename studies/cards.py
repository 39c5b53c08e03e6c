"""Results as notebooks show them: `studies.result` calls it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from studies.result import Summary
from studies.results.labelled import Labelled
from studies.show.report import Report, plain

#: Modules that tell of results of another package.
TELLERS = {"NamedModes": "studies.single.modes"}
#: Function that makes the document of a result that is none itself.
DOCUMENT = {
    "Fitted": "studies.fitting.document.fit_document",
    "LawFindings": "studies.laws.document.laws_document",
    "Simulation": "studies.single.documents.run_document",
    "TwinResult": "studies.twin.say.twin_document",
}


def document_of(result: Any) -> Labelled:
    """The document of a result: what DOCUMENT makes, or else what is told."""
    kind = type(result).__name__
    if kind not in DOCUMENT:
        report = result.report()
        return Summary(report.title, list(map(plain, report.result)), result.is_good, result.told())
    module, _, name = DOCUMENT[kind].rpartition(".")
    made: Labelled = getattr(import_module(module), name)(result)
    return made


def report_of(result: Any) -> Report:
    """What is told of a result."""
    made: Report = teller(type(result)).say(result)
    return made


def teller(kind: type) -> Any:
    """The module whose `say` tells of results of a type: its own, or that of its package."""
    own = import_module(TELLERS.get(kind.__name__, kind.__module__))
    return own if hasattr(own, "say") else import_module(f"{own.__package__}.say")


def card(result: Any) -> str:
    """A result as HTML, whose texts are shown as they are."""
    from studies.show import pages  # loads Matplotlib

    return pages.card(result.report())
