"""The geometry of a study's mechanism, and where its platform's joints are, without JAX."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from jaxmodel.table import PartError
from studies.study.paths import field_value, own_fields
from studies.study.spec import OWN_MECHANISMS, Study


def build_geometry(
    kind: str, number: Callable[[str], Any], joint_angle: Any, xp: Any
) -> tuple[Any, Any]:
    """`Geometry` of a mechanism, and the mass that moves with each near joint [kg].

    Args:
        kind: name of the mechanism.
        number: value of a field in its unit.
        joint_angle: of the platform's joints in its own axes [rad], (..., n).
        xp: NumPy or `jax.numpy`.
    """
    mechanism = MECHANISMS[kind]
    own = {
        name.rpartition(".")[2]: number(name) for name in own_fields(OWN_MECHANISMS, [mechanism])
    }
    machine = {
        "guide_side": number("machine.guide_side"),
        "guide_angle": xp.radians(number("machine.guide_angles_deg")),
        "guide_offset": number("machine.guide_offsets"),
        "joint_radius": number("machine.joint_radius"),
        "joint_angle": joint_angle,
        "slider_mass": number("machine.slider_mass"),
    }
    geometry, near_mass = mechanism.build(own, machine, xp)
    _check_axes(mechanism.name, geometry, [*own.values(), *machine.values()])
    return geometry, near_mass


def _check_axes(kind: str, geometry: Any, given: list[Any]) -> None:
    """Raise PartError for an array that ignores the axis of cases, which would be read as one."""
    if np.ndim(given[-1]) < 2:
        return
    known = {1, *(np.shape(x)[0] for x in given)}
    for name, value in zip(geometry._fields, geometry, strict=True):
        shape = np.shape(value)
        if not shape or shape[0] not in known:
            raise PartError(
                f"mechanism {kind!r}: {name} of its geometry has shape {shape}; expected an axis "
                "of cases first, as what it is built from has"
            )


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
