"""Closed-form accelerations beside those of the Lagrangian and of the multiplier form.

The closed forms are evaluated operation by operation, with states as lanes in the last axis: no
program for each set of parts that a plant may have. The others are one program for all bases.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.beam import build_basis
from jaxmodel.defaults import paper_machine
from jaxmodel.plant import build_plant
from studies.reference import lagrangian as reference

MACHINE = paper_machine()
R = 3  # modes of a link


def by_multipliers(machine, basis, motion, loads):
    """(X'', q'', rho'', beta'') from (5): coordinates (rho, beta, X, q), constraints (6)."""
    shape, n = motion.q.shape, len(motion.pose)

    def split(y):
        return y[:n], y[n : 2 * n], y[2 * n : 3 * n], y[3 * n :].reshape(shape)

    def constraints(y):
        rho, beta, pose, q = split(y)
        tips = reference.link_tips(machine, basis, rho, beta, q)
        return (tips - reference.platform_joints(machine.geometry, pose)).ravel()

    def energy(y, y_rate):
        rho, beta, pose, q = split(y)
        rho_rate, beta_rate, pose_rate, q_rate = split(y_rate)
        joints, rates = (rho, beta), (rho_rate, beta_rate)
        return reference.kinetic_energy(machine, basis, joints, pose, q, rates, pose_rate, q_rate)

    def all_coordinates(z):
        pose, q = z
        return jnp.concatenate([*reference.close(machine, basis, pose, q), pose, q.ravel()])

    y, y_rate = jax.jvp(
        all_coordinates, ((motion.pose, motion.q),), ((motion.pose_rate, motion.q_rate),)
    )
    mass, inertial = reference.inertia(energy, y, y_rate)
    on_modes = reference.modal_load(machine, basis, motion.q, motion.q_rate, loads.modal)
    load = jnp.concatenate([loads.slider, jnp.zeros(2 * n), on_modes.ravel()])
    jacobian = jax.jacfwd(constraints)(y)
    curvature = jax.jvp(lambda y: jax.jvp(constraints, (y,), (y_rate,))[1], (y,), (y_rate,))[1]
    system = jnp.block([[mass, jacobian.T], [jacobian, jnp.zeros((2 * n, 2 * n))]])
    solution = jnp.linalg.solve(system, jnp.concatenate([load - inertial, -curvature]))
    rho_acc, beta_acc, pose_acc, q_acc = split(solution[: y.size])
    return pose_acc, q_acc, rho_acc, beta_acc


@partial(jax.jit, static_argnums=0)
def build(kind, machine, mask, stations):
    basis = build_basis(kind, machine.beam, machine.patches, R, stations, mask)
    return basis, build_plant(machine, basis, is_distributed=True)


def make(kind, machine=MACHINE, mask=1.0, stations=(0.1,), shortening="lumped"):
    """Basis and plant as plain arrays."""
    made = jax.tree.map(np.asarray, build(kind, machine, mask, np.array(stations)))
    return reduced(*made, shortening)


def reduced(basis, plant, shortening):
    """The parts that a bent link's shorter chord has: "distributed", "lumped" or "none"."""
    made = basis, plant
    if shortening != "distributed":
        made = tuple(part._replace(inward=None, centrifugal=None) for part in made)
    if shortening == "none":
        made = tuple(part._replace(shortening=None, mixed_shortening=None) for part in made)
    return made


def lanes_last(tree):
    """Arrays with their first axis last."""
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), 0, -1), tree)


def one_lane(tree):
    """The same numbers in every lane."""
    return jax.tree.map(lambda x: np.asarray(x)[..., None], tree)


def closed_form(plant, motion, loads):
    """Chain and accelerations of lanes, (n, ...); plant as from `one_lane` or `lanes_last`."""
    found = reference.closed_form(plant, lanes_last(motion), lanes_last(loads))
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), -1, 0), found)


def general(machine, basis):
    """The same basis with all parts that a basis may have, which are zero or follow from others."""
    still, one = np.zeros(basis.mass.shape), np.eye(basis.mass.shape[-1])
    none = still[..., None] * one
    own = still if basis.shortening is None else basis.shortening
    mixed = none if basis.mixed_shortening is None else basis.mixed_shortening
    mu = basis.first_moment / np.asarray(machine.beam.length)
    lumped = mu[..., None, None] * (own[..., None] * one + mixed)
    return basis._replace(
        tip=still if basis.tip is None else basis.tip,
        shortening=own,
        mixed_shortening=mixed,
        inward=lumped if basis.inward is None else basis.inward,
        centrifugal=none if basis.centrifugal is None else basis.centrifugal,
    )


@partial(jax.jit, static_argnums=0)
@partial(jax.vmap, in_axes=(None, None, None, 0, 0))
def _by(form, machine, basis, motion, loads):
    return form(machine, basis, motion, loads)


def by_lagrangian(machine, basis, motion, loads):
    """`reference.by_lagrangian` of states of one machine."""
    return _by(reference.by_lagrangian, machine, general(machine, basis), motion, loads)


def check_multipliers(machine, basis, plant, motion, loads):
    """Accelerations agree with the multiplier form to 1e-10 of their largest entry in every state.

    Returns the chain and the accelerations.
    """
    chain, found = closed_form(one_lane(plant), motion, loads)
    wanted = _by(by_multipliers, machine, general(machine, basis), motion, loads)
    check_rows((found.pose, found.modal, found.rho, found.beta), wanted)
    return chain, found


def check_rows(found, wanted):
    """Rows of arrays agree to 1e-10 of their largest entry."""
    for mine, theirs in zip(found, wanted, strict=True):
        axes = tuple(range(1, theirs.ndim))
        error = np.abs(mine - theirs).max(axis=axes) / np.abs(theirs).max(axis=axes)
        assert error.max() < 1e-10
