"""Mechanics of the study's machine: Lagrangian, closure, structural damping."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.beam import BASES, ModalBasis
from jaxmodel.case import Case, Structure
from jaxmodel.kinematics import link_direction, path_status
from jaxmodel.loop import Loop
from jaxmodel.parameters import Machine
from jaxmodel.plant import Plant, build_plant, lengthening
from jaxmodel.prepare import stretch_of
from studies.engine.programs import kept_jit
from studies.reference.lagrangian import (
    Loads,
    RigidState,
    by_lagrangian,
    closed_form,
    link_tips,
    platform_joints,
)
from studies.study.spec import Study
from studies.verify.prepared import prepared
from studies.verify.rows import Assumption, largest, worst

#: Random states.
_STATES = 24


def check_machine(study: Study) -> list[Assumption]:
    """Accelerations, closure and damping ratios."""
    structure, case, (loop, bases, *_) = prepared(study)
    return [*_accelerations(study, structure, case, bases.plant), _damping(case, loop)]


@kept_jit(static_argnums=(0, 1))
def _plant(
    structure: Structure, is_distributed: bool, case: Case, basis: ModalBasis
) -> tuple[Plant, ModalBasis]:
    """A machine without structural damping, and the basis of all its coordinates."""
    machine, shortening = _undamped(case.machine), structure.has_shortening
    stretch = stretch_of(structure, case._replace(machine=machine))
    plant = build_plant(machine, basis, False, shortening, is_distributed, stretch, True)
    return plant, basis if stretch is None else lengthening(basis, stretch)


def _undamped(machine: Machine) -> Machine:
    none = jax.tree.map(jnp.zeros_like, machine.damping)
    return machine._replace(damping=none._replace(count=machine.damping.count))


def _accelerations(
    study: Study, structure: Structure, case: Case, whole: ModalBasis
) -> list[Assumption]:
    """At random states around the way-points, bent by up to 1 % and as fast as fast moves."""
    forms = {"lumped": False}
    if structure.has_shortening and BASES[structure.basis].is_on_chord:
        forms["distributed"] = True
    if not structure.has_shortening:
        whole = whole._replace(shortening=None, mixed_shortening=None)
    apart, open_by = {}, []
    for name, is_distributed in forms.items():
        basis = whole if is_distributed else whole._replace(inward=None, centrifugal=None)
        plant, basis = jax.tree.map(np.asarray, _plant(structure, is_distributed, case, basis))
        states = _random_states(study, plant, structure)
        found, wanted, gaps = map(np.asarray, _both(case.machine, basis, plant, states))
        parts = slice(structure.n_pose), slice(structure.n_pose, None)
        pairs = [(row[p], true[p]) for row, true in zip(found, wanted, strict=True) for p in parts]
        apart[name] = worst(*(largest(row, true) for row, true in pairs))
        open_by.append(gaps)
    coupled = "" if structure.is_coupled else "run.model is ked"
    rows = [
        Assumption(
            assumption=f"accelerations of platform and modes (1)-(9), {name} axial inertia",
            against=f"the Lagrangian differentiated, {_STATES} random states of this machine",
            source="Lagrange 1788; Kane and Levinson 1985",
            difference=difference,
            allowed=1e-9,
            left_out=coupled,
        )
        for name, difference in apart.items()
    ]
    closure = Assumption(
        assumption="closure of drive, bent link and platform (6)",
        against="both ways to the joints, over the link's length",
        source="Zhang, Mills and Cleghorn 2016",
        difference=worst(*open_by) / float(np.max(case.machine.beam.length)),
        allowed=1e-12,
    )
    return [*rows, closure]


def _random_states(study: Study, plant: Plant, structure: Structure) -> tuple[RigidState, Loads]:
    rng = np.random.default_rng(7)
    length = float(np.min(study.link.length))
    points = np.array(study.motion.waypoints, float)
    poses: list[np.ndarray] = []
    links, pose_size = study.n_links, study.n_pose
    scale = np.array([0.05 * length, 0.05 * length, 0.05][:pose_size])
    for _ in range(50 * _STATES):
        pose = points[len(poses) % len(points)] + scale * rng.uniform(-1, 1, pose_size)
        if int(_status(plant, pose)) == 0:
            poses.append(pose)
        if len(poses) == _STATES:
            break
        scale = scale * 0.98  # way-points may lie at the edge of what is in reach
    # an elongation counts as a mode too high to move it far
    count, order = len(poses), np.arange(1, structure.n_modes + 1)
    n_modes = structure.n_coordinates
    order = np.append(order, [10.0] * structure.has_stretch)
    motion = RigidState(
        pose=np.array(poses),
        pose_rate=rng.normal(size=(count, pose_size)) * [0.3, 0.3, 1.0][:pose_size],
        q=0.01 * length * rng.uniform(-1, 1, (count, links, n_modes)) / order**2,
        q_rate=rng.normal(size=(count, links, n_modes)) / order,
    )
    return motion, Loads(10 * rng.normal(size=(count, links)), 3 * rng.normal(size=motion.q.shape))


@kept_jit()
def _status(plant: Plant, pose: Any) -> Any:
    return path_status(plant, pose[None])[0]


@kept_jit()
def _both(machine: Machine, basis: ModalBasis, plant: Plant, states: Any) -> Any:
    """Accelerations by `jaxmodel` and by the Lagrangian, (n, 3 + 3 R); gaps at the joints [m]."""
    machine = _undamped(machine)

    def one(motion: RigidState, loads: Loads) -> Any:
        chain, found = closed_form(plant, motion, loads)
        pose, modal = by_lagrangian(machine, basis, motion, loads)
        tips = link_tips(machine, basis, chain.rho, link_direction(chain), motion.q)
        gap = jnp.abs(tips - platform_joints(machine.geometry, motion.pose)).max()
        joined = [
            jnp.concatenate([a, b.ravel()]) for a, b in ((found.pose, found.modal), (pose, modal))
        ]
        return *joined, gap

    return jax.vmap(one)(*states)


def _damping(case: Case, loop: Loop) -> Assumption:
    """Ratios of the link modes as given, continued by the damping law."""
    given = jax.tree.map(np.asarray, case.machine.damping)
    ratio, exponent = given.ratio, given.exponent
    wanted = np.empty_like(loop.omega)
    for i in range(len(loop.omega)):
        count = int(given.count[i])
        for j in range(loop.omega.shape[1]):
            last = min(j, count - 1)
            share = loop.omega[i, j] / loop.omega[i, last]
            wanted[i, j] = ratio[i, last] * share**exponent
    count = wanted.shape[1]
    plant = loop.plant
    critical = 2 * np.sqrt(plant.stiffness[:, :count] * plant.modal_mass[:, None])
    return Assumption(
        assumption="structural damping of the links' modes",
        against="damping over twice the square root of stiffness and mass",
        source="Rayleigh 1877",
        difference=largest(plant.damping[:, :count] / critical, wanted),
        allowed=1e-9,
    )
