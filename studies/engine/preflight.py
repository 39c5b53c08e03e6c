"""Checks before a run: poses, path, load, durations, rates; the plant steps per sample it needs."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import status
from jaxmodel.axial import critical_force, lumping_error
from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller
from jaxmodel.drive import LAG_POLE
from jaxmodel.drives import DRIVES
from jaxmodel.kinematics import path_status
from jaxmodel.laws import is_modal, n_channels
from jaxmodel.linear import linearise, mechanical, resting
from jaxmodel.motion import end_of_path, sample_path
from jaxmodel.plant import damping_ratio
from jaxmodel.prepare import (
    COUPLED_STEP_LIMIT,
    MODE_STEP_LIMIT,
    STIFFNESS_LIMIT,
    coupled_rate,
    drive_rate,
    lowpass_corner,
    prepare,
)
from jaxmodel.shaper import Taps, last_sample
from jaxmodel.simulate import steady_load
from studies import config
from studies.engine.programs import kept_jit
from studies.engine.simplifications import (
    warn_of_lumping,
    warn_of_mismatch,
    warn_of_patches,
    warn_of_sizes,
)
from studies.errors import field_error
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.consistency import check_locked
from studies.study.geometry import far_joints, machine_geometry
from studies.study.spec import AUTO, Study
from studies.study.window import never_settles, residual_delay

#: More plant steps per sample than this are rejected.
SUBSTEP_LIMIT = 200


class Preflight(NamedTuple):
    """What is known about a case before it runs."""

    pose_status: Any  # of every way-point, (m,)
    path_status: Any  # first fault along the unshaped path, ()
    path_time: Any  # when [s], ()
    path_pose: Any  # where, (p,)
    motion_end: Any  # of the unshaped motion [s], ()
    shaper_length: Any  # [s], ()
    condition: Any  # worst condition number of filter and synthesizer [1], ()
    drive_rate: Any  # of the drives and their friction [1/s], ()
    coupled_rate: Any  # highest mode of links whose ends are not on their chords [rad/s], ()
    highest: Any  # frequency of the highest plant mode [rad/s], ()
    damping: Any  # largest damping ratio of a link mode [1], ()
    corner: Any  # highest low-pass corner of the velocity estimate [rad/s], ()
    steady_load: Any  # compression of the links at way-points over their critical force [1], (n, 3)
    critical_force: Any  # [N], (3,)
    lumping: Any  # what lumping the axial inertia costs along the unshaped path [1], ()
    plant_omega: Any  # of the links between held ends [rad/s], (3, C)
    believed_omega: Any  # the controller's modes, as it believes them [rad/s], (3, C)
    controller: Controller
    taps: Taps  # of the shaper


def preflight(structure: Structure, case: Case) -> Preflight:
    """What is known about a case before it runs, as NumPy arrays."""
    # whoever reads the controller finds all gains in it
    plain = structure.without_run()._replace(feedback="none", has_position_gain=True)
    return jax.tree.map(np.asarray, _preflight(plain, case))


@kept_jit(static_argnums=0, is_quick=True)
def _preflight(structure: Structure, case: Case) -> Preflight:
    prepared = prepare(structure, case)
    plant = prepared.loop.plant
    shaper_length = last_sample(prepared.taps) * case.electronics.period
    points = jnp.asarray(case.path.waypoints)
    reached = jax.vmap(lambda pose: path_status(plant, pose[None])[0])(points)
    end = end_of_path(case.path)
    time = jnp.linspace(0.0, 1.0, 2001) * end
    reference = sample_path(case.path, time)
    code, index = path_status(plant, reference.position)
    lumping = jnp.zeros(())
    if not structure.is_distributed:
        error = partial(lumping_error, plant, prepared.bases.plant)
        lumping = jnp.max(jax.vmap(error)(*reference))
    worst = jnp.maximum(prepared.sensor_condition.max(), prepared.actuator_condition.max())
    corner = lowpass_corner(structure, case, prepared.bases)
    damping = jnp.max(damping_ratio(case.machine.damping, prepared.loop.omega))
    return Preflight(
        pose_status=reached,
        path_status=code,
        path_time=time[index],
        path_pose=reference.position[index],
        motion_end=end,
        shaper_length=shaper_length,
        condition=worst,
        drive_rate=drive_rate(structure.drive, case),
        coupled_rate=coupled_rate(structure, case),
        highest=jnp.max(prepared.loop.omega),
        damping=damping,
        corner=corner,
        steady_load=steady_load(structure, case, plant),
        critical_force=critical_force(plant),
        lumping=lumping,
        plant_omega=prepared.bases.plant_omega,
        believed_omega=prepared.bases.believed_omega,
        controller=prepared.loop.controller,
        taps=prepared.taps,
    )


def check_run(study: Study) -> tuple[Structure, Case]:
    """Structure and case of a study, checked against its geometry and step size.

    Raises:
        StudyError: see `run_study`.
    """
    return _checked(study, True)


def check_machine(study: Study) -> tuple[Structure, Case]:
    """The same for what reads machine and controller at the way-points, and runs no motion.

    Raises:
        StudyError: as `check_run`, but for the path between them, its duration and its windows.
    """
    return _checked(study, False)


def _checked(study: Study, is_run: bool) -> tuple[Structure, Case]:
    config.require_configured()
    warn_of_sizes(study)  # a wrong unit may be what is refused below
    check_locked(study)
    structure, case = build_structure(study), as_arrays(build_case(study))
    prepared = preflight(structure, case)
    substeps = _drive_substeps(study, float(prepared.drive_rate))
    rate = float(prepared.coupled_rate) / study.electronics.sample_rate_hz / COUPLED_STEP_LIMIT
    if not study.run.substeps:
        substeps = max(substeps, int(step_counts(rate)))
    joints, most = study.machine, study.run.substeps or SUBSTEP_LIMIT
    if joints.joint_friction > 0 and rate > most:
        beside = f"machine.joint_friction_speed = {joints.joint_friction_speed:g} rad/s"
        allowed = _resolved(most, beside, math.ceil(rate))
        raise field_error("machine.joint_friction", joints.joint_friction, allowed, "N m")
    structure = structure._replace(substeps=substeps)
    for k, pose in enumerate(study.motion.waypoints):
        check_pose(study, f"motion.waypoints.{k}", pose, int(prepared.pose_status[k]))
    if is_run and int(prepared.path_status) != status.OK:
        place = ", ".join(f"{x:.4g}" for x in prepared.path_pose)
        raise field_error(
            "motion.waypoints",
            f"path at t = {prepared.path_time:.4g} s, pose ({place})",
            f"{study.mechanism.allowed}, all along the path "
            f"(here: {status.REASONS[int(prepared.path_status)]})",
            "m, m, rad",
        )
    _check_load(study, prepared)
    if is_run:
        _check_duration(study, structure, prepared)
    is_filtered = is_modal(structure) and structure.feedback != "none"
    if is_filtered and prepared.condition > study.metrics.condition_limit:
        raise field_error(
            "patches.centers",
            study.patches.centers,
            f"a placement whose modal filter for control.modes = {study.control.modes} has on each "
            f"link a condition number up to metrics.condition_limit = "
            f"{study.metrics.condition_limit:g}; the largest is {prepared.condition:.3g}",
            "1",
        )
    _check_rates(study, structure, prepared)
    if structure.feedback == "ideal":
        structure = structure._replace(substeps=_ideal_substeps(study, structure, case))
    warn_of_patches(study)
    warn_of_lumping(study, float(prepared.lumping))
    warn_of_mismatch(study, prepared.plant_omega, prepared.believed_omega)
    return structure, case


def check_pose(study: Study, field: str, pose: tuple[float, ...], code: int) -> None:
    """Reject a pose out of reach, or a singular one.

    Args:
        study: supplies the machine.
        field: name for the message.
        pose: (x, y, phi), or (x, y) of a point [m, m, rad].
        code: its status.

    Raises:
        StudyError: out of reach or singular.
    """
    if code == status.OK:
        return
    geometry, _ = machine_geometry(study)
    far, _ = far_joints(geometry, pose, study.n_links)
    wrong = geometry.legs(np).misplaced(*far.T, study.each_link(study.link.length))
    allowed = study.mechanism.allowed
    if not wrong:
        allowed = "a pose where the lines of the links do not meet in one point"
    reason = "; ".join([status.REASONS[code], *wrong[:1]])
    raise field_error(field, pose, f"{allowed} (here: {reason})", "m, m, rad")


def _check_load(study: Study, prepared: Preflight) -> None:
    if np.all(prepared.steady_load < 1):
        return
    at, link = np.unravel_index(np.argmax(prepared.steady_load), prepared.steady_load.shape)
    critical = prepared.critical_force[link]
    raise field_error(
        "load.wrench",
        study.load.wrench,
        f"a load that compresses no link by its critical force, {critical:.4g} N (here link "
        f"{link + 1}: {prepared.steady_load[at, link] * critical:.4g} N at way-point {at + 1})",
        "N, N, N m",
    )


def _check_duration(study: Study, structure: Structure, prepared: Preflight) -> None:
    duration = structure.n_steps / study.electronics.sample_rate_hz
    if duration > 1.5 * study.run.duration:
        raise field_error(
            "run.duration", study.run.duration, f"at least {duration:g}, one sample", "s"
        )
    end = float(prepared.motion_end + prepared.shaper_length)
    if end > duration * (1 + 1e-12):
        raise field_error(
            "run.duration",
            study.run.duration,
            f"at least {end:.6g}, the end of the motion with its shaper of "
            f"{prepared.shaper_length:.4g} s",
            "s",
        )
    delay = residual_delay(study)
    if np.isinf(delay):
        raise never_settles(study)
    left = duration - end - delay
    needed = end + delay + study.metrics.residual_length
    period = 1 / study.electronics.sample_rate_hz
    # free vibration of a platform at rest: the window can end with the run
    is_free = len(study.motion.waypoints) == 1 and left > period / 2
    longest = np.inf if is_free else left
    if longest < period * (1 - 1e-9):  # no residual_length would do
        raise field_error(
            "run.duration",
            study.run.duration,
            f"{_round_up(needed):g} or more: nothing is left for the residual window after the "
            f"shaped motion of {end:.4g} s and {_wait_text(study, delay)}; metrics.residual_length "
            f"= {study.metrics.residual_length:g}",
            "s",
        )
    if not period * (1 - 1e-9) <= study.metrics.residual_length <= longest + 1e-9:
        raise field_error(
            "metrics.residual_length",
            study.metrics.residual_length,
            f"{period:g} to {left:.6g}, from one sample to what run.duration = "
            f"{duration:g} leaves after the shaped motion of {end:.4g} s and "
            f"{_wait_text(study, delay)}; run.duration = {_round_up(needed):g} would do",
            "s",
        )


def _round_up(duration: float) -> float:
    """The next hundredth of a second [s]."""
    return float(np.ceil(100 * duration - 1e-6) / 100)


def _wait_text(study: Study, delay: float) -> str:
    if study.metrics.residual_delay == AUTO:
        return f"{delay:g} s in which the drive settles (metrics.residual_delay = 'auto')"
    return f"metrics.residual_delay = {delay:g}"


def _check_rates(study: Study, structure: Structure, prepared: Preflight) -> None:
    """Check plant modes against the step, and low-passes against the sample rate."""
    if prepared.damping >= 1:
        raise field_error(
            "link.damping_ratio",
            study.link.damping_ratio,
            f"ratios that with link.damping_law = {study.link.damping_law!r} stay below 1 for all "
            f"link.modes = {study.link.modes} (here up to {prepared.damping:.3g})",
            "1",
        )
    rate = study.electronics.sample_rate_hz
    needed = prepared.highest / MODE_STEP_LIMIT
    if needed > rate * structure.substeps:
        raise field_error(
            "link.modes",
            study.link.modes,
            f"modes up to {MODE_STEP_LIMIT * rate * structure.substeps / (2 * np.pi):.4g} Hz at "
            f"electronics.sample_rate_hz = {rate:g} and run.substeps = {structure.substeps}; the "
            f"highest one has {prepared.highest / (2 * np.pi):.4g} Hz",
            "1",
        )
    is_modal_phase = study.electronics.estimator == "modal_phase"
    corner = prepared.corner / (2 * np.pi)
    if structure.feedback == "sampled" and is_modal_phase and corner >= rate / 2:
        raise field_error(
            "electronics.lowpass_ratio",
            study.electronics.lowpass_ratio,
            f"low-pass corners below half the sample rate, {rate / 2:g} Hz; the highest of the "
            f"{n_channels(structure)} is at {corner:.5g} Hz (lower it, control.modes or raise "
            "electronics.sample_rate_hz)",
            "1",
        )


def pole_decay(structure: Structure, case: Case, pose: Any) -> float:
    """Fastest decay |Re lambda| [1/s] of the plant with ideal feedback at a pose."""
    structure = structure.without_run()._replace(feedback="ideal", has_position_gain=True)
    poles = np.linalg.eigvals(np.asarray(_mechanics_at(structure, case, pose)))
    return float(np.abs(poles.real).max())


def mechanics_at(structure: Structure, case: Case, pose: Any) -> Any:
    """State matrix of the plant (with ideal feedback, if the structure has it) at a pose."""
    loop = prepare(structure, case).loop
    return mechanical(linearise(structure, loop, pose, resting(structure, case)))


_mechanics_at = kept_jit(static_argnums=0)(mechanics_at)


def step_counts(needed: Any) -> np.ndarray:
    """Plant steps per sample to use when `needed` suffice: the next power of two.

    Thus a sweep needs few programs, and a case uses the same steps in any sweep. Where more than
    `SUBSTEP_LIMIT` are needed, the case's own status says that they do not suffice.
    """
    return 2 ** np.ceil(np.log2(np.clip(needed, 1, SUBSTEP_LIMIT))).astype(int)


def _drive_substeps(study: Study, rate: float) -> int:
    """Plant steps per sample that the drives and their friction need, or as given."""
    if not np.isfinite(rate):
        allowed = "a drive whose force has finite slopes at rest"
        raise field_error("drive.kind", study.drive.kind, allowed)
    needed = max(int(np.ceil(rate / study.electronics.sample_rate_hz / STIFFNESS_LIMIT)), 1)
    written, drive = study.run.substeps, study.drive
    if needed <= (written or SUBSTEP_LIMIT):
        return written or int(step_counts(needed))
    if needed <= SUBSTEP_LIMIT:
        raise field_error(
            "run.substeps",
            written,
            f"{needed} to {SUBSTEP_LIMIT}, or 0 for as many as needed; drive and friction have a "
            f"rate of {rate:.3g} 1/s",
            "1",
        )
    shortest = LAG_POLE / (SUBSTEP_LIMIT * STIFFNESS_LIMIT * study.electronics.sample_rate_hz)
    if 0 < drive.lag < shortest:
        allowed = f"0, or {shortest:.2g} or more, which {SUBSTEP_LIMIT} plant steps resolve"
        raise field_error("drive.lag", drive.lag, allowed, "s")
    slope = drive.coulomb_friction / drive.friction_speed
    kd = 0.0 if DRIVES[drive.kind].is_sampled else drive.kd
    _, name, value, unit = max(
        (kd, "kd", drive.kd, "N s/m"),
        (drive.viscous_friction, "viscous_friction", drive.viscous_friction, "N s/m"),
        (slope, "coulomb_friction", drive.coulomb_friction, "N"),
    )
    beside = (
        "drive.kd, drive.viscous_friction and drive.coulomb_friction/drive.friction_speed = "
        f"{slope:g} N s/m on machine.slider_mass"
    )
    raise field_error(f"drive.{name}", value, _resolved(SUBSTEP_LIMIT, beside, needed), unit)


def _resolved(steps: int, beside: str, needed: int) -> str:
    return (
        f"small enough for {steps} plant steps per sample with {beside}; {needed} would be needed"
    )


def _ideal_substeps(study: Study, structure: Structure, case: Case) -> int:
    """Plant steps per sample for ideal feedback: as the worst way-point needs, or as given."""
    poses = set(study.motion.waypoints)
    fastest = max(pole_decay(structure, case, np.array(pose)) for pose in poses)
    needed = int(np.ceil(fastest / study.electronics.sample_rate_hz / STIFFNESS_LIMIT))
    needed = max(needed, structure.substeps)  # what the drive needs
    written = study.run.substeps
    if written and written < needed <= SUBSTEP_LIMIT:
        raise field_error(
            "run.substeps",
            written,
            f"{needed} to {SUBSTEP_LIMIT}, or 0 for as many as needed; ideal feedback has a pole "
            f"at {fastest:.3g} 1/s",
            "1",
        )
    if needed > SUBSTEP_LIMIT:
        raise field_error(
            "control.gain_factor",
            study.control.gain_factor,
            f"gains low enough for {SUBSTEP_LIMIT} plant steps per sample; ideal feedback has a "
            f"pole at {fastest:.3g} 1/s, which needs {needed}",
            "1",
        )
    return written or int(step_counts(needed))
