"""The geometry of a study's mechanism from its fields, without JAX."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from studies.study.consistency import each_link
from studies.study.spec import Study


def machine_geometry(study: Study) -> tuple[Any, np.ndarray]:
    """`Geometry` of the mechanism, and the mass that moves with each near joint [kg], (3,)."""
    machine, mechanism = study.machine, MECHANISMS[study.machine.kind]
    written = machine.kinds.get(mechanism.name, {})
    own = {x.name: each_link(written.get(x.name, x.default)) for x in mechanism.parameters}
    body = np.radians(machine.joint_angles_deg) if machine.joint_angles_deg else None
    numbers = {
        "guide_side": machine.guide_side,
        "guide_angle": np.radians(machine.guide_angles_deg),
        "guide_offset": each_link(machine.guide_offsets),
        "joint_radius": each_link(machine.joint_radius),
        "joint_angle": np.array(ASSEMBLIES[machine.assembly]) if body is None else body,
        "slider_mass": each_link(machine.slider_mass),
    }
    geometry, near_mass = mechanism.build(own, numbers, np)
    return geometry, np.asarray(near_mass)
