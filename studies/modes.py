"""`studies modes`: natural modes of the assembled machine at a pose."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.kinematics import path_status
from jaxmodel.linear import NaturalModes, linearise, natural_modes, resting
from jaxmodel.prepare import prepare
from studies.cases import as_arrays, build_case, build_structure
from studies.runs import check_pose
from studies.spec import Study, parse_study


def modes_study(
    pose: tuple[float, float, float] | None,
    kp: float,
    kd: float,
    damping: float,
    locked: bool,
    basis: str,
    n_modes: int,
) -> Study:
    """The study whose linearisation is wanted; bad values are refused as in a study file."""
    data: dict = {
        "link": {"basis": basis, "modes": n_modes, "damping_ratio": damping},
        "drive": {"kp": kp, "kd": kd, "locked": locked},
        "control": {"feedback": "none"},
        "shaper": {"kind": "none"},
    }
    if pose is not None:
        data["motion"] = {"waypoints": [list(pose)]}
    return parse_study(data)


def machine_modes(
    pose: tuple[float, float, float] | None = None,
    kp: float = 2e4,
    kd: float = 0.0,
    damping: float = 0.0,
    locked: bool = False,
    basis: str = "pinned_pinned",
    n_modes: int = 3,
) -> NaturalModes:
    """Natural modes of the machine held by its drive at a pose.

    Args:
        pose: (x, y, phi) [m, m, rad]; None: home.
        kp: drive stiffness [N/m].
        kd: drive damping [N s/m].
        damping: structural damping ratio [1].
        locked: sliders held.
        basis: modal basis of the links.
        n_modes: modes per link.

    Raises:
        StudyError: value out of range, pose out of reach or singular.
    """
    study = modes_study(pose, kp, kd, damping, locked, basis, n_modes)
    structure, case = build_structure(study), as_arrays(build_case(study))
    where = study.motion.waypoints[0]
    code, plant = _at_pose(structure, case, np.array(where))
    check_pose("pose", where, int(code))
    found = natural_modes(plant)
    if locked:  # the three coordinates that the sliders hold are no modes
        found = NaturalModes(found.frequency[3:], found.damping_ratio[3:], found.shape[:, 3:])
    return found


@partial(jax.jit, static_argnums=0)
def _at_pose(structure: Structure, case: Case, pose: np.ndarray):
    loop = prepare(structure, case).loop
    code, _ = path_status(loop.plant, pose[None])
    return code, linearise(structure, loop, pose, resting(structure, case))
