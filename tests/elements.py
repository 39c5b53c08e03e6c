"""A machine of finite elements (Exudyn): measured, and with a controller made for another one."""

import numpy as np
from scipy.linalg import null_space

from studies.study.cases import build_case, build_structure
from studies.twin.law import exported_law
from studies.twin.loop import run_twin
from studies.twin.machine import describe_machine
from studies.twin.margin import margin_by_growth
from studies.twin.multibody import Settings, build_model
from studies.twin.plan import plan_run

#: Links that hardly stretch, as those of our model; half the usual step for margins.
STIFF = Settings(axial_factor=100.0)
FINE = STIFF._replace(n_steps=20)


def response_of_elements(study, pose, signals, frequency_hz):
    """Complex responses from actuators to sensors and from commands to motors, at rest.

    Args:
        study: the machine; its sliders are held by their drives, with friction's slope at rest.
        pose: of the platform [m, m, rad], (3,).
        signals: inputs and outputs, n pairs.
        frequency_hz: (f,).

    Returns:
        (n, f).
    """
    machine = describe_machine(build_structure(study), build_case(study))
    model = build_model(machine, np.array(pose), None, STIFF)
    mass, damping, stiffness, constraint = _matrices(model)
    drive = study.drive
    at = np.array(model.slider_start)
    stiffness[at, at] += drive.kp
    damping[at, at] += drive.kd + drive.viscous_friction
    damping[at, at] += drive.coulomb_friction / drive.friction_speed
    free = null_space(constraint)
    mass, damping, stiffness = (free.T @ x @ free for x in (mass, damping, stiffness))
    enter = free.T @ np.stack([_along(model, machine, source) for source, _ in signals], axis=1)
    leave = free.T @ np.stack([_along(model, machine, output) for _, output in signals], axis=1)
    is_drive = np.array([source.kind == "command" for source, _ in signals])
    found = []
    for omega in 2 * np.pi * np.asarray(frequency_hz):
        dynamic = stiffness + 1j * omega * damping - omega**2 * mass
        gain = np.sum(leave * np.linalg.solve(dynamic, enter), axis=0)
        held = drive.kp + 1j * omega * drive.kd  # force of the drive, over what it is off by
        found.append(np.where(is_drive, held - held**2 * gain, gain))
    return np.stack(found, axis=1)


def _matrices(model):
    """Mass, damping, stiffness (n, n) and constraints' Jacobian (m, n) of all coordinates."""
    solver, settings = model.exudyn.MainSolverStatic(), model.exudyn.SimulationSettings()
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
    """What a signal measures of all coordinates, or acts on: of a motor or command its slider.

    Of a patch the turning of its one end against the other, times its constant.
    """
    row, i = np.zeros(len(model.reference)), signal.link
    if signal.kind in ("command", "motor"):
        row[model.slider_start[i]] = 1.0
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


def margin_on_elements(true, tuned, predicted):
    """Gain margin [1] of a tuned study's controller on the machine of another, by growth.

    Args:
        true: the machine, with the tuned study's control.
        tuned: whose controller it is.
        predicted: near which it is sought.
    """
    structure, case = build_structure(true), build_case(true)
    plan = plan_run(structure, case, FINE, 0.0)
    found = margin_by_growth(tuned, describe_machine(structure, case), plan, predicted, FINE)
    assert found.is_confirmed
    return found.margin


def residual_on_elements(true, tuned):
    """Residual vibration of mid-span on the worst link, rms [m], arguments as above."""
    structure, case, metrics = build_structure(true), build_case(true), true.metrics
    plan = plan_run(structure, case, STIFF, metrics.residual_delay + metrics.residual_length)
    with exported_law(tuned) as law:
        run = run_twin(describe_machine(structure, case), plan, law, STIFF)
    start = plan.command_end + metrics.residual_delay
    is_late = (run.time >= start) & (run.time <= start + metrics.residual_length)
    return float(np.sqrt(np.mean(run.deflection[is_late] ** 2, axis=0)).max())
