"""Where the parts of a moving machine are, for drawings and animations."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.beam import build_basis
from jaxmodel.case import Case, Structure
from jaxmodel.dynamics import modal_chain
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.study.spec import Study

#: Points along a link.
POINTS = 41


class Skeleton(NamedTuple):
    """Positions of all parts, (T, ...) in metres."""

    carrier: np.ndarray  # ends of guides or cranks, (T, n, 2, 2)
    near: np.ndarray  # B, (T, n, 2)
    joint: np.ndarray  # C, (T, n, 2)
    link: np.ndarray  # points along the links, (T, n, points, 2)


def skeleton(study: Study, pose: np.ndarray, q: np.ndarray, exaggeration: float) -> Skeleton:
    """Positions of the machine's parts, with exaggerated bending; links keep their length.

    Args:
        study: the machine.
        pose: (x, y, phi) [m, m, rad], (T, p).
        q: modal coordinates of the plant [m], (T, n, R).
        exaggeration: factor on the bending [1].
    """
    fields = {"link__modes": q.shape[-1], "link__stretch": False, "control__feedback": "none"}
    structure, case = check_run(study.change(**fields))
    near, joint, link = (
        np.asarray(part)
        for part in _positions(structure._replace(n_steps=1), case, pose, q, exaggeration)
    )
    carriers = case.machine.geometry.carriers(case.machine.masses.slider_mass)
    lines = [[one.line(x) for one, x in zip(carriers, at, strict=True)] for at in near]
    return Skeleton(np.array(lines), near, joint, link)


@kept_jit(static_argnums=0)
def _positions(
    structure: Structure, case: Case, pose: Array, q: Array, exaggeration: Array
) -> tuple[Array, Array, Array]:
    plant = prepare(structure, case).loop.plant
    machine = case.machine
    along = jnp.linspace(0.0, 1.0, POINTS)
    shape = build_basis(
        structure.basis,
        machine.beam,
        machine.patches,
        structure.n_modes,
        plant.length[:, None] * along,
    ).deflection_at

    def one(pose: Array, q: Array) -> tuple[Array, Array, Array]:
        chain = modal_chain(plant, pose, jnp.zeros_like(pose), q, jnp.zeros_like(q))
        # one joint of all links where the platform is a point
        far = [jnp.broadcast_to(x, plant.length.shape) for x in chain.far]
        joint = jnp.stack(far, axis=1)
        near = joint - jnp.stack(chain.near.to_far(), axis=1)
        chord = joint - near
        across = jnp.stack([-chord[:, 1], chord[:, 0]], axis=1) / plant.length[:, None]
        bent = exaggeration * jnp.einsum("isr,ir->is", shape, q)
        straight = near[:, None] + along[:, None] * chord[:, None]
        return near, joint, straight + bent[..., None] * across[:, None]

    return jax.vmap(one)(pose, q)
