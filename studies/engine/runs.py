"""One study, one run: checks before it, the run, and its labelled results.

`run_study` is what `studies simulate` and `studies paper` call.
"""

from __future__ import annotations

import json
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from jaxmodel import status
from jaxmodel.axial import critical_force, lumping_error
from jaxmodel.bases import find_bases
from jaxmodel.beam import build_basis
from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller
from jaxmodel.kinematics import SINGULAR_MARGIN, lift, path_status
from jaxmodel.laws import is_modal, n_channels
from jaxmodel.linear import linearise, mechanical, resting
from jaxmodel.metrics import METRICS
from jaxmodel.motion import end_of_path, sample_path
from jaxmodel.plant import damping_ratio
from jaxmodel.prepare import (
    MODE_STEP_LIMIT,
    STIFFNESS_LIMIT,
    drive_rate,
    left_out_deflection,
    lowpass_corner,
    prepare,
    spectrum_frequencies,
)
from jaxmodel.shaper import Taps, last_sample
from jaxmodel.simulate import Result, simulate, steady_load
from studies import config
from studies.engine.poles import PoleReport, pole_report
from studies.engine.stability import LoopReport, MotionReport, loop_report, motion_report
from studies.errors import field_error, warn_of_model
from studies.store import Variable
from studies.study.cases import as_arrays, build_case, build_structure, powered
from studies.study.consistency import check_locked, each_link
from studies.study.labels import DISTANCE_TEXT, STATION_TEXT, STATUS_LABEL
from studies.study.margin import MARGIN_MODES
from studies.study.spec import AUTO, Study
from studies.study.window import never_settles, residual_delay

#: More plant steps per sample than this are rejected.
SUBSTEP_LIMIT = 200
#: Most that lumping the axial inertia may cost without a word [1].
LUMPING_LIMIT = 2e-3


_simulate = jax.jit(simulate, static_argnums=(0, 2))


class Run(NamedTuple):
    """A finished run."""

    study: Study
    structure: Structure
    case: Case
    result: Result  # NumPy arrays
    loop: LoopReport | None  # linearised sampled loop, if there is one
    motion: MotionReport | None  # the same with the forces of the motion
    status: int  # code of `jaxmodel.status`; UNSTABLE comes from the linearised loop
    poles: PoleReport | None = None  # specified and obtained, where gains follow from poles


def run_study(study: Study, has_record: bool = True, has_loop: bool = True) -> Run:
    """Run one study after checking what can be checked beforehand.

    Args:
        study: what to run.
        has_record: keep trajectories.
        has_loop: also judge the linearised sampled loop (takes seconds).

    Raises:
        StudyError: pose out of reach, singular path, motion longer than the run, stiff feedback.
    """
    structure, case = check_run(study)
    if study.control.ratio_source == "own_run":
        case = with_ratio(case, _own_ratio(study, structure, case, has_record))
    result = jax.tree.map(np.asarray, _simulate(structure, case, has_record))
    loop, motion, poles, code = None, None, None, int(result.status)
    if has_loop and structure.feedback == "sampled":
        try:
            loop, poles = loop_and_poles(study, structure, case, code)
            motion = motion_report(structure, case)
        except np.linalg.LinAlgError:  # a non-finite entry
            return Run(
                study=study,
                structure=structure,
                case=case,
                result=result,
                loop=None,
                motion=None,
                status=code or status.NON_FINITE,
            )
        code = judged_status(code, loop)
    return Run(
        study=study,
        structure=structure,
        case=case,
        result=result,
        loop=loop,
        motion=motion,
        status=code,
        poles=poles,
    )


def loop_and_poles(
    study: Study, structure: Structure, case: Case, code: int
) -> tuple[LoopReport, PoleReport | None]:
    """The linearised sampled loop, and specified and obtained poles, if there are any.

    Args:
        study, structure, case: the design, as of `check_run`.
        code: status of its run.

    Raises:
        LinAlgError: an entry of the loop's matrices is not finite.
    """
    tracked = max(3, structure.n_controlled) if structure.has_poles else 3
    loop = loop_report(structure, case, _home(study), min(tracked, structure.n_modes))
    if not structure.has_poles or code == status.UNPLACEABLE:
        return loop, None
    return loop, pole_report(structure, case, loop)


def _own_ratio(study: Study, structure: Structure, case: Case, has_record: bool) -> np.ndarray:
    """Ratios (24) of the same case's uncontrolled run, (3, C); has_record: as the run after it."""
    ratio = _simulate(structure, uncontrolled(case), has_record).metrics.energy_ratio
    return powered(ratio, study.control.ratio_exponent)


def resolved_study(study: Study) -> Study:
    """The same study with explicit EMC ratios, so that no run is needed to find them.

    Raises:
        StudyError: as `run_study`.
    """
    if study.control.ratio_source == "given":
        return study
    ratio = _own_ratio(study, *check_run(study), False)
    return study.change(
        control__ratios=ratio, control__ratio_source="given", control__ratio_exponent=1.0
    )


def uncontrolled(case: Case) -> Case:
    """The same case, or cases, with no link controlled."""
    off = 0 * case.control.link_mask
    return case._replace(control=case.control._replace(link_mask=off))


def uncontrolled_twin(run: Run) -> Run | None:
    """The same run with no link controlled, with trajectories; None if none is anyway."""
    if not is_controlled(run.study):
        return None
    return _without_judgement(run.study, run.structure, uncontrolled(run.case), True)


def run_uncontrolled(study: Study, is_linear: bool = False) -> Run:
    """The run of a study with no link controlled, without trajectories.

    Args:
        study: what to run.
        is_linear: by the linear model.

    Raises:
        StudyError: as `run_study`.
    """
    study = uncontrolled_study(study)
    structure, case = check_run(study)
    return _without_judgement(study, structure._replace(is_linear=is_linear), case, False)


def is_controlled(study: Study) -> bool:
    """Whether any link is controlled."""
    return study.control.feedback != "none" and any(study.control.links)


def uncontrolled_study(study: Study) -> Study:
    """The same study with no link controlled."""
    return study.change(control__links=(False,) * 3)


def _without_judgement(study: Study, structure: Structure, case: Case, has_record: bool) -> Run:
    """Run a case whose loop is not asked about."""
    result = jax.tree.map(np.asarray, _simulate(structure, case, has_record))
    return Run(
        study=study,
        structure=structure,
        case=case,
        result=result,
        loop=None,
        motion=None,
        status=int(result.status),
    )


def with_ratio(case: Case, ratio: Any) -> Case:
    """The same case, or cases, with other EMC ratios, (..., 3, C)."""
    ratio = jnp.asarray(ratio, jnp.result_type(float))
    return case._replace(control=case.control._replace(ratio=ratio))


def judged_status(code: int, loop: LoopReport) -> int:
    """Status of a run: UNSTABLE if its loop is and nothing else stopped it."""
    return status.UNSTABLE if code in status.FINISHED and not loop.is_stable else code


def _home(study: Study) -> np.ndarray:
    return np.array(study.motion.waypoints[0], float)


class Preflight(NamedTuple):
    """What is known about a case before it runs."""

    pose_status: Any  # of every way-point, (n,)
    lift: Any  # of the links there, see `jaxmodel.kinematics.lift` [1], (n, 3)
    path_status: Any  # first fault along the unshaped path, ()
    path_time: Any  # when [s], ()
    path_pose: Any  # where, (3,)
    motion_end: Any  # of the unshaped motion [s], ()
    shaper_length: Any  # [s], ()
    condition: Any  # worst condition number of filter and synthesizer [1], ()
    highest: Any  # frequency of the highest plant mode [rad/s], ()
    damping: Any  # largest damping ratio of a link mode [1], ()
    corner: Any  # highest low-pass corner of the velocity estimate [rad/s], ()
    steady_load: Any  # compression of the links at way-points over their critical force [1], (n, 3)
    critical_force: Any  # [N], (3,)
    lumping: Any  # what lumping the axial inertia costs along the unshaped path [1], ()
    controller: Controller
    taps: Taps  # of the shaper


def preflight(structure: Structure, case: Case) -> Preflight:
    """What is known about a case before it runs, as NumPy arrays."""
    return jax.tree.map(np.asarray, _preflight(_without_run(structure), case))


@partial(jax.jit, static_argnums=0)
def _preflight(structure: Structure, case: Case) -> Preflight:
    prepared = prepare(structure, case)
    plant = prepared.loop.plant
    shaper_length = last_sample(prepared.taps) * case.electronics.period
    points = jnp.asarray(case.path.waypoints)
    each = jax.vmap(lambda pose: (path_status(plant, pose[None])[0], lift(plant, pose)))(points)
    end = end_of_path(case.path)
    time = jnp.linspace(0.0, 1.0, 2001) * end
    wanted = sample_path(case.path, time)
    code, index = path_status(plant, wanted.position)
    lumping = jnp.zeros(())
    if not structure.is_distributed:
        error = partial(lumping_error, plant, prepared.bases.plant)
        lumping = jnp.max(jax.vmap(error)(*wanted))
    worst = jnp.maximum(prepared.sensor_condition.max(), prepared.actuator_condition.max())
    corner = lowpass_corner(structure, case, prepared.bases)
    damping = jnp.max(damping_ratio(case.machine.damping, prepared.loop.omega))
    return Preflight(
        *each,
        code,
        time[index],
        wanted.position[index],
        end,
        shaper_length,
        worst,
        jnp.max(prepared.loop.omega),
        damping,
        corner,
        steady_load(structure, case, plant),
        critical_force(plant),
        lumping,
        prepared.loop.controller,
        prepared.taps,
    )


def _without_run(structure: Structure) -> Structure:
    """Only machine and controller, so that runs of any kind share a compilation."""
    kept = (
        "n_modes",
        "n_controlled",
        "n_patches",
        "basis",
        "has_shortening",
        "is_distributed",
        "has_static_correction",
        "is_coupled",
        "has_wrench",
        "controller_basis",
        "law",
        "has_poles",
        "has_amplifier",
        "has_sensor_highpass",
    )
    fields = {name: getattr(structure, name) for name in kept}
    return Structure(n_steps=1, feedback="none", **fields)


def check_run(study: Study) -> tuple[Structure, Case]:
    """Structure and case of a study, checked against its geometry and step size.

    Raises:
        StudyError: see `run_study`.
    """
    config.require_configured()
    check_locked(study)
    structure, case = build_structure(study), as_arrays(build_case(study))
    structure = structure._replace(substeps=_drive_substeps(study, structure, case))
    known = preflight(structure, case)
    for k, pose in enumerate(study.motion.waypoints):
        check_pose(study, f"motion.waypoints.{k}", pose, int(known.pose_status[k]), known.lift[k])
    if int(known.path_status) != status.OK:
        x, y, phi = known.path_pose
        raise field_error(
            "motion.waypoints",
            f"path at t = {known.path_time:.4g} s, pose ({x:.4g}, {y:.4g}, {phi:.4g})",
            "a path on which every link angle gamma stays inside (0, 90) deg "
            f"(here: {status.REASONS[int(known.path_status)]})",
            "m, m, rad",
        )
    _check_load(study, known)
    if known.lumping > LUMPING_LIMIT:
        warn_of_model(
            f"link.axial_inertia = {study.link.axial_inertia!r} moves deflections by about "
            f"{100 * known.lumping:.2g} % on this path (limit {100 * LUMPING_LIMIT:g} %); "
            "'distributed' is exact"
        )
    _check_duration(study, structure, known)
    is_filtered = is_modal(structure) and structure.feedback != "none"
    if is_filtered and known.condition > study.metrics.condition_limit:
        raise field_error(
            "patches.centers",
            study.patches.centers,
            f"a placement whose modal filter for control.modes = {study.control.modes} has on each "
            f"link a condition number up to metrics.condition_limit = "
            f"{study.metrics.condition_limit:g}; the largest is {known.condition:.3g}",
            "1",
        )
    _check_rates(study, structure, known)
    if structure.feedback == "ideal":
        structure = structure._replace(substeps=_ideal_substeps(study, structure, case))
    return structure, case


def check_pose(
    study: Study, field: str, pose: tuple[float, float, float], code: int, lifts: np.ndarray
) -> None:
    """Reject a pose out of reach, or with a link parallel or square to its guide.

    Args:
        study: supplies the machine.
        field: name for the message.
        pose: (x, y, phi) [m, m, rad].
        code: its status.
        lifts: of the links there, (3,).

    Raises:
        StudyError: out of reach or singular.
    """
    if code == status.OK:
        return
    lengths = each_link(study.link.length)
    wrong = [
        f"link {i + 1} is {length:.4g} m long, its joint lies {x * length:.4g} m inside its guide"
        for i, (x, length) in enumerate(zip(lifts, lengths, strict=True))
        if not SINGULAR_MARGIN <= x < np.sqrt(1 - SINGULAR_MARGIN**2)
    ]
    if not wrong:
        raise field_error(
            field,
            pose,
            "a pose where the lines of the links do not meet in one point "
            f"(here: {status.REASONS[code]})",
            "m, m, rad",
        )
    raise field_error(
        field,
        pose,
        "a pose where the joint of each link lies inside its guide by more than 0 and less than "
        f"link.length, so that gamma is inside (0, 90) deg (here: {status.REASONS[code]}; "
        f"{wrong[0]}; machine.guide_offsets moves it)",
        "m, m, rad",
    )


def _check_load(study: Study, known: Preflight) -> None:
    if np.all(known.steady_load < 1):
        return
    at, link = np.unravel_index(np.argmax(known.steady_load), known.steady_load.shape)
    critical = known.critical_force[link]
    raise field_error(
        "load.wrench",
        study.load.wrench,
        f"a load that compresses no link by its critical force, {critical:.4g} N (here link "
        f"{link + 1}: {known.steady_load[at, link] * critical:.4g} N at way-point {at + 1})",
        "N, N, N m",
    )


def _check_duration(study: Study, structure: Structure, known: Preflight) -> None:
    duration = structure.n_steps / study.electronics.sample_rate_hz
    if duration > 1.5 * study.run.duration:
        raise field_error(
            "run.duration", study.run.duration, f"at least {duration:g}, one sample", "s"
        )
    end = float(known.motion_end + known.shaper_length)
    if end > duration * (1 + 1e-12):
        raise field_error(
            "run.duration",
            study.run.duration,
            f"at least {end:.6g}, the end of the motion with its shaper of "
            f"{known.shaper_length:.4g} s",
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
    if not period * (1 - 1e-9) <= study.metrics.residual_length <= longest + 1e-9:
        raise field_error(
            "metrics.residual_length",
            study.metrics.residual_length,
            f"{period:g} to {max(left, 0):.6g}, from one sample to what run.duration = "
            f"{duration:g} leaves after the shaped motion of {end:.4g} s and "
            f"{_wait_text(study, delay)}; run.duration = {_rounded_up(needed):g} would do",
            "s",
        )


def _rounded_up(duration: float) -> float:
    """The next hundredth of a second [s]."""
    return float(np.ceil(100 * duration - 1e-6) / 100)


def _wait_text(study: Study, delay: float) -> str:
    if study.metrics.residual_delay == AUTO:
        return f"{delay:g} s in which the drive settles (metrics.residual_delay = 'auto')"
    return f"metrics.residual_delay = {delay:g}"


def _check_rates(study: Study, structure: Structure, known: Preflight) -> None:
    """Check plant modes against the step, and low-passes against the sample rate."""
    if known.damping >= 1:
        raise field_error(
            "link.damping_ratio",
            study.link.damping_ratio,
            f"ratios that with link.damping_law = {study.link.damping_law!r} stay below 1 for all "
            f"link.modes = {study.link.modes} (here up to {known.damping:.3g})",
            "1",
        )
    rate = study.electronics.sample_rate_hz
    needed = known.highest / MODE_STEP_LIMIT
    if needed > rate * structure.substeps:
        raise field_error(
            "link.modes",
            study.link.modes,
            f"modes up to {MODE_STEP_LIMIT * rate * structure.substeps / (2 * np.pi):.4g} Hz at "
            f"electronics.sample_rate_hz = {rate:g} and run.substeps = {structure.substeps}; the "
            f"highest one has {known.highest / (2 * np.pi):.4g} Hz",
            "1",
        )
    is_modal_phase = study.electronics.estimator == "modal_phase"
    corner = known.corner / (2 * np.pi)
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
    structure = _without_run(structure)._replace(feedback="ideal")
    poles = np.linalg.eigvals(np.asarray(_mechanics_at(structure, case, pose)))
    return float(np.abs(poles.real).max())


def mechanics_at(structure: Structure, case: Case, pose: Any) -> Any:
    """State matrix of the plant (with ideal feedback, if the structure has it) at a pose."""
    loop = prepare(structure, case).loop
    return mechanical(linearise(structure, loop, pose, resting(structure, case)))


_mechanics_at = jax.jit(mechanics_at, static_argnums=0)


def step_counts(needed: Any) -> np.ndarray:
    """Plant steps per sample to use when `needed` suffice: the next power of two.

    Thus a sweep needs few programs, and a case uses the same steps in any sweep.
    """
    return 2 ** np.ceil(np.log2(np.maximum(needed, 1))).astype(int)


def _drive_substeps(study: Study, structure: Structure, case: Case) -> int:
    """Plant steps per sample that the sliders' drive and friction need, or as given."""
    rate = float(drive_rate(case))
    needed = max(int(np.ceil(rate / study.electronics.sample_rate_hz / STIFFNESS_LIMIT)), 1)
    given, drive = study.run.substeps, study.drive
    if needed <= (given or SUBSTEP_LIMIT):
        return given or int(step_counts(needed))
    if needed <= SUBSTEP_LIMIT:
        raise field_error(
            "run.substeps",
            given,
            f"{needed} to {SUBSTEP_LIMIT}, or 0 for as many as needed; drive and friction have a "
            f"rate of {rate:.3g} 1/s",
            "1",
        )
    slope = drive.coulomb_friction / drive.friction_speed
    parts = {
        "drive.kd": drive.kd,
        "drive.viscous_friction": drive.viscous_friction,
        "drive.coulomb_friction": slope,
    }
    name = max(parts, key=parts.__getitem__)
    value = drive.coulomb_friction if name == "drive.coulomb_friction" else parts[name]
    raise field_error(
        name,
        value,
        f"small enough for {SUBSTEP_LIMIT} plant steps per sample with drive.kd, "
        f"drive.viscous_friction and drive.coulomb_friction/drive.friction_speed = {slope:g} N s/m "
        f"on machine.slider_mass; {needed} would be needed",
        "N" if name == "drive.coulomb_friction" else "N s/m",
    )


def _ideal_substeps(study: Study, structure: Structure, case: Case) -> int:
    """Plant steps per sample for ideal feedback: as the worst way-point needs, or as given."""
    poses = set(study.motion.waypoints)
    fastest = max(pole_decay(structure, case, np.array(pose)) for pose in poses)
    needed = int(np.ceil(fastest / study.electronics.sample_rate_hz / STIFFNESS_LIMIT))
    needed = max(needed, structure.substeps)  # what the drive needs
    given = study.run.substeps
    if given and given < needed <= SUBSTEP_LIMIT:
        raise field_error(
            "run.substeps",
            given,
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
    return given or int(step_counts(needed))


def metric_variables(result: Result) -> dict[str, Variable]:
    """Labelled metrics of a run."""
    return {
        name: Variable(np.asarray(data), METRICS[name].dims, METRICS[name].unit, METRICS[name].text)
        for name, data in result.metrics.items()
    }


_RECORD_LABELS = {
    "pose": (("time", "pose_axis"), "m; m; rad", "platform pose (x, y, phi)"),
    "pose_error": (("time", "pose_axis"), "m; m; rad", "pose minus shaped reference"),
    "slider": (("time", "slider_axis"), "m", "slider position rho"),
    "modal_coordinate": (("time", "link", "mode"), "m", "modal coordinates q of the plant"),
    "controlled_coordinate": (
        ("time", "link", "controlled_mode"),
        "m",
        "controller's modes seen by an ideal modal filter",
    ),
    "chord_deflection_stations": (
        ("time", "link", "station"),
        "m",
        "deflection relative to the chord B-C at the stations",
    ),
    "sensor_voltage": (("time", "link", "patch"), "V", "raw sensor voltage"),
    "actuator_voltage": (("time", "link", "patch"), "V", "actuator voltage"),
    "slider_force": (("time", "slider_axis"), "N", "motor force"),
}


@partial(jax.jit, static_argnums=0)
def _spectrum_frequencies(structure: Structure, case: Case) -> Any:
    return spectrum_frequencies(structure, find_bases(structure, case))


def run_variables(run: Run) -> dict[str, Variable]:
    """Contents of a run's file: axes, trajectories (if kept), metrics, judgement."""
    stations = np.array(run.study.metrics.stations)
    frequency = np.asarray(_spectrum_frequencies(run.structure, run.case))
    variables = {
        "station": Variable(stations, ("station",), "1", STATION_TEXT),
        "link": Variable(np.arange(1, 4), ("link",), "1", "link number"),
        "pose_axis": Variable(np.array(["x", "y", "phi"]), ("pose_axis",), "1", "pose component"),
        "spectrum_frequency": Variable(
            frequency,
            ("link", "controlled_mode", "spectrum_point"),
            "Hz",
            "frequency of spectral_density",
        ),
        "status": Variable(np.array(run.status), (), *STATUS_LABEL),
        "bad_time": Variable(run.result.bad_time, (), "s", "when the status appeared, 0 if ok"),
        "command_end": Variable(
            run.result.command_end, (), "s", "end of the shaped reference trajectory"
        ),
        "sensor_condition": Variable(
            run.result.sensor_condition, ("link",), "1", "condition number of the modal filter"
        ),
        "actuator_condition": Variable(
            run.result.actuator_condition, ("link",), "1", "condition number of the synthesizer"
        ),
        "singularity_distance": Variable(
            run.result.singularity_distance,
            (),
            "rad",
            DISTANCE_TEXT,
        ),
        **metric_variables(run.result),
    }
    if run.loop is not None:
        variables |= {
            "loop_spectral_radius": Variable(
                np.array(run.loop.spectral_radius), (), "1", "of the linearised sampled loop"
            ),
            "gain_margin": Variable(
                np.array(run.loop.gain_margin),
                (),
                "1",
                f"common gain factor before instability, {MARGIN_MODES} plant modes or more",
            ),
            "loop_frequency": Variable(
                run.loop.frequency_hz,
                ("tracked_mode", "tracked_pole"),
                "Hz",
                "frequencies of the lowest link modes under control, three of each order",
            ),
            "loop_damping_ratio": Variable(
                run.loop.damping_ratio,
                ("tracked_mode", "tracked_pole"),
                "1",
                "their damping ratios",
            ),
        }
    if run.poles is not None:
        texts = ("specified", "of the nominal link's loop", "of the assembled machine's loop")
        for name, text, pole in zip(PoleReport._fields, texts, run.poles[:3], strict=False):
            for part, value, unit in (
                ("decay", -pole.real, "s-1"),
                ("frequency", np.abs(pole.imag) / (2 * np.pi), "Hz"),
            ):
                variables[f"{name}_pole_{part}"] = Variable(
                    value, ("link", "controlled_mode"), unit, f"{part} of the poles {text}"
                )
    if run.motion is not None:
        instants = ("instant",)
        variables |= {
            "motion_time": Variable(
                run.motion.time, instants, "s", "start of the unshaped motion, and extremes of N"
            ),
            "motion_axial_force": Variable(
                run.motion.axial_force, ("instant", "link"), "N", "tension N in the links then"
            ),
            "motion_gain_margin": Variable(
                run.motion.gain_margin, instants, "1", "gain margin as if the instant lasted"
            ),
        }
    if run.result.record is not None:
        record = run.result.record
        variables["time"] = Variable(record.time, ("time",), "s", "time")
        for name, (dims, unit, text) in _RECORD_LABELS.items():
            variables[name] = Variable(getattr(record, name), dims, unit, text)
        variables["chord_deflection"] = Variable(
            chord_deflection(run), ("time", "link"), "m", "mid-span relative to the chord B-C"
        )
    return variables


def chord_deflection(run: Run) -> np.ndarray:
    """Mid-span deflection relative to the chord B-C [m], (n_steps, 3).

    From the plant's modes and, for those it leaves out, the voltages on the actuators.
    """
    machine, structure = run.case.machine, run.structure
    middle = each_link(run.study.link.length)[:, None] / 2
    shape = build_basis(structure.basis, machine.beam, machine.patches, structure.n_modes, middle)
    record = run.result.record
    assert record is not None
    bent = np.einsum("tir,ir->ti", record.modal_coordinate, np.asarray(shape.deflection_at)[:, 0])
    if structure.has_static_correction:
        per_volt = np.asarray(left_out_deflection(run.case, shape))[:, 0]
        bent = bent + np.einsum("tik,ik->ti", _applied_voltage(run), per_volt)
    return bent


def _applied_voltage(run: Run) -> np.ndarray:
    """Behind the amplifiers, at the sampling instants [V], (n_steps, 3, K)."""
    assert run.result.record is not None
    command = np.asarray(run.result.record.actuator_voltage)
    if not run.structure.has_amplifier:
        return command
    electronics = run.case.electronics
    kept = np.exp(-electronics.period / electronics.amplifier_lag)
    return lfilter([0.0, 1 - kept], [1.0, -kept], command, axis=0)


def run_attributes(study: Study) -> dict[str, Any]:
    """A file's record of its origin: study, versions, device, precision."""
    return {
        "title": study.title,
        "study": json.dumps(study.model_dump(mode="json")),
        **{name.replace("-", "_"): fact for name, fact in config.origin().items()},
    }
