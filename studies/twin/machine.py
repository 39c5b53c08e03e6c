"""The machine of a study as plain numbers, for a multibody code that knows nothing of this one.

`describe_machine(structure, case)` collects what a workshop drawing would say: rails and cranks,
masses, sections of the links piece by piece, ends and constants of the patches. No modal basis is
in it, and laminates and patches are its own arithmetic: a section is layers of beam and ceramic
about their common neutral axis; an actuator pushes with F = b_p E_p |d31| per volt at its distance
from it, and a sensor's charge is F times what it lengthens at its own mid-plane.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.case import Case, Structure
from jaxmodel.mechanisms.carriers import Carrier
from jaxmodel.parameters import Array, Beam, Damping, Machine, Patches
from jaxmodel.piezo import VACUUM_PERMITTIVITY
from jaxmodel.stretch import REFERENCE

#: Cuts of a link closer than this share of its length are one [1].
SAME_CUT = 1e-6


class LinkSections(NamedTuple):
    """Constant data of the pieces of one link, (n,) each, from B to C."""

    right: np.ndarray  # where a piece ends [m]
    bending: np.ndarray  # E I [N m2]
    axial: np.ndarray  # E A [N]
    line_mass: np.ndarray  # rhoA [kg/m]
    moment: np.ndarray  # of each actuator there [N m/V], (K, n)


class Link(NamedTuple):
    """One flexible link, its patches and its damping."""

    length: float  # [m]
    sections: LinkSections
    joint_inertia: tuple[float, float]  # J_B, J_C at its ends [kg m2]
    sensor_ends: np.ndarray  # from joint B [m], (K, 2)
    actuator_ends: np.ndarray  # [m], (K, 2)
    factors: tuple[np.ndarray, ...]  # true over nominal of sensors, and of actuators [1], (K,) each
    sensor_constant: float  # lambda_s [V/rad]
    actuator_constant: float  # lambda_a [N m/V], where no sensor is opposite
    push: float  # of an actuator along the link [N/V]; 0: none
    membrane: float  # of a sensor, less for each metre it gets longer with the link [V/m]
    retardation: float  # of the link in tension, damper over spring [s]
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
        links=tuple(
            _link(machine, i, has_patches, structure.has_stretch) for i in range(machine.n_links)
        ),
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


def _link(machine: Machine, i: int, has_patches: bool, has_stretch: bool) -> Link:
    def own(value: Array) -> float:
        return float(np.broadcast_to(np.asarray(value), (machine.n_links,))[i])

    beam = Beam._make(map(own, machine.beam))
    every = machine.patches._asdict()
    center, *factors = (
        np.broadcast_to(np.asarray(every.pop(name)), np.shape(machine.patches.center))[i]
        for name in ("center", "sensor_factor", "actuator_factor")
    )
    patches = Patches(center=center, **{name: own(value) for name, value in every.items()})
    damping = machine.damping
    arm = (beam.thickness + patches.thickness) / 2
    force = patches.width * patches.youngs_modulus * abs(patches.d31)
    neutral = _laminate(beam, patches, np.array([patches.is_paired]), np.ones(1))[2].item()
    constant = force * (1 + patches.is_paired) * (arm + neutral)
    if patches.is_gauge:
        arm = beam.thickness / 2 - neutral
        volts = patches.bridge * patches.gauge_factor / patches.sensor_length
    else:
        volts = force / _capacitance(patches)
    sensors, actuators = (
        np.clip(center[:, None] + np.array([-0.5, 0.5]) * size, 0.0, beam.length)
        for size in (patches.sensor_length, patches.actuator_length)
    )
    own_push = force * has_stretch * (1 - patches.is_paired)
    return Link(
        length=beam.length,
        sections=_sections(
            beam,
            patches,
            (sensors, actuators),
            constant,
            own_push if has_patches else 0,
            has_patches,
        ),
        joint_inertia=(beam.joint_inertia_b, beam.joint_inertia_c) if has_patches else (0.0, 0.0),
        sensor_ends=sensors,
        actuator_ends=actuators,
        factors=tuple(factors),
        sensor_constant=volts * arm,
        actuator_constant=constant,
        push=own_push,
        membrane=volts * has_stretch,
        retardation=2 * own(damping.stretch) / REFERENCE * has_stretch,
        damping=Damping(
            np.asarray(damping.ratio)[i : i + 1],
            np.asarray(damping.count)[i : i + 1],
            np.asarray(damping.exponent),
        ),
    )


def _capacitance(patches: Patches) -> float:
    """Of a sensor that is clamped [F]."""
    free = patches.relative_permittivity * VACUUM_PERMITTIVITY
    clamped = free - patches.d31**2 * patches.youngs_modulus
    return float(clamped * patches.width * patches.sensor_length / patches.thickness)


def _laminate(
    beam: Beam, patches: Patches, above: np.ndarray, below: np.ndarray
) -> tuple[np.ndarray, ...]:
    """A link's section with ceramic on its faces.

    Args:
        beam, patches: one link's numbers.
        above, below: layers on the face of sensors, and on that of actuators, 0 or 1, (n,).

    Returns:
        (E A [N], E I [N m2], height of the neutral axis over the link's mid-plane [m]), (n,) each.
    """
    height = (beam.thickness + patches.thickness) / 2 * np.array([0.0, 1.0, -1.0])
    depth = np.array([beam.thickness, patches.thickness, patches.thickness])
    ceramic = patches.youngs_modulus * patches.width
    layers = np.stack([np.ones_like(above), above, below], axis=1)
    axial = layers * depth * [beam.youngs_modulus * beam.width, ceramic, ceramic]
    whole = axial.sum(axis=1)
    neutral = axial @ height / whole
    bending = axial * ((height - neutral[:, None]) ** 2 + depth**2 / 12)
    return whole, bending.sum(axis=1), neutral


def _sections(
    beam: Beam,
    patches: Patches,
    ends: tuple[np.ndarray, np.ndarray],
    constant: float,
    push: float,
    has_patches: bool,
) -> LinkSections:
    """Between the ends of sensors and actuators; push: what acts at a neutral axis of its own."""
    cuts = np.sort(np.concatenate([[0.0, beam.length], *(x.ravel() for x in ends)]))
    is_there = np.diff(cuts) > SAME_CUT * beam.length
    right, middle = cuts[1:][is_there], ((cuts[1:] + cuts[:-1]) / 2)[is_there]
    seen, driven = (1.0 * ((x[:, :1] < middle) & (middle < x[:, 1:])) for x in ends)
    above = np.maximum(seen * (1 - patches.is_gauge), driven * patches.is_paired).max(axis=0)
    above, below = above * has_patches, driven.max(axis=0) * has_patches
    axial, bending, neutral = _laminate(beam, patches, above, below)
    arm = (beam.thickness + patches.thickness) / 2
    ceramic = patches.density * patches.width * patches.thickness
    return LinkSections(
        right=right,
        bending=beam.stiffness_factor * bending,
        axial=beam.stiffness_factor * axial,
        line_mass=beam.density * beam.width * beam.thickness + ceramic * (above + below),
        moment=driven * (push * (arm + neutral) if push else constant),
    )
