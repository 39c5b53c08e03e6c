"""Time: energy, order of the step on the study's motion, kernels, metrics from trajectories."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.drive import Reference, settled_motors
from jaxmodel.drives import DRIVES
from jaxmodel.dynamics import kinetic_energy, modal_chain, potential_energy
from jaxmodel.integrator import exponential_step
from jaxmodel.kinematics import inverse_kinematics
from jaxmodel.loop import Loop, PlantState, plant_step
from jaxmodel.motion import end_of_path, sample_path
from jaxmodel.prepare import oscillators, prepare
from jaxmodel.status import FINISHED
from studies.engine.executor import Executor
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.engine.runs import run_study
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study
from studies.verify.rows import Assumption, largest, worst

#: Samples that are stepped at most, and of them compared at most.
_SAMPLES = 400
#: Bending of a machine that is released, over its shortest link [1].
_BENT = 5e-4
#: Most that the two compilers' metrics may differ; locked drives are masses of 1e9 kg, so that
#: reactions to the links are small differences of large forces.
_KERNEL, _KERNEL_LOCKED = 1e-8, 1e-5
#: What excites every metric: a force on slider 1 at the end of the motion, on top [N].
_KICK = 10.0
#: Refinements of the working step; the last is the reference of the others' differences.
_PARTS = (2, 4, 8, 16)
#: Changes of bending below this share of its peak are rounding, that of thousands of steps [1].
_ROUNDING = 1e-10


class Stepped(NamedTuple):
    """What a row needs of a motion, at the samples."""

    deflection: jax.Array  # chord deflection at the stations [m], (T, 3, S)
    energy: jax.Array  # kinetic and bending [J], (T,)


def check_stepping(study: Study) -> list[Assumption]:
    """Energy, order and size of the step, kernel beside scan, metrics beside trajectories."""
    return [_energy(study), *_steps(study), _kernel(study), *_metrics(study)]


def _open_loop(study: Study) -> tuple[Structure, Case]:
    """The study's machine and drive alone."""
    study = study.change(
        control__feedback="none",
        electronics__sensor_highpass_hz=0.0,
        electronics__amplifier_hz=0.0,
        drive__ripple=0.0,
    )
    return build_structure(study), as_arrays(build_case(study))


@kept_jit(static_argnums=(0, 1))
def _step(
    structure: Structure, n_samples: int, case: Case, parts: Any, start: PlantState, is_moving: Any
) -> Stepped:
    """The plant over samples, each in `parts` steps: its path, or held where it starts."""
    loop: Loop = prepare(structure, case).loop
    has_force = DRIVES[structure.drive].has_feedforward or structure.has_wrench
    period = case.electronics.period
    step = period / parts
    omega, zeta, _ = oscillators(structure, case, loop.plant, loop.omega)
    exponential = exponential_step(omega, zeta, step, case.electronics.antialias)
    loop = loop._replace(plant_step=step, exponential=exponential)

    def wanted(time: Any) -> Reference:
        sample = sample_path(case.path, time * is_moving)
        rho, rate = inverse_kinematics(loop.plant, sample.position, sample.velocity * is_moving)
        wrench = case.load.wrench if structure.has_wrench else None
        force = jnp.zeros(structure.n_links) if has_force else None
        return Reference(
            rho=rho,
            rho_rate=rate,
            feedforward=force,
            disturbance=jnp.zeros(structure.n_links),
            wrench=wrench,
        )

    voltage = jnp.zeros((structure.n_links, structure.n_patches))

    def one_sample(state: PlantState, k: Any) -> tuple[PlantState, Stepped]:
        def one_step(part: Any, state: PlantState) -> PlantState:
            time = k * period + part * step
            along = tuple(wanted(time + share * step) for share in (0.0, 0.5, 1.0))
            return plant_step(structure, loop, state, along, voltage)[0]  # type: ignore[arg-type]

        state = jax.lax.fori_loop(0, parts, one_step, state)
        chain = modal_chain(loop.plant, state.pose, state.pose_rate, state.q, state.q_rate)
        energy = kinetic_energy(loop.plant, chain, state.pose_rate, state.q, state.q_rate)
        bent = jnp.einsum("isr,ir->is", loop.deflection_at, state.q)
        return state, Stepped(bent, energy + potential_energy(loop.plant, state.q))

    return jax.lax.scan(one_sample, start, jnp.arange(n_samples))[1]


def _at_rest(structure: Structure, case: Case, q: np.ndarray) -> PlantState:
    zero = np.zeros((structure.n_links, structure.n_coordinates))
    bent = zero.copy()
    bent[:, 0] = q
    pose = np.asarray(case.path.waypoints[0], float)
    still = np.zeros_like(pose)
    motor = settled_motors(structure, still)
    return PlantState(
        pose=pose, pose_rate=still, q=bent, q_rate=zero, z=zero, z_rate=zero, motor=motor
    )


def _energy(study: Study) -> Assumption:
    """The machine without drive, friction, load and damping, bent and let go."""
    free = study.change(
        link__damping_ratio=0.0,
        link__stretch_damping=0.0,
        link__modes=min(study.link.modes, 3),
        drive__kp=0.0,
        drive__kd=0.0,
        drive__kind="pd",
        drive__lag=0.0,
        machine__joint_friction=0.0,
        drive__coulomb_friction=0.0,
        drive__viscous_friction=0.0,
        load__wrench=(0.0,) * study.n_pose,
        initial__modal=(),
    )
    structure, case = _open_loop(free)
    bent = _BENT * float(np.min(study.link.length)) * np.array([1.0, 0.5, -1.0])[: study.n_links]
    start = _at_rest(structure, case, bent)
    energy = np.asarray(_step(structure, _SAMPLES, case, 4, start, 0.0).energy)
    return Assumption(
        assumption="energy of the free machine, bent and let go",
        against=f"its start, over {_SAMPLES} samples",
        source="Hairer, Lubich and Wanner 2006",
        difference=float(np.abs(energy / energy[0] - 1).max()),
        allowed=1e-6,
        left_out="run.model is ked, which keeps none" if study.run.model == "ked" else "",
    )


def _is_moving(study: Study) -> bool:
    return bool(np.ptp(study.motion.waypoints, axis=0).any())


def _steps(study: Study) -> list[Assumption]:
    """Order of the time step, and its error, on the study's path without control."""
    structure, case = _open_loop(study.change(initial__modal=()))
    structure = structure._replace(substeps=check_run(study)[0].substeps)
    is_moving = _is_moving(study)
    length = float(end_of_path(case.path)) if is_moving else 0.02
    period = 1 / study.electronics.sample_rate_hz
    n_samples = int(np.clip(np.ceil(length / period), 1, _SAMPLES))
    n_samples = 2 ** int(np.ceil(np.log2(n_samples)))  # few programs
    parts = structure.substeps * np.array(_PARTS)
    bend = 0.0 if is_moving else _BENT * float(np.min(study.link.length))
    start = _at_rest(structure, case, np.full(structure.n_links, bend))
    working, *finer = [
        np.asarray(_step(structure, n_samples, case, int(n), start, 1.0).deflection)
        for n in (structure.substeps, *parts)
    ]
    size = np.abs(finer[-1]).max()
    change = [np.abs(b - a).max() for a, b in pairwise(finer)]
    # the finest steps whose change is not rounding
    seen = [k for k in range(1, len(change)) if not change[k] <= _ROUNDING * size]
    at = seen[-1] if seen else 1
    order = float(np.log2(change[at - 1] / change[at])) if seen else np.nan
    steps = ", ".join(f"1/{n}" for n in _PARTS[at - 1 : at + 2])
    reason = "" if seen else "the step is exact to rounding"
    if study.drive.coulomb_friction > 0 or study.machine.joint_friction > 0:
        reason = "friction is not smooth"
    elif np.any(study.load.wrench):
        reason = "load.wrench begins with a jump here"
    return [
        Assumption(
            assumption="error of the time step on this motion",
            against=f"steps of a {_PARTS[-1]}th, over the peak of bending",
            source="Cox and Matthews 2002",
            difference=float(np.abs(working - finer[-1]).max() / size),
            allowed=1e-3,
        ),
        Assumption(
            assumption="order of the time step on this motion",
            against=f"4 or more, from {steps} of the step",
            source="Cox and Matthews 2002",
            difference=max(4 - order, 0.0) if np.isfinite(order) else np.inf,
            allowed=0.3,
            left_out=reason,
            note=f"order {order:.2f}" if seen else "",
        ),
    ]


def _excitable(study: Study) -> Study:
    """The study with its pulse where the residual window begins; what rests begins bent."""
    case = check_run(study)[1]
    delay, bent = float(case.windows.residual_delay), _BENT * float(np.min(study.link.length))
    return study.change(
        metrics__residual_delay=delay,
        drive__pulse_start=float(end_of_path(case.path)) + delay,
        drive__pulse_length=max(0.001, 2 / study.electronics.sample_rate_hz),
        initial__modal=study.initial.modal if _is_moving(study) else ((bent,),) * study.n_links,
    )


def _kernel(study: Study) -> Assumption:
    """Cases by the traced kernel and by XLA's scan.

    Half of them are kicked when the residual window begins: metrics of a machine at rest are
    rounding alone, of which the compilers have each their own.
    """
    mass, force = study.machine.platform_mass, study.drive.pulse_force[0]
    data = _excitable(study).model_dump(mode="json", exclude_unset=True)
    axes = {
        "machine.platform_mass": [mass, 1.01 * mass],
        "drive.pulse_force[0]": [force, force + _KICK],
    }
    spec = parse_sweep(data | {"sweep": {"axes": axes}})
    table = build_table(spec)
    rows = np.arange(len(table))
    group = plan_groups(table, rows, local_layout)[0]
    layout = local_layout(len(table), group.structure)
    cases = chunk_cases(table, rows, group.structure, layout.size)
    kernel = Executor(group.structure, layout, kind="kernel")
    fast = kernel.start(cases).wait()
    slow = Executor(group.structure, layout, kind="scan").start(cases).wait()
    apart = [0.0]
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        if not np.array_equal(np.isnan(a), np.isnan(b)):
            apart.append(np.inf)
        elif not np.isnan(b).all():
            apart.append(largest(np.nan_to_num(a), np.nan_to_num(b)))
    return Assumption(
        assumption="machine code of sweeps",
        against=f"XLA's scan: all metrics of {len(table)} cases",
        source="two compilers of the same loop",
        difference=worst(*apart),
        allowed=_KERNEL_LOCKED if study.drive.locked else _KERNEL,
        left_out="" if "kernel" in kernel.name else kernel.name,
    )


def _metrics(study: Study) -> list[Assumption]:
    """Residual vibration and peak voltage, computed again from the trajectories of a run."""
    run = run_study(study, has_loop=False)
    record, metrics, windows = run.result.record, run.result.metrics, run.case.windows
    assert record is not None
    begin = float(run.result.command_end) + float(windows.residual_delay)
    half = 0.5 / study.electronics.sample_rate_hz
    end = begin + float(windows.residual_length)
    inside = (record.time > begin - half) & (record.time < end - half)
    rms = np.sqrt(np.mean(record.chord_deflection_stations[inside] ** 2, axis=0))
    peak = np.abs(record.actuator_voltage).max(axis=(0, 2))
    reason = "" if run.status in FINISHED else "the run does not finish"
    return [
        Assumption(
            assumption="residual vibration as a metric",
            against="rms over the window, from the run's trajectories",
            source="its definition",
            difference=largest(metrics.residual_rms, rms),
            allowed=0.01,
            left_out=reason,
        ),
        Assumption(
            assumption="peak voltage as a metric",
            against="largest command of each link, from the run's trajectories",
            source="its definition",
            difference=largest(metrics.peak_voltage, peak),
            allowed=1e-9,
            left_out=reason,
        ),
    ]
