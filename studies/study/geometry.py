"""The geometry of a study's mechanism, and where its platform's joints are, without JAX."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from jaxmodel.numbers import build_geometry
from studies.study.paths import field_value
from studies.study.spec import Study


def machine_geometry(study: Study) -> tuple[Any, np.ndarray]:
    """The same of a study."""
    machine = study.machine
    body = np.radians(machine.joint_angles_deg) if machine.joint_angles_deg else None
    angle = np.array(ASSEMBLIES[machine.assembly]) if body is None else body

    def number(name: str) -> Any:
        value = field_value(study, name)
        return value if name == "machine.guide_side" else study.each_link(value)

    geometry, near_mass = build_geometry(machine.kind, number, angle, np)
    return geometry, np.asarray(near_mass)


def far_joints(geometry: Any, pose: Any, n_links: int) -> tuple[np.ndarray, np.ndarray]:
    """Far joints C at a pose.

    Args:
        geometry: the mechanism's.
        pose: (x, y, phi) or (x, y) [m, m, rad], (p,).
        n_links: n.

    Returns:
        C [m], (n, 2); its derivatives by the pose [1, 1, m], (n, 2, p).
    """
    place, turn = np.asarray(pose[:2], float), np.asarray(pose[2:], float)
    arms, plane = geometry.arms(np), np.tile(np.eye(2), (n_links, 1, 1))
    if arms is None:
        return np.tile(place, (n_links, 1)), plane
    (x, y), sine, cosine = arms, np.sin(turn[0]), np.cos(turn[0])
    arm = np.stack([x * cosine - y * sine, y * cosine + x * sine], axis=1)
    turned = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    return place + arm, np.concatenate([plane, turned[:, :, None]], axis=2)
