"""The chosen controller, as fixed numbers, on machines that the data leave possible."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from studies.engine.controller import fixed_controller
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.study.cases import build_case, build_structure
from studies.study.paths import set_values
from studies.study.spec import Study, parse_study

MODULUS, STIFFNESS = "link.youngs_modulus", "link.stiffness_factor"


class Possible(NamedTuple):
    """Machines that the data leave possible."""

    names: tuple[str, ...]  # fields of the study
    values: np.ndarray  # on each machine, in the fields' units, (n, p)

    def machine(self, study: Study, k: int) -> Study:
        """The study with machine k in place of its own.

        Raises:
            StudyError: it has no such machine.
        """
        row = [float(x) for x in self.values[k]]
        return parse_study(set_values(study, dict(zip(self.names, row, strict=True))))


def unknown_to_controller(possible: Possible, study: Study) -> dict[str, list[float]]:
    """The machines by field, as deviations that a controller of the fitted study does not know.

    Young's modulus belongs to the controller's model: another one is written as stiffness factor.

    Args:
        possible: the machines.
        study: the fitted one.
    """
    columns = {}
    for name, column in zip(possible.names, possible.values.T, strict=True):
        field, bracket, index = name.partition("[")
        if name.startswith("control."):
            continue
        if field == MODULUS:
            link = int(index.rstrip("]")) if bracket else 0
            factor, modulus = (
                study.each_link(x)[link]
                for x in (study.link.stiffness_factor, study.link.youngs_modulus)
            )
            column = factor * column / modulus
            name = STIFFNESS + bracket + index
        columns[name] = [float(f"{x:.9g}") for x in column]
    return columns


def margin_spread(possible: Possible, study: Study) -> float:
    """Gain margin of a study's fixed controller on its own machine over the least on others [1].

    1 where the controller is not stable on all of them, or more so on the others.

    Args:
        possible: the others.
        study: of controller and machine.
    """
    own = Possible((), np.zeros((1, 0)))
    nominal, least = margins_on(own, study)[0], margins_on(possible, study).min(initial=np.inf)
    return max(float(nominal / least), 1.0) if least > 0 else 1.0


def margins_on(possible: Possible, study: Study) -> np.ndarray:
    """Gain margin of a study's fixed controller on every machine [1], 0 where it has no loop, (n,).

    With at least `studies.study.margin.MARGIN_MODES` modes a link.

    Args:
        possible: the machines.
        study: of the controller.
    """
    law = jax.tree.map(jnp.asarray, fixed_controller(study).controller)
    home, margins = np.array(study.motion.waypoints[0], float), np.zeros(len(possible.values))
    for k in range(len(margins)):
        try:
            machine = possible.machine(study, k)
            structure = build_structure(machine)._replace(has_position_gain=False)
            loop = loop_report(structure, build_case(machine), home, 1, law=law)
        except (StudyError, np.linalg.LinAlgError):
            continue
        margins[k] = loop.gain_margin if loop.is_stable else 0.0
    return margins
