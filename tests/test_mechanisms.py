"""Mechanisms against the Lagrangian, and the closure of their chains."""

from functools import partial

import jax
import numpy as np
import pytest

from jaxmodel import kinematics, status
from jaxmodel.beam import build_basis
from jaxmodel.mechanisms.five_bar.geometry import Geometry as FiveBar
from jaxmodel.mechanisms.prrr.paper import paper_machine
from jaxmodel.mechanisms.rrr.cranks import Geometry
from jaxmodel.plant import build_plant
from studies.reference import lagrangian as reference

R, N_STATES = 3, 100
#: A 3-RRR: pivots on a circle, links as the paper's.
CRANKS = Geometry(
    pivot_radius=0.30,
    pivot_angle=np.radians([210.0, 330.0, 90.0]),
    crank_length=0.16,
    elbow=1.0,
    zero_angle=np.radians([60.0, 180.0, 300.0]),
    joint_radius=0.07,
    joint_angle=np.radians([210.0, 330.0, 90.0]),
)
UNEQUAL = CRANKS._replace(
    pivot_radius=np.array([0.30, 0.31, 0.29]),
    crank_length=np.array([0.16, 0.15, 0.17]),
    elbow=np.array([1.0, -1.0, 1.0]),
    joint_radius=np.array([0.07, 0.06, 0.08]),
)
MACHINES = {
    "rrr": paper_machine()._replace(geometry=CRANKS),
    "rrr unequal": paper_machine()._replace(geometry=UNEQUAL),
}
PAPER = paper_machine()
MACHINES["five-bar"] = PAPER._replace(
    geometry=FiveBar(
        pivot_distance=0.2,
        crank_length=np.array([0.15, 0.16]),
        elbow=np.array([-1.0, 1.0]),
        zero_angle=np.radians([120.0, 60.0]),
    ),
    patches=PAPER.patches._replace(center=PAPER.patches.center[:2]),
    damping=PAPER.damping._replace(ratio=np.full((2, 1), 0.01), count=np.ones(2, int)),
)
#: Where the random poses are, and how far they are from there.
PLACES = {3: (np.zeros(3), np.array([0.02, 0.02, 0.1])), 2: (np.array([0.0, 0.24]), 0.02)}
KINDS = [
    ("pinned_pinned", "lumped"),
    ("pinned_pinned", "distributed"),
    ("pinned_pinned", "none"),
    ("pinned_free", "none"),
    ("loaded", "distributed"),
]


@partial(jax.jit, static_argnums=0)
def build(kind, machine):
    basis = build_basis(kind, machine.beam, machine.patches, R, np.array([0.1]), 1.0)
    return basis, build_plant(machine, basis, is_distributed=True)


def make(kind, machine, shortening):
    """Basis and plant as plain arrays."""
    made = jax.tree.map(np.asarray, build(kind, machine))
    if shortening != "distributed":
        made = tuple(part._replace(inward=None, centrifugal=None) for part in made)
    if shortening == "none":
        made = tuple(part._replace(shortening=None, mixed_shortening=None) for part in made)
    return made


def states(machine):
    """Random states far from rest."""
    n = len(machine.patches.center)
    rng, count = np.random.default_rng(7), (N_STATES, n)
    center, size = PLACES[n]
    motion = reference.RigidState(
        pose=center + size * rng.uniform(-1, 1, size=count),
        pose_rate=rng.normal(size=count) * np.array([0.3, 0.3, 1.0])[:n],
        q=3e-3 * rng.uniform(-1, 1, size=(*count, R)) / np.arange(1, R + 1),
        q_rate=0.5 * rng.normal(size=(*count, R)),
    )
    return motion, reference.Loads(
        slider=10 * rng.normal(size=count), modal=3 * rng.normal(size=(*count, R))
    )


@jax.jit
@partial(jax.vmap, in_axes=(None, None, None, 0, 0))
def all_forms(machine, basis, plant, motion, loads):
    return (
        reference.closed_form(plant, motion, loads),
        reference.by_lagrangian(machine, basis, motion, loads),
        reference.by_multipliers(machine, basis, motion, loads),
    )


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize(("kind", "shortening"), KINDS)
def test_accelerations_equal_lagrangian_and_multiplier_form(name, kind, shortening):
    machine = MACHINES[name]
    basis, plant = make(kind, machine, shortening)
    (chain, found), (pose_l, q_l), (pose_m, q_m, rho_m, beta_m) = all_forms(
        machine, basis, plant, *states(machine)
    )
    assert np.all(jax.vmap(partial(kinematics.chain_status, plant))(chain) == status.OK)
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
