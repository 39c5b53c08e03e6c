"""Energies of free vibrations of many machines, with none, one or all of their links controlled.

Plants are those of `jaxmodel.linear` with ideal feedback: x' = A x. What follows a start b has the
energy int y'y dt = b'Pb of an output y = C x, where A'P + PA + C'C = 0. The Cayley transform
F = (1 - hA)^-1 (1 + hA) makes this a sum over powers of F, which doubling sums: unlike
eigenvectors it does not mind links that are nearly alike.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import status
from jaxmodel.case import Case, Structure
from jaxmodel.kinematics import path_status
from jaxmodel.linear import linearise
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from studies.engine.programs import kept_jit
from studies.study.cases import build_cases, build_structure
from studies.study.fields import Columns
from studies.study.spec import Study

#: Controlled links: none, one of them, all.
MASKS = np.vstack([np.zeros(3), np.eye(3), np.ones(3)])
NONE, ALONE, ALL = 0, slice(1, 4), 4
#: Outputs: bending of links 1 to 3 at mid-span [m], place [m] and turn [rad] of the platform.
LINKS, PLACE, TURN = slice(0, 3), 3, 4
#: Starts: links 1 to 3 plucked into their first mode by 1 m; impulses of 1 N s on the drives.
PLUCKED, PUSHED = slice(0, 3), slice(3, 6)
#: What follows an impulse of the drives counts from here on, when they have settled [s].
SETTLED = 0.05
#: Doublings of the sum: 2^24 steps, of which a mode with damping ratio 1e-5 needs 2^20.
DOUBLINGS = 24
#: Machines per call of the compiled program.
_BATCH = 256


class Energies(NamedTuple):
    """Leading axis: machines."""

    is_feasible: np.ndarray  # pose in reach, all loops stable, (n,)
    value: np.ndarray  # by MASKS, outputs, starts [m2 s or rad2 s], (n, 5, 5, 6)
    state: np.ndarray  # A by MASKS [1/s and mixed], (n, 5, s, s)
    omega: np.ndarray  # first mode of the links between held ends [rad/s], (n, 3)


def free_energies(study: Study, columns: Columns, poses: np.ndarray, n_modes: int) -> Energies:
    """Energies of machines that differ in some fields.

    Args:
        study: values of all other fields.
        columns: values of these, one per machine (see `studies.study.fields`).
        poses: [m, m, rad], (n, 3).
        n_modes: per link.
    """
    study = study.change(
        control__feedback="ideal",
        control__modes=1,
        link__modes=n_modes,
        metrics__stations=(0.5,),
    )
    structure = build_structure(study, columns)._replace(n_steps=1, n_frequencies=1)
    cases = build_cases(study, columns, structure)
    count = len(poses)
    cases = jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x)[1:])), cases)
    parts = []
    for start in range(0, count, _BATCH):
        rows = np.minimum(np.arange(start, start + _BATCH), count - 1)
        batch = jax.tree.map(lambda x: x[rows], cases)  # noqa: B023
        found = _energies(structure, batch, poses[rows])
        parts.append([np.asarray(x)[: count - start] for x in found])
    return Energies(*(np.concatenate(part) for part in zip(*parts, strict=True)))


@kept_jit(static_argnums=0)
def _energies(structure: Structure, cases: Case, poses: Array) -> tuple[Array, ...]:
    def one(case: Case, pose: Array) -> tuple[Array, ...]:
        def controlled(mask: Array) -> tuple[Array, Array]:
            control = case.control._replace(link_mask=mask)
            loop = prepare(structure, case._replace(control=control)).loop
            plant = linearise(structure, loop, pose)
            later = propagator(plant.state, SETTLED, structure.n_pose, loop.omega[0, 0])
            start = jnp.concatenate([_plucks(structure), later @ plant.force], axis=1)
            n = len(plant.state)
            outputs = [plant.deflection[i : i + 1] for i in range(3)]
            outputs += [jnp.eye(2, n), jnp.eye(1, n, 2)]
            grams = [gramian(plant.state, rows, 1 / loop.omega[0, 0]) for rows in outputs]
            value = jnp.stack([jnp.einsum("as,ab,bs->s", start, p, start) for p in grams])
            return value, plant.state

        loop = prepare(structure, case).loop
        value, state = jax.vmap(controlled)(jnp.asarray(MASKS))
        code = path_status(loop.plant, pose[None])[0]
        is_fine = (code == status.OK) & jnp.all(jnp.isfinite(value)) & jnp.all(value > 0)
        return is_fine, value, state, loop.omega[:, 0]

    return jax.vmap(one)(cases, poses)


def _plucks(structure: Structure) -> Array:
    """Starts with the first mode of one link bent by 1 m, (n, 3)."""
    n, modes = structure.n_pose, structure.n_modes
    size = 2 * (n + structure.n_links * modes)
    return jnp.eye(size)[:, 2 * n : 2 * n + structure.n_links * modes : modes]


def propagator(state: Array, time: float, n_pose: int, omega: Array) -> Array:
    """exp(A t), (n, n), of stiff drives, too: more squarings than JAX allows by default.

    Args:
        state: A of (X, X', q, q') [1/s and mixed], (n, n).
        time: t [s].
        n_pose: coordinates of the platform.
        omega: by which rates are divided meanwhile, so that all numbers are of like size [rad/s].
    """
    n_modes = len(state) // 2 - n_pose
    scale = jnp.repeat(jnp.stack([1.0, omega, 1.0, omega]), np.array([n_pose] * 2 + [n_modes] * 2))
    scaled = state * scale / scale[:, None]
    power = jax.scipy.linalg.expm(time * scaled, max_squarings=40)
    return power * scale[:, None] / scale


def gramian(state: Array, output: Array, step: Array) -> Array:
    """P of A'P + PA + C'C = 0, (n, n); grows without bound where A is unstable.

    Args:
        state: A [1/s and mixed], (n, n).
        output: C, (p, n).
        step: h of the transform, of the order of a period [s], ().
    """
    eye = jnp.eye(len(state))
    inverse = jnp.linalg.inv(eye - step * state)
    seen = output @ inverse

    def double(_: int, carried: tuple[Any, Any]) -> tuple[Any, Any]:
        power, total = carried
        return power @ power, total + power.T @ total @ power

    first = inverse @ (eye + step * state), 2 * step * seen.T @ seen
    total: Array = jax.lax.fori_loop(0, DOUBLINGS, double, first)[1]
    return total
