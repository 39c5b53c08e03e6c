from .bases import find_bases
from .beam import BASES, build_basis
from .case import Case, Structure
from .control import efficient_modal_control, pole_placement
from .defaults import HOME, paper_case, paper_machine
from .dynamics import accelerations, kinetic_energy, potential_energy
from .equations import equations_of_motion, lumped_forces
from .judge import judge
from .kinematics import close_chain, inverse_kinematics
from .linear import frequency_response, linearise, natural_modes
from .loop import step
from .parameters import Machine
from .plant import build_plant
from .prepare import prepare
from .sampled_loop import closed_loop
from .shaper import ei, residual_vibration
from .simulate import RunResult, command, simulate

__all__ = [
    "BASES",
    "HOME",
    "Case",
    "Machine",
    "RunResult",
    "Structure",
    "accelerations",
    "build_basis",
    "build_plant",
    "close_chain",
    "closed_loop",
    "command",
    "efficient_modal_control",
    "ei",
    "equations_of_motion",
    "find_bases",
    "frequency_response",
    "inverse_kinematics",
    "judge",
    "kinetic_energy",
    "linearise",
    "lumped_forces",
    "natural_modes",
    "paper_case",
    "paper_machine",
    "pole_placement",
    "potential_energy",
    "prepare",
    "residual_vibration",
    "simulate",
    "step",
]
