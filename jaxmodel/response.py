"""The machine as a test bench sees it: linear about a pose, from inputs to measured outputs.

Inputs are voltages on the actuators, forces on the actuated joints, and a hammer on a link; outputs
are voltages of the sensors, chord deflections, motions of points of the links, actuated coordinates
and the pose. The controller is off, the drive holds the pose.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from jaxmodel.bases import station_places
from jaxmodel.beam import build_basis, held_frequency
from jaxmodel.case import Case, Structure
from jaxmodel.drive import Reference
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import drive_gains
from jaxmodel.kinematics import close_chain
from jaxmodel.lazy import jax, jnp
from jaxmodel.linear import flatten, linearise, resting
from jaxmodel.loop import Loop, PlantState, plant_rates
from jaxmodel.parameters import Array
from jaxmodel.plant import damping_ratio
from jaxmodel.prepare import prepare


class BenchPlant(NamedTuple):
    """x' = A x + B u, y = C x + D u, with x = (X, X', q, q') about rest, (n,)."""

    state: Array  # A [1/s and mixed], (n, n)
    actuator: Array  # B of the voltages on the actuators, (n, 3 K)
    slider_force: Array  # B of forces on the actuated joints, (n, 3)
    hammer: Array  # B of forces across the links at the stations, (n, 3 S)
    sensor: Array  # voltages of the sensors [V], (3 K, n)
    deflection: Array  # chord deflection at the stations [m], (3 S, n)
    across: Array  # of a point at a station in the plane, across its link [m], (3 S, n)
    along: Array  # the same along its link [m], (3 S, n)
    slider: Array  # actuated coordinates [m], (3, n)
    pose: Array  # [m, m, rad], (3, n)
    # D, of the modes that are left out; zero for all other pairs
    actuator_to_sensor: Array  # [V/V], (3 K, 3 K)
    actuator_to_deflection: Array  # [m/V], (3 S, 3 K)
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
    loop = prepare(structure, case).loop
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
    return BenchPlant(
        state=plant.state,
        actuator=plant.voltage,
        slider_force=plant.force,
        hammer=_hammer(structure, loop, case, pose),
        sensor=plant.sensor,
        deflection=plant.deflection,
        across=jnp.reshape(across, (-1, n)) @ to_pose + plant.deflection,
        along=jnp.reshape(along, (-1, n)) @ to_pose,
        slider=jnp.pad(jax.jacfwd(rho)(pose), others),
        pose=to_pose,
        actuator_to_sensor=plant.direct_sensor,
        actuator_to_deflection=plant.direct_deflection,
        drive=jnp.stack([gains.position, gains.rate]),
    )


def _point_rates(loop: Loop, stations: Array, pose: Array, rate: Array) -> tuple[Array, Array]:
    """Velocities of the stations of straight links, across and along them [m/s], (3, S) each."""
    chain = close_chain(loop.plant, pose, rate)
    across = stations * chain.beta_rate[:, None] - (chain.sine * chain.rho_rate)[:, None]
    return across, jnp.broadcast_to((chain.cosine * chain.rho_rate)[:, None], across.shape)


def _hammer(structure: Structure, loop: Loop, case: Case, pose: Array) -> Array:
    """Columns of B of unit forces across the links, (n, 3 S).

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

    def derivative(force: Array) -> Array:
        wrench = jnp.einsum("is,isp->p", force, to_pose)
        if structure.has_wrench:
            wrench = wrench + case.load.wrench
        at = PlantState(pose, still, zero, zero)
        rates = plant_rates(open_loop, pushed, at, reference._replace(wrench=wrench), force)
        return flatten(PlantState(still, rates.acceleration.pose, zero, rates.acceleration.modal))

    forces = jnp.zeros((structure.n_links, count), pose.dtype)
    return jnp.reshape(jax.jacfwd(derivative)(forces), (-1, forces.size))


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
