"""A machine of finite elements (Exudyn): measured, and with a controller made for another one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh, null_space

from jaxmodel import sampled_loop
from jaxmodel.linear import LinearPlant
from jaxmodel.sampled_loop import closed_loop
from studies.engine.controller import fixed_controller
from studies.engine.stability import gain_margin
from studies.study.cases import build_case, build_structure
from studies.study.signals import Signal
from studies.study.window import residual_delay
from studies.twin.law import exported_law
from studies.twin.loop import run_twin
from studies.twin.machine import describe_machine
from studies.twin.multibody import Settings, build_model
from studies.twin.plan import plan_run

#: Links that hardly stretch, as those of our model.
STIFF = Settings(axial_factor=100.0)


def response_of_elements(study, pose, signals, frequency_hz):
    """Complex responses at rest, as displacements where an accelerometer is.

    Args:
        study: the machine; its carriers are held by their drives, with friction's slope at rest.
        pose: of the platform [m, m, rad], (3,).
        signals: inputs and outputs, n pairs.
        frequency_hz: (f,).

    Returns:
        (n, f).
    """
    machine, (mass, damping, stiffness, free, model) = _at_rest(study, pose)
    drive = study.drive
    enter = free.T @ np.stack([_along(model, machine, source) for source, _ in signals], axis=1)
    leave = free.T @ np.stack([_along(model, machine, output) for _, output in signals], axis=1)
    is_drive = np.array([source.kind == "command" for source, _ in signals])
    is_own = np.array([source.link == output.link for source, output in signals])
    found = []
    for omega in 2 * np.pi * np.asarray(frequency_hz):
        dynamic = stiffness + 1j * omega * damping - omega**2 * mass
        gain = np.sum(leave * np.linalg.solve(dynamic, enter), axis=0)
        held = drive.kp + 1j * omega * drive.kd  # force of the drive, over what it is off by
        found.append(np.where(is_drive, held * is_own - held**2 * gain, gain))
    return np.stack(found, axis=1)


def _at_rest(study, pose):
    """Its drawing; mass, damping, stiffness (n, n) and coordinates (N, n) of free motion; model."""
    machine = describe_machine(build_structure(study), build_case(study))
    model = build_model(machine, np.array(pose), None, STIFF)
    mass, damping, stiffness, constraint = _matrices(model)
    drive, at, square = study.drive, np.array(model.carrier_start), model.levers**2
    stiffness[at, at] += drive.kp * square
    damping[at, at] += (drive.kd + drive.viscous_friction) * square
    damping[at, at] += drive.coulomb_friction / drive.friction_speed * square
    free = null_space(constraint)
    mass, damping, stiffness = (free.T @ x @ free for x in (mass, damping, stiffness))
    return machine, (mass, damping, stiffness, free, model)


def _matrices(model):
    """Mass, damping, stiffness (n, n) and constraints' Jacobian (m, n) of all coordinates."""
    solver, settings = model.exudyn.MainSolverStatic(), model.exudyn.SimulationSettings()
    settings.solution.file.write = False
    solver.InitializeSolver(model.system, settings)
    n = solver.GetODE2size()
    solver.ComputeMassMatrix(model.system)
    mass = np.array(solver.GetSystemMassMatrix())
    solver.ComputeJacobianODE2RHS(model.system, -1, 0, 0)
    solver.ComputeJacobianAE(model.system, 1.0, 0.0, 0.0, False)
    both = np.array(solver.GetSystemJacobian())
    solver.ComputeJacobianODE2RHS(model.system, 0, -1, 0)
    damping = np.array(solver.GetSystemJacobian())[:n, :n]
    solver.FinalizeSolver(model.system, settings)
    return mass, damping, both[:n, :n], both[n:, :n]


def _along(model, machine, signal):
    """What a signal measures of all coordinates, or acts on: of a motor or command its carrier.

    Of a patch the turning of its one end against the other, times its constant; of an accelerometer
    the motion of the node at its place.
    """
    row, i = np.zeros(len(model.reference)), signal.link
    if signal.kind in ("command", "motor", "slider"):
        row[model.carrier_start[i]] = model.levers[i]
        return row
    if signal.kind == "accelerometer":
        node = int(np.abs(model.meshes[i].x - signal.place).argmin())
        at = model.link_start[i] + 4 * node
        sine, cosine = np.sin(np.deg2rad(signal.angle)), np.cos(np.deg2rad(signal.angle))
        axis = model.reference[at + 2 : at + 4]
        row[at : at + 2] = cosine * axis + sine * np.array([-axis[1], axis[0]])
        return row
    mesh, link, start = model.meshes[i], machine.links[i], model.link_start[i]
    is_actuator = signal.kind == "actuator"
    constant = link.actuator_constant if is_actuator else link.sensor_constant
    nodes = mesh.actuator_nodes if is_actuator else mesh.sensor_nodes
    for node, sign in zip(nodes[signal.patch], (-1, 1), strict=True):
        at = start + 4 * node + 2
        slope = model.reference[at : at + 2]
        row[at : at + 2] += sign * constant * np.array([-slope[1], slope[0]])
    return row


def plant_of_elements(modes, coordinates=39):
    """Linear plant of finite elements for a loop with 12 modes a link, 42 if links lengthen.

    It has as many of their modes as such a plant, and the static rest of the others.

    Args:
        modes: mass-normalised, as in `tests/data/fe_plant.npz`: squared frequencies w2 (n,),
            damping D (n, n), forces by voltages B (n, 3 K) and by slider forces F (n, 3), sensor
            voltages S (3 K, n), chord deflections W (3 S, n), and what others add, res and wres.
    """
    n, unit = coordinates, np.sqrt(0.0055)  # scaled to move as modal coordinates do
    kept, rest = slice(n), slice(n, None)
    static = modes["B"][rest] / modes["w2"][rest, None]
    order = np.r_[0:3, n : n + 3, 3:n, n + 3 : 2 * n]  # of (X, X', q, q')
    zero = np.zeros((n, n))
    state = np.block([[zero, np.eye(n)], [-np.diag(modes["w2"][kept]), -modes["D"][kept, kept]]])

    def force(x):
        return np.vstack([0 * x[kept], x[kept]])[order] / unit

    def output(x):
        return np.hstack([x[:, kept], 0 * x[:, kept]])[:, order] * unit

    return LinearPlant(
        state=state[np.ix_(order, order)],
        voltage=force(modes["B"]),
        force=force(modes["F"]),
        deflection=output(modes["W"]),
        sensor=output(modes["S"]),
        direct_deflection=modes["wres"] + modes["W"][:, rest] @ static,
        direct_sensor=modes["res"] + modes["S"][:, rest] @ static,
    )


def margin_on_elements(true, tuned):
    """Gain margin [1] of a tuned study's controller on the machine of another; 0: unstable.

    Args:
        true: the machine, with the tuned study's control.
        tuned: whose controller it is.
    """
    home = np.array(true.motion.waypoints[0], float)
    plant = plant_of_elements(_modes(true, home))
    law = jax.tree.map(jnp.asarray, fixed_controller(tuned).controller)
    structure = build_structure(true)._replace(has_position_gain=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampled_loop, "linearise", lambda *_: plant)
        matrices = jax.jit(lambda case, law: closed_loop(structure, case, home, law))(
            build_case(true), law
        )
    opened, feedback = np.asarray(matrices.open), np.asarray(matrices.feedback)
    return gain_margin(lambda factor: np.linalg.eigvals(opened + factor * feedback))


def _modes(study, pose):
    """The machine's modes as `plant_of_elements` has them."""
    machine, at_rest = _at_rest(study, pose)
    mass, damping, stiffness, free, model = at_rest
    square, shape = eigh(stiffness, mass)
    patches = [(i, k) for i in range(3) for k in range(len(machine.links[0].sensor_ends))]

    def along(kind, wires):
        signals = [Signal(kind, i, k, np.nan) for i, k in wires]
        return shape.T @ free.T @ np.stack([_along(model, machine, x) for x in signals], axis=1)

    sensors, count = along("sensor", patches), len(patches)
    return {
        "w2": square,
        "D": shape.T @ damping @ shape,
        "B": along("actuator", patches),
        "F": along("motor", [(i, 0) for i in range(3)]),
        "S": sensors.T,
        "W": np.zeros((3 * len(study.metrics.stations), len(square))),
        "res": np.zeros((count, count)),
        "wres": np.zeros((3 * len(study.metrics.stations), count)),
    }


def residual_on_elements(true, tuned):
    """Residual vibration of mid-span on the worst link, rms [m], arguments as above."""
    structure, case, metrics = build_structure(true), build_case(true), true.metrics
    delay = residual_delay(true)
    plan = plan_run(structure, case, STIFF, delay + metrics.residual_length)
    with exported_law(tuned) as law:
        run = run_twin(describe_machine(structure, case), plan, law, STIFF)
    start = plan.command_end + delay
    is_late = (run.time >= start) & (run.time <= start + metrics.residual_length)
    return float(np.sqrt(np.mean(run.deflection[is_late] ** 2, axis=0)).max())
