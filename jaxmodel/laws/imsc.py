"""Independent modal space control, (20)-(24): every mode has its own gains."""

from __future__ import annotations

from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.laws.contract import Law, NominalModel, modal_feedback
from jaxmodel.laws.poles import modal_gains


def design(structure: Structure, case: Case, nominal: NominalModel) -> Channels:
    """Gains of mode 1 and ratios (24), by modal filter and synthesizer."""
    return modal_feedback(case, nominal, *modal_gains(structure, case, nominal))


IMSC = Law("imsc", "IMSC", "mode", design, has_position=False, places_poles=True)
