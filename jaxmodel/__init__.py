"""Model of a planar 3-PRR parallel robot with three flexible links: pure functions on pytrees.

Data flow: `Machine` and `Case` (physical numbers) -> `prepare` (matrices, coefficients) ->
`command` (shaped reference, noise) -> `step` per sample (controller, plant, metrics, status) ->
`Result`. Importing this package has no effect; set precision and devices before the first call.
"""

from jaxmodel.bases import find_bases
from jaxmodel.beam import BASES, build_basis
from jaxmodel.case import Case, Structure
from jaxmodel.control import efficient_modal_control, pole_placement
from jaxmodel.dynamics import accelerations, kinetic_energy, potential_energy
from jaxmodel.kinematics import close_chain, inverse_kinematics
from jaxmodel.linear import frequency_response, linearise, natural_modes
from jaxmodel.loop import step
from jaxmodel.parameters import HOME, Machine, paper_machine
from jaxmodel.plant import build_plant
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import closed_loop
from jaxmodel.simulate import Result, command, simulate

__all__ = [
    "BASES",
    "HOME",
    "Case",
    "Machine",
    "Result",
    "Structure",
    "accelerations",
    "build_basis",
    "build_plant",
    "close_chain",
    "closed_loop",
    "command",
    "efficient_modal_control",
    "find_bases",
    "frequency_response",
    "inverse_kinematics",
    "kinetic_energy",
    "linearise",
    "natural_modes",
    "paper_machine",
    "pole_placement",
    "potential_energy",
    "prepare",
    "simulate",
    "step",
]
