"""The machine as a test bench sees it: linear about a pose, from inputs to measured outputs.

Inputs are voltages on the actuators, forces on the actuated joints, and a hammer on a link; outputs
are voltages of the sensors, chord deflections, motions of points of the links, actuated coordinates
and the pose. The controller is off, the drive holds the pose.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from jaxmodel.bases import station_places
from jaxmodel.beam import build_basis, held_frequency, left_out_of_loads
from jaxmodel.case import Case, Structure
from jaxmodel.drive import Reference, settled_motors
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import drive_gains
from jaxmodel.dynamics import modal_chain
from jaxmodel.kinematics import close_chain
from jaxmodel.lazy import jax, jnp
from jaxmodel.linear import flatten, linearise, resting
from jaxmodel.loop import Loop, PlantState, plant_rates
from jaxmodel.parameters import Array, Num
from jaxmodel.piezo import patch_constants
from jaxmodel.plant import damping_ratio
from jaxmodel.prepare import Prepared, prepare


class BenchPlant(NamedTuple):
    """x' = A x + B_0 u + B_2 u'', y = C x + D u, with x = (X, X', q, q') about rest, (n,).

    B_2: modes that are left out follow their forces at once, and their inertia moves the pose and
    the elongations.
    """

    state: Num[Array, "n n"]  # A [1/s and mixed]
    actuator: Num[Array, "2 n links*K"]  # (B_0, B_2) of the voltages on the actuators
    slider_force: Num[Array, "2 n links"]  # of forces on the actuated joints
    hammer: Num[Array, "2 n links*S"]  # of forces across the links at the stations
    sensor: Num[Array, "links*K n"]  # voltages of the sensors [V]
    deflection: Num[Array, "links*S n"]  # chord deflection at the stations [m]
    across: Num[Array, "links*S n"]  # of a point at a station in the plane, across its link [m]
    along: Num[Array, "links*S n"]  # the same along its link [m]
    slider: Num[Array, "links n"]  # actuated coordinates [m]
    pose: Num[Array, "pose n"]  # [m, m, rad]
    # D of sensors [V], then of deflections [m], by the modes that are left out; 0 for other outputs
    from_actuator: Num[Array, "links*(K+S) links*K"]
    from_slider_force: Num[Array, "links*(K+S) links"]
    from_hammer: Num[Array, "links*(K+S) links*S"]
    drive: Num[Array, "2 links"]  # proportional and derivative gain of the drives [N/m, N s/m]


def bench_plant(structure: Structure, case: Case, pose: Array) -> BenchPlant:
    """The machine at rest at a pose, held by its drive, without its controller.

    Args:
        structure: static choices with feedback "none"; basis with both ends on the chord.
        case: the numbers; stations are where a hammer hits and deflections are taken.
        pose: (x, y, phi) [m, m, rad], (3,).

    Returns:
        BenchPlant.
    """
    prepared = prepare(structure, case)
    loop = prepared.loop
    pose = jnp.asarray(pose, loop.omega.dtype)
    plant = linearise(structure, loop, pose, resting(structure, case))
    n, size = structure.n_pose, structure.n_links * structure.n_coordinates
    still = jnp.zeros((n + size,), pose.dtype)
    # rows that take positions y = (X, q) and accelerations from x and x' = (X', X'', q', q'')
    eye = jnp.eye(2 * (n + size), len(plant.state))
    place = eye[np.r_[0:n, 2 * n : 2 * n + size]]
    acceleration = eye[np.r_[n : 2 * n, 2 * n + size : 2 * (n + size)]]

    def rho(y: Array) -> Array:
        q = jnp.reshape(y, loop.plant.stiffness.shape)
        return modal_chain(loop.plant, pose, 0 * pose, q, 0 * q).rho

    to_rho = jnp.concatenate(
        [jax.jacfwd(lambda at: close_chain(loop.plant, at, 0 * at).rho)(pose)]
        + [jax.jacfwd(rho)(still[n:])],
        axis=1,
    )
    across, along = jax.jacfwd(partial(_point_rates, loop, station_places(case), pose))(still)
    gains = drive_gains(DRIVES[structure.drive], loop.drive)
    hammer, wrench = _forces(structure, loop, case, pose)
    to_sensor, to_deflection = plant.direct_sensor, plant.direct_deflection
    left_out = _left_out(structure, case, prepared, pose)
    by_motion = left_out.by_motion @ acceleration
    moved = by_motion @ plant.state
    deflection = plant.deflection + moved[len(to_sensor) :]
    return BenchPlant(
        state=plant.state,
        actuator=jnp.stack([plant.voltage, wrench @ left_out.actuator_wrench]),
        slider_force=jnp.stack([plant.force, jnp.zeros_like(plant.force)]),
        hammer=jnp.stack([hammer, wrench @ left_out.hammer_wrench]),
        sensor=plant.sensor + moved[: len(to_sensor)],
        deflection=deflection,
        across=jnp.reshape(across, (-1, n + size)) @ place + deflection,
        along=jnp.reshape(along, (-1, n + size)) @ place,
        slider=to_rho @ place,
        pose=place[:n],
        from_actuator=jnp.concatenate([to_sensor, to_deflection]) + by_motion @ plant.voltage,
        from_slider_force=by_motion @ plant.force,
        from_hammer=left_out.by_force + by_motion @ hammer,
        drive=jnp.stack([gains.position, gains.rate]),
    )


class _LeftOut(NamedTuple):
    """What modes that are left out do; zero where the model is truncated."""

    # to sensors, then deflections, by forces at the stations
    by_force: Num[Array, "links*(K+S) links*S"]
    by_motion: Num[Array, "links*(K+S) m"]  # the same by accelerations of y = (X, q)
    hammer_wrench: Num[Array, "m links*S"]  # on y per second derivative of such forces
    actuator_wrench: Num[Array, "m links*K"]  # of the actuators' voltages


def _left_out(structure: Structure, case: Case, prepared: Prepared, pose: Array) -> _LeftOut:
    loop, stations, k = prepared.loop, station_places(case), structure.n_patches
    beam, patches = case.machine.beam, case.machine.patches
    still = jnp.zeros((len(pose) + loop.plant.stiffness.size,), pose.dtype)
    loads = left_out_of_loads(structure.basis, beam, patches, stations, prepared.bases.plant)
    lambda_s, lambda_a = (x[:, :, None] for x in patch_constants(case.machine))
    one = jnp.full((structure.n_links, 1), float(loop.left_out is not None))
    ends = one * jnp.array([0.0, 1.0])
    # the motion across a link at its joint, and its change along the link, (3, 2, m)
    across = jax.jacfwd(lambda rate: _point_rates(loop, ends, pose, rate)[0])(still)
    motion = -jnp.stack([across[:, 0], across[:, 1] - across[:, 0]], axis=1)
    volts, bent, driven = (
        one[..., None] * constant * part
        for constant, part in zip(
            (lambda_s, 1.0, lambda_a), jnp.split(loads, (k, loads.shape[1] - k), 1), strict=True
        )
    )

    def beside(x: Array) -> Array:
        return jnp.reshape(x[..., -2:] @ motion, (-1, len(still)))

    return _LeftOut(
        jnp.concatenate([jax.scipy.linalg.block_diag(*x[..., :-2]) for x in (volts, bent)]),
        jnp.concatenate([beside(volts), beside(bent)]),
        beside(bent).T,
        beside(driven).T,
    )


def _point_rates(loop: Loop, stations: Array, pose: Array, rate: Array) -> tuple[Array, Array]:
    """Velocities of the stations of straight links, across and along them [m/s], (3, S) each.

    rate: of (X, q); modes bend no link here, elongations lengthen it evenly.
    """
    plant, n = loop.plant, len(pose)
    q_rate = jnp.reshape(rate[n:], plant.stiffness.shape)
    chain = modal_chain(plant, pose, rate[:n], 0 * q_rate, q_rate)
    across = stations * chain.beta_rate[:, None] - (chain.sine * chain.rho_rate)[:, None]
    along = jnp.broadcast_to((chain.cosine * chain.rho_rate)[:, None], across.shape)
    if plant.stretch is not None:
        along = along + stations * (plant.stretch * q_rate[:, -1] / plant.length)[:, None]
    return across, along


def _forces(structure: Structure, loop: Loop, case: Case, pose: Array) -> tuple[Array, Array]:
    """Columns of B of unit forces across the links, (n, 3 S), and on y = (X, q), (n, m).

    A force at x does work on v_n = x gamma' - sin(gamma) rho' + sum Y_j(x) q_j': it is a wrench on
    the platform, and a force on each coordinate.
    """
    stations, still, zero = station_places(case), 0 * pose, jnp.zeros_like(loop.plant.stiffness)
    n, mass, links = len(pose), loop.plant.modal_mass[:, None, None], len(zero)
    rates = jnp.zeros((n + zero.size,), pose.dtype)
    across, _ = jax.jacfwd(partial(_point_rates, loop, stations, pose))(rates)  # (3, S, m)
    # forces on coordinates enter where the actuators' do
    pushed = loop._replace(
        actuator=jnp.broadcast_to(jnp.eye(zero.shape[1]) / mass, (links, *[zero.shape[1]] * 2))
    )
    chain = close_chain(loop.plant, pose, still)
    reference = Reference(chain.rho, chain.rho_rate, still, still)
    open_loop = structure._replace(feedback="none")

    def derivative(load: Array) -> Array:
        wrench, force = load[:n], jnp.reshape(load[n:], zero.shape)
        if structure.has_wrench:
            wrench = wrench + case.load.wrench
        at = PlantState(pose, still, zero, zero, motor=settled_motors(structure, still))
        rates = plant_rates(open_loop, pushed, at, reference._replace(wrench=wrench), force)
        moves = rates.acceleration
        return flatten(PlantState(still, moves.pose, zero, moves.modal, motor=rates.motor))

    by_load = jax.jacfwd(derivative)(rates)
    bent = jnp.swapaxes(loop.deflection_at, 1, 2)  # (3, R, S)
    own = jnp.pad(jax.scipy.linalg.block_diag(*bent), ((n, 0), (0, 0)))
    return by_load @ (jnp.reshape(across, (-1, n + zero.size)).T + own), by_load


def held_modes(structure: Structure, case: Case) -> tuple[Array, Array]:
    """Modes of the links alone, between held joints.

    Args:
        structure: static choices.
        case: the numbers.

    Returns:
        frequencies [Hz] and damping ratios [1], (3, R) each.
    """
    machine, stations = case.machine, station_places(case)
    basis = build_basis(structure.basis, machine.beam, machine.patches, structure.n_modes, stations)
    omega = held_frequency(structure.basis, machine.beam, basis)
    return omega / (2 * jnp.pi), damping_ratio(machine.damping, omega)
