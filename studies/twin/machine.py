"""The machine of a study as plain numbers, for a multibody code that knows nothing of this one.

`describe_machine(structure, case)` collects what a workshop drawing would say: rails and cranks,
masses, sections of the links piece by piece, ends and constants of the patches. No modal basis is
in it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.case import Case, Structure
from jaxmodel.mechanisms.carriers import Carrier
from jaxmodel.parameters import Array, Beam, Damping, Machine, Patches
from jaxmodel.piezo import actuator_constant, patch_ends, sensor_constant
from jaxmodel.static import link_pieces, section_stiffness

#: Cuts of a link closer than this share of its length are one [1].
SAME_CUT = 1e-6


class LinkSections(NamedTuple):
    """Constant data of the pieces of one link, (n,) each, from B to C."""

    right: np.ndarray  # where a piece ends [m]
    bending: np.ndarray  # E I [N m2]
    axial: np.ndarray  # E A [N]
    line_mass: np.ndarray  # rhoA [kg/m]


class Link(NamedTuple):
    """One flexible link, its patches and its damping."""

    length: float  # [m]
    sections: LinkSections
    joint_inertia: tuple[float, float]  # J_B, J_C at its ends [kg m2]
    sensor_ends: np.ndarray  # from joint B [m], (K, 2)
    actuator_ends: np.ndarray  # [m], (K, 2)
    sensor_constant: float  # lambda_s [V/rad]
    actuator_constant: float  # lambda_a [N m/V]
    damping: Damping  # ratios of its modes between held ends, arrays of one link: (1, n), (1,), ()


class PlatformBody(NamedTuple):
    """The rigid platform with its payload."""

    mass: float  # [kg]
    inertia: float  # about the centre of mass [kg m2]
    center: np.ndarray  # of mass, in the platform's axes from its reference point [m], (2,)
    joints: np.ndarray  # C_i in the platform's axes from its reference point [m], (n, 2)


class PlatformPoint(NamedTuple):
    """A point with mass, in which all links end."""

    mass: float  # [kg]


Platform = PlatformBody | PlatformPoint


class MachineData(NamedTuple):
    """A whole machine, leg by leg."""

    carriers: tuple[Carrier, ...]
    links: tuple[Link, ...]
    platform: Platform
    is_locked: bool  # drives held


def describe_machine(structure: Structure, case: Case) -> MachineData:
    """Plain numbers of a case's machine.

    Patches count as mass and stiffness where they do in the modal basis of the plant.

    Args:
        structure: static choices.
        case: the numbers.
    """
    machine, has_patches = case.machine, BASES[structure.basis].has_patches
    return MachineData(
        carriers=machine.geometry.carriers(machine.masses.slider_mass),
        links=tuple(_link(machine, i, has_patches) for i in range(machine.n_links)),
        platform=_platform(machine),
        is_locked=bool(np.any(case.drive.is_locked)),
    )


def _platform(machine: Machine) -> Platform:
    masses, arms = machine.masses, machine.geometry.arms(np)
    own, payload = (float(np.asarray(x)) for x in (masses.platform_mass, masses.payload_mass))
    if arms is None:
        return PlatformPoint(own + payload)
    offset = np.zeros(2) if masses.payload_offset is None else np.asarray(masses.payload_offset)
    center = payload / (own + payload) * offset
    apart = own * payload / (own + payload) * float(offset @ offset)
    inertia = float(np.asarray(masses.platform_inertia) + np.asarray(masses.payload_inertia))
    return PlatformBody(
        mass=own + payload,
        inertia=inertia + apart,
        center=center,
        joints=np.stack(arms, axis=1),
    )


def _link(machine: Machine, i: int, has_patches: bool) -> Link:
    def own(value: Array) -> float:
        return float(np.broadcast_to(np.asarray(value), (machine.n_links,))[i])

    beam = Beam._make(map(own, machine.beam))
    every = machine.patches._asdict()
    center = np.asarray(every.pop("center"))[i]
    patches = Patches(center=center, **{name: own(value) for name, value in every.items()})
    damping = machine.damping
    return Link(
        length=beam.length,
        sections=_sections(beam, patches, has_patches),
        joint_inertia=(beam.joint_inertia_b, beam.joint_inertia_c) if has_patches else (0.0, 0.0),
        sensor_ends=_ends(patches, patches.sensor_length, beam.length),
        actuator_ends=_ends(patches, patches.actuator_length, beam.length),
        sensor_constant=float(sensor_constant(beam, patches)),
        actuator_constant=float(actuator_constant(beam, patches)),
        damping=Damping(
            np.asarray(damping.ratio)[i : i + 1],
            np.asarray(damping.count)[i : i + 1],
            np.asarray(damping.exponent),
        ),
    )


def _ends(patches: Patches, size: float, length: float) -> np.ndarray:
    return np.clip(np.stack(patch_ends(patches.center, size), axis=1), 0.0, length)


def _sections(beam: Beam, patches: Patches, has_patches: bool) -> LinkSections:
    pieces = link_pieces(beam, patches._replace(center=jnp.asarray(patches.center)))
    bending = section_stiffness(beam, patches, pieces, has_patches)
    covers = np.asarray(jnp.sum(pieces.has_ceramic + pieces.has_actuator, axis=0))
    covers = covers if has_patches else 0 * covers
    area, patch_area = beam.width * beam.thickness, patches.width * patches.thickness
    axial = beam.youngs_modulus * area + patches.youngs_modulus * patch_area * covers
    line_mass = beam.density * area + patches.density * patch_area * covers
    left, right = np.asarray(pieces.left), np.asarray(pieces.right)
    is_there = right - left > SAME_CUT * beam.length
    return LinkSections(
        right=right[is_there],
        bending=np.asarray(bending)[is_there],
        axial=axial[is_there],
        line_mass=line_mass[is_there],
    )
