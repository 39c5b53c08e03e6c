"""Results as notebooks show them: `studies.result` calls it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from studies.result import Summary
from studies.results.labelled import Labelled
from studies.show.report import Report, plain

#: Module with the function `say`, by the name of the result's type.
SAY = {
    "Certificate": "studies.spillover.say",
    "CommissionFindings": "studies.commission.say",
    "ComparedVariants": "studies.export.comparison",
    "Exported": "studies.export.say",
    "Fitted": "studies.fitting.say",
    "LawFindings": "studies.laws.say",
    "NamedModes": "studies.single.modes",
    "PlannedSweep": "studies.sweeps.dry_run",
    "SweepResult": "studies.sweeps.say",
    "Simulation": "studies.single.say",
    "AtlasFindings": "studies.atlas.say",
    "ModelVerification": "studies.verify.say",
    "TuneFindings": "studies.tuning.say",
    "TwinResult": "studies.twin.say",
}


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
    """What is told of a result of a type in SAY."""
    made: Report = import_module(SAY[type(result).__name__]).say(result)
    return made


def card(result: Any) -> str:
    """A result as HTML, whose texts are shown as they are."""
    from studies.show import pages  # loads Matplotlib

    return pages.card(result.report())
