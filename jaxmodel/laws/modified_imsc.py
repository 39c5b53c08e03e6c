"""Modified IMSC (Baz and Poh 1988): the actuators of a link serve one mode at a time.

The mode with the highest modal energy (omega q)^2 + q'^2 is served; it may change at every sample
(`jaxmodel.channels.strongest`).
"""

from __future__ import annotations

from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.laws.contract import Law, NominalModel, modal_feedback
from jaxmodel.laws.poles import modal_gains
from jaxmodel.lazy import jnp


def design(structure: Structure, case: Case, nominal: NominalModel) -> Channels:
    """As IMSC; modes with gains are rivals."""
    velocity, position = modal_gains(structure, case, nominal)
    is_on = (velocity != 0) | (position != 0)
    rival_omega = jnp.where(is_on, nominal.omega, 0.0)
    return modal_feedback(case, nominal, velocity, position, rival_omega=rival_omega)


MODIFIED_IMSC = Law(
    "modified_imsc",
    "modified IMSC",
    "mode",
    design,
    has_position=False,
    places_poles=True,
    is_switching=True,
)
