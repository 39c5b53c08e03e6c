"""Programs of the model that tests of several files share, kept on disk like those of the engine.

Functions of the packages only: what is kept is found by the packages' code, not by that of tests.
"""

from __future__ import annotations

from typing import Any

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.nominal_loop import nominal_loop
from jaxmodel.prepare import ControllerDesign, design_controller, prepare
from jaxmodel.sampled_loop import closed_loop, sampled_plant
from jaxmodel.simulate import simulate
from studies.engine.programs import kept_jit
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study

simulated = kept_jit(static_argnums=(0, 2))(simulate)


def _without_run(function: Any) -> Any:
    """A program of a structure and numbers that does not differ by a run's length and noise."""
    program = kept_jit(static_argnums=0)(function)
    return lambda structure, *numbers: program(alike(structure), *numbers)


def alike(structure: Structure) -> Structure:
    return structure._replace(n_steps=1, has_noise=False, metrics=())


prepared = _without_run(prepare)
loop_at = _without_run(closed_loop)
plant_at = _without_run(sampled_plant)
nominal_of = _without_run(nominal_loop)
bases_of = _without_run(find_bases)
_design = _without_run(design_controller)


def arrays(study: Study) -> tuple[Structure, Case]:
    return build_structure(study), as_arrays(build_case(study))


def without_run(study: Study) -> tuple[Structure, Case]:
    """As `arrays`, of one sample."""
    structure, case = arrays(study)
    return structure._replace(n_steps=1), case


def design_of(structure: Structure, case: Case) -> ControllerDesign:
    """Controller, and the nominal model that it is designed for."""
    found: Any = _design(structure, case, bases_of(structure, case))
    return found
