"""Closed-form accelerations beside those of the Lagrangian and of the multiplier form."""

from functools import partial

import jax
import numpy as np

from jaxmodel.beam import build_basis
from jaxmodel.mechanisms.prrr.paper import paper_machine
from jaxmodel.plant import build_plant
from studies.reference import lagrangian as reference

MACHINE = paper_machine()
R = 3  # modes of a link


@partial(jax.jit, static_argnums=0)
def build(kind, machine, mask, stations):
    basis = build_basis(kind, machine.beam, machine.patches, R, stations, mask)
    return basis, build_plant(machine, basis, is_distributed=True)


def make(kind, machine=MACHINE, mask=1.0, stations=(0.1,), shortening="lumped"):
    """Basis and plant as plain arrays."""
    made = jax.tree.map(np.asarray, build(kind, machine, mask, np.array(stations)))
    if shortening != "distributed":
        made = tuple(part._replace(inward=None, centrifugal=None) for part in made)
    if shortening == "none":
        made = tuple(part._replace(shortening=None, mixed_shortening=None) for part in made)
    return made


@jax.jit
@partial(jax.vmap, in_axes=(None, None, None, 0, 0))
def all_forms(machine, basis, plant, motion, loads):
    """Chain and accelerations of `jaxmodel`, and the two others'."""
    return (
        reference.closed_form(plant, motion, loads),
        reference.by_lagrangian(machine, basis, motion, loads),
        reference.by_multipliers(machine, basis, motion, loads),
    )


def check_forms(found, lagrangian, multipliers):
    """Accelerations agree to 1e-10 of their largest entry in every state."""
    (pose_l, q_l), (pose_m, q_m, rho_m, beta_m) = lagrangian, multipliers
    pairs = (
        (found.pose, pose_l),
        (found.modal, q_l),
        (found.pose, pose_m),
        (found.modal, q_m),
        (found.rho, rho_m),
        (found.beta, beta_m),
    )
    for mine, wanted in pairs:
        axes = tuple(range(1, wanted.ndim))
        error = np.abs(mine - wanted).max(axis=axes) / np.abs(wanted).max(axis=axes)
        assert error.max() < 1e-10
