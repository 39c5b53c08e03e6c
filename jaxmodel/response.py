"""The machine as a test bench sees it: linear about a pose, from inputs to measured outputs.

Inputs are voltages on the actuators, forces on the actuated joints, and a hammer on a link; outputs
are voltages of the sensors, chord deflections, motions of points of the links, actuated coordinates
and the pose. The controller is off, the drive holds the pose.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from jaxmodel.bases import station_places
from jaxmodel.beam import build_basis, held_frequency, left_out_of_loads
from jaxmodel.case import Case, Structure
from jaxmodel.drive import Reference
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import drive_gains
from jaxmodel.kinematics import close_chain
from jaxmodel.lazy import jax, jnp
from jaxmodel.linear import flatten, linearise, resting
from jaxmodel.loop import Loop, PlantState, plant_rates
from jaxmodel.parameters import Array
from jaxmodel.piezo import actuator_constant, sensor_constant
from jaxmodel.plant import damping_ratio
from jaxmodel.prepare import Prepared, prepare


class BenchPlant(NamedTuple):
    """x' = A x + B_0 u + B_2 u'', y = C x + D u, with x = (X, X', q, q') about rest, (n,).

    B_2: modes that are left out follow their forces at once, and their inertia moves the pose.
    """

    state: Array  # A [1/s and mixed], (n, n)
    actuator: Array  # (B_0, B_2) of the voltages on the actuators, (2, n, 3 K)
    slider_force: Array  # of forces on the actuated joints, (2, n, 3)
    hammer: Array  # of forces across the links at the stations, (2, n, 3 S)
    sensor: Array  # voltages of the sensors [V], (3 K, n)
    deflection: Array  # chord deflection at the stations [m], (3 S, n)
    across: Array  # of a point at a station in the plane, across its link [m], (3 S, n)
    along: Array  # the same along its link [m], (3 S, n)
    slider: Array  # actuated coordinates [m], (3, n)
    pose: Array  # [m, m, rad], (3, n)
    # D of sensors [V], then of deflections [m], by the modes that are left out; 0 for other outputs
    from_actuator: Array  # (3 (K + S), 3 K)
    from_slider_force: Array  # (3 (K + S), 3)
    from_hammer: Array  # (3 (K + S), 3 S)
    drive: Array  # proportional and derivative gain of the drives [N/m, N s/m], (2, 3)


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
    still = jnp.zeros_like(pose)

    def rho(at: Array) -> Array:
        return close_chain(loop.plant, at, still).rho

    n = structure.n_pose
    others = (0, 0), (0, n + 2 * structure.n_links * structure.n_modes)
    to_pose = jnp.pad(jnp.eye(n), others)
    across, along = jax.jacfwd(partial(_point_rates, loop, station_places(case), pose))(still)
    gains = drive_gains(DRIVES[structure.drive], loop.drive)
    hammer, wrench = _forces(structure, loop, case, pose)
    to_sensor, to_deflection = plant.direct_sensor, plant.direct_deflection
    left_out = _left_out(structure, case, prepared, pose)
    # X'' is what is moved: the second part of x' = (X', X'', ..)
    by_motion = left_out.by_motion @ jnp.eye(n, len(plant.state), n)
    moved = by_motion @ plant.state
    deflection = plant.deflection + moved[len(to_sensor) :]
    return BenchPlant(
        state=plant.state,
        actuator=jnp.stack([plant.voltage, wrench @ left_out.actuator_wrench]),
        slider_force=jnp.stack([plant.force, jnp.zeros_like(plant.force)]),
        hammer=jnp.stack([hammer, wrench @ left_out.hammer_wrench]),
        sensor=plant.sensor + moved[: len(to_sensor)],
        deflection=deflection,
        across=jnp.reshape(across, (-1, n)) @ to_pose + deflection,
        along=jnp.reshape(along, (-1, n)) @ to_pose,
        slider=jnp.pad(jax.jacfwd(rho)(pose), others),
        pose=to_pose,
        from_actuator=jnp.concatenate([to_sensor, to_deflection]) + by_motion @ plant.voltage,
        from_slider_force=by_motion @ plant.force,
        from_hammer=left_out.by_force + by_motion @ hammer,
        drive=jnp.stack([gains.position, gains.rate]),
    )


class _LeftOut(NamedTuple):
    """What modes that are left out do; zero where the model is truncated."""

    by_force: Array  # to sensors, then deflections, by forces at the stations, (3 (K + S), 3 S)
    by_motion: Array  # the same by accelerations of the pose, (3 (K + S), 3)
    hammer_wrench: Array  # on the pose per second derivative of such forces, (3, 3 S)
    actuator_wrench: Array  # of the actuators' voltages, (3, 3 K)


def _left_out(structure: Structure, case: Case, prepared: Prepared, pose: Array) -> _LeftOut:
    loop, stations, k = prepared.loop, station_places(case), structure.n_patches
    beam, patches, still = case.machine.beam, case.machine.patches, jnp.zeros_like(pose)
    loads = left_out_of_loads(structure.basis, beam, patches, stations, prepared.bases.plant)
    constants = sensor_constant(beam, patches), 1.0, actuator_constant(beam, patches)
    one = jnp.full((structure.n_links, 1), float(loop.left_out is not None))
    ends = one * jnp.array([0.0, 1.0])
    # the motion across a link at its joint, and its change along the link, (3, 2, 3)
    across = jax.jacfwd(lambda rate: _point_rates(loop, ends, pose, rate)[0])(still)
    motion = -jnp.stack([across[:, 0], across[:, 1] - across[:, 0]], axis=1)
    volts, bent, driven = (
        one[..., None] * jnp.reshape(constant * jnp.ones(structure.n_links), (-1, 1, 1)) * part
        for constant, part in zip(
            constants, jnp.split(loads, (k, loads.shape[1] - k), 1), strict=True
        )
    )

    def beside(x: Array) -> Array:
        return jnp.reshape(x[..., -2:] @ motion, (-1, len(pose)))

    return _LeftOut(
        jnp.concatenate([jax.scipy.linalg.block_diag(*x[..., :-2]) for x in (volts, bent)]),
        jnp.concatenate([beside(volts), beside(bent)]),
        beside(bent).T,
        beside(driven).T,
    )


def _point_rates(loop: Loop, stations: Array, pose: Array, rate: Array) -> tuple[Array, Array]:
    """Velocities of the stations of straight links, across and along them [m/s], (3, S) each."""
    chain = close_chain(loop.plant, pose, rate)
    across = stations * chain.beta_rate[:, None] - (chain.sine * chain.rho_rate)[:, None]
    return across, jnp.broadcast_to((chain.cosine * chain.rho_rate)[:, None], across.shape)


def _forces(structure: Structure, loop: Loop, case: Case, pose: Array) -> tuple[Array, Array]:
    """Columns of B of unit forces across the links, (n, 3 S), and on the pose, (n, 3).

    A force at x does work on v_n = x gamma' - sin(gamma) rho' + sum Y_j(x) q_j': it is a wrench on
    the platform, and a force on each mode.
    """
    stations, count = station_places(case), loop.deflection_at.shape[1]
    still, zero = jnp.zeros_like(pose), jnp.zeros_like(loop.omega)

    to_pose, _ = jax.jacfwd(partial(_point_rates, loop, stations, pose))(still)  # (3, S, 3)
    # forces on modes enter where the actuators' do
    on_modes = jnp.swapaxes(loop.deflection_at, 1, 2) / loop.plant.modal_mass[:, None, None]
    pushed = loop._replace(actuator=on_modes)
    chain = close_chain(loop.plant, pose, still)
    reference = Reference(chain.rho, chain.rho_rate, still, still)
    open_loop = structure._replace(feedback="none")

    def derivative(force: Array, wrench: Array) -> Array:
        wrench = wrench + jnp.einsum("is,isp->p", force, to_pose)
        if structure.has_wrench:
            wrench = wrench + case.load.wrench
        at = PlantState(pose, still, zero, zero)
        rates = plant_rates(open_loop, pushed, at, reference._replace(wrench=wrench), force)
        return flatten(PlantState(still, rates.acceleration.pose, zero, rates.acceleration.modal))

    forces = jnp.zeros((structure.n_links, count), pose.dtype)
    by_force, by_wrench = jax.jacfwd(derivative, (0, 1))(forces, still)
    return jnp.reshape(by_force, (-1, forces.size)), by_wrench


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
