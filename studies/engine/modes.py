"""`studies modes`: natural modes of the assembled machine at a pose."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.kinematics import lift, path_status
from jaxmodel.linear import NaturalModes, linearise, natural_modes, resting
from jaxmodel.prepare import prepare
from studies.engine.runs import check_pose
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study, parse_study


def modes_study(
    study: Study | None = None,
    pose: tuple[float, float, float] | None = None,
    kp: float | None = None,
    kd: float | None = None,
    damping: float | None = None,
    locked: bool | None = None,
    basis: str | None = None,
    n_modes: int | None = None,
) -> Study:
    """The study to linearise; bad values are rejected as in a study file."""
    undamped = {"link": {"modes": 3, "damping_ratio": 0.0}, "drive": {"kd": 0.0}}
    data: dict[str, Any] = (
        undamped if study is None else study.model_dump(mode="json", exclude_unset=True)
    )
    if pose is not None:
        data["motion"] = {"waypoints": [list(pose)]}
    given = (
        ("link", "basis", basis),
        ("link", "modes", n_modes),
        ("link", "damping_ratio", damping),
        ("drive", "kp", kp),
        ("drive", "kd", kd),
        ("drive", "locked", locked),
        ("control", "feedback", "none"),
        ("shaper", "kind", "none"),
    )
    for section, name, value in given:
        if value is not None:
            data[section] = data.get(section, {}) | {name: value}
    return parse_study(data)


def machine_modes(study: Study | None = None, **changes: Any) -> NaturalModes:
    """Natural modes of the machine held by its drive at a pose, under the study's steady load.

    Args:
        study: supplies machine and damping, at its first way-point; None: the paper's machine at
            home with three modes per link, undamped.
        changes: overrides, by the names of `modes_study`.

    Raises:
        StudyError: value out of range, pose out of reach or singular.
    """
    study = modes_study(study, **changes)
    structure, case = build_structure(study), as_arrays(build_case(study))
    where = study.motion.waypoints[0]
    code, lifts, plant = _at_pose(structure, case, np.array(where))
    check_pose(study, "pose", where, int(code), np.asarray(lifts))
    found = natural_modes(plant)
    if study.drive.locked:  # the three coordinates held by the sliders are not modes
        found = NaturalModes(found.frequency[3:], found.damping_ratio[3:], found.shape[:, 3:])
    return found


@partial(jax.jit, static_argnums=0)
def _at_pose(structure: Structure, case: Case, pose: np.ndarray) -> Any:
    loop = prepare(structure, case).loop
    code, _ = path_status(loop.plant, pose[None])
    return code, lift(loop.plant, pose), linearise(structure, loop, pose, resting(structure, case))
