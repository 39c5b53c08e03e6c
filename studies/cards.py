"""Results as notebooks show them: `_repr_html_` calls `card` through `studies.publish.shown`."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from studies.show import pages

#: Module with the function `say`, by the name of the result's type.
SAY = {
    "Certificate": "studies.spillover.say",
    "CommissionFindings": "studies.commission.say",
    "ComparedVariants": "studies.export.comparison",
    "Exported": "studies.export.say",
    "Fitted": "studies.fitting.say",
    "LawFindings": "studies.laws.say",
    "NamedModes": "studies.single.modes",
    "Outcome": "studies.sweeps.say",
    "Run": "studies.single.say",
    "TuneFindings": "studies.tuning.say",
}


def card(result: Any) -> str:
    """A result as HTML, whose texts are shown as they are.

    Args:
        result: of a type in SAY.
    """
    return pages.card(import_module(SAY[type(result).__name__]).say(result))
