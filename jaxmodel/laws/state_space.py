"""A controller from a file: any linear system from sensors to actuators."""

from __future__ import annotations

from jaxmodel.case import Case, Structure
from jaxmodel.laws.contract import Law, NominalModel, system_feedback
from jaxmodel.state_space import StateSpace


def design(structure: Structure, case: Case, nominal: NominalModel) -> StateSpace:
    """The given system."""
    assert case.control.system is not None
    return system_feedback(structure, case, case.control.system)


STATE_SPACE = Law("state_space", "controller from a file", "none", design, has_position=False)
