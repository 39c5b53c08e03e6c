"""The schema of every JSON document, by the command that prints or writes it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from studies.errors import field_error, nearest

#: Where results with a document are declared.
DOCUMENTS = {
    "bench": "bench.run.Benchmark",
    "best": "sweeps.documents.BestCases",
    "cache": "cache.CacheContents",
    "certify": "spillover.certificate.Certificate",
    "commission": "commission.findings.CommissionFindings",
    "compare": "laws.document.LawsDocument",
    "comparison": "export.comparison.ComparedVariants",
    "fit": "fitting.document.FitDocument",
    "info": "config.CurrentSettings",
    "modes": "engine.modes.NamedModes",
    "paper": "papers.card.PaperOutcome",
    "sensitivity": "sweeps.documents.Sensitivity",
    "show": "sweeps.documents.Overview",
    "simulate": "single.documents.RunDocument",
    "summary": "result.Summary",
    "sweep": "sweeps.dry_run.PlanDocument",
    "twin": "twin.say.TwinDocument",
    "verify": "verify.result.ModelVerification",
}


def schema(command: str) -> dict[str, Any]:
    """JSON schema (2020-12) of the document that a command prints with --json, or writes.

    Args:
        command: such as "best"; "sweep" is the plan of `studies sweep --dry-run --json`,
            "certify" and "fit" are also `certificate.json` and `fit.json`; "summary" is of commands
            without a document of their own.

    Raises:
        StudyError: a command without one.
    """
    from studies.results.schema import schema_of

    if command not in DOCUMENTS:
        hint = nearest(str(command), list(DOCUMENTS))
        raise field_error("command", command, ", ".join(DOCUMENTS), hint=hint)
    module, _, name = DOCUMENTS[command].rpartition(".")
    return schema_of(getattr(import_module(f"studies.{module}"), name))
