"""Faults of a study that involve more than one field."""

from __future__ import annotations

import itertools
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.delay import LONGEST
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveLaw
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import Law
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.piezo import VACUUM_PERMITTIVITY
from jaxmodel.table import Table
from studies.errors import StudyError, field_error, nearest, shown
from studies.study.sizes import defaults_of
from studies.study.state_space import check_system

if TYPE_CHECKING:
    from studies.study.spec import Study

#: A run with more plant steps than this would not fit into memory with its trajectories.
SAMPLE_LIMIT = 2_000_000
#: Fields that take one number for all patches, one list for all links by patch, or one each link.
EACH_PATCH = ("patches.sensor_factor", "patches.actuator_factor")
#: Bandwidth of the slowest amplifier [Hz].
SLOWEST_AMPLIFIER = 1.0


def patch_pitch(study: Study) -> np.ndarray:
    """Length of one patch pair along each link, the longer of both patches [m], (3,)."""
    patches = study.patches
    return np.maximum(
        study.each_link(patches.sensor_length), study.each_link(patches.actuator_length)
    )


def patch_centers(study: Study) -> np.ndarray:
    """Patch centres of every link [m], (3, K)."""
    centers = study.patches.centers
    is_nested = len(centers) > 0 and isinstance(centers[0], tuple)
    rows = centers if is_nested else (centers,) * study.n_links
    if len({len(row) for row in rows}) != 1 or not rows[0]:  # type: ignore[arg-type]
        raise field_error(
            "patches.centers", centers, "one list of centres, or one a link of equal length", "m"
        )
    return np.array(rows, float)


def check_consistency(study: Study) -> None:
    """Check faults that involve more than one field; `studies.engine.preflight` checks poses.

    Raises:
        StudyError: the first fault.
    """
    control = study.control
    _check_patches(study)
    n_patches = patch_centers(study).shape[1]
    if LAWS[control.law].channel == "mode" and control.modes > n_patches:
        raise field_error(
            "control.modes",
            control.modes,
            f"1 to {n_patches}, the number of patch pairs of a link",
            "1",
        )
    if LAWS[control.law].channel == "none" and control.feedback == "ideal":
        raise field_error(
            "control.feedback", "ideal", f"'sampled' or 'none' with control.law = {control.law!r}"
        )
    _check_poles(study)
    check_system(study, n_patches)
    _check_lists(study)
    check_own_fields(study)
    check_mechanism(study)
    _check_basis(study)
    _check_stations(study)
    _check_sampling(study)
    _check_pulses(study)
    _check_coupling(study)


def check_own_fields(study: Study) -> None:
    """Check the own fields of laws, drives and mechanisms, and those of single patches.

    Raises:
        StudyError: one that there is not, or a number out of its bounds.
    """
    count = patch_centers(study).shape[1]
    for field in EACH_PATCH:
        value = attrgetter(field)(study)
        rows = _nested(value) or (value,)
        if isinstance(value, tuple) and any(len(row) != count for row in rows):
            allowed = f"one number, {count} of them (one a patch), or such a list each link"
            raise field_error(field, value, allowed, "1")
    _check_own_fields("control.laws", study.control.laws, LAWS)
    _check_own_fields("drive.kinds", study.drive.kinds, DRIVES)
    _check_own_fields("machine.kinds", study.machine.kinds, MECHANISMS)


def check_mechanism(study: Study) -> None:
    """Check that the study's mechanism reads the fields that are not at their defaults.

    Raises:
        StudyError: one that it does not read.
    """
    mechanism, machine = study.mechanism, study.machine
    solid = {"platform_inertia"} if mechanism.n_pose == 3 else set()
    joints = {"joint_friction", "joint_friction_speed"}
    read = {"kind", "kinds", "platform_mass", *joints, *solid, *mechanism.reads}
    default = defaults_of(type(study), mechanism, "machine")
    for leaf, value in machine:
        if leaf not in read and value != default[leaf]:
            raise StudyError(
                f"machine.{leaf} = {shown(value)}: machine.kind = {mechanism.name!r} has no such "
                "part; leave it out"
            )
    if not solid:
        for leaf in ("inertia", "offset"):
            if np.any(getattr(study.load, leaf)):
                value = getattr(study.load, leaf)
                raise field_error(f"load.{leaf}", value, "0: the platform is a point")


def _check_stations(study: Study) -> None:
    for value in study.metrics.stations:
        if not 0 < value < 1:
            allowed = "between 0 and 1, exclusive: fractions of each link's length"
            raise field_error("metrics.stations", value, allowed, "1")
    shortest, load = study.each_link(study.link.length).min(), study.initial.load_station
    if any(study.initial.load_deflection) and not 0 < load < shortest:
        allowed = f"between 0 and link.length = {shortest:g}, exclusive"
        raise field_error("initial.load_station", load, allowed, "m")


def _is_nested(value: Any) -> bool:
    return isinstance(value, tuple) and any(isinstance(row, tuple) for row in value)


def _check_poles(study: Study) -> None:
    """Check that the law places poles, and what their lists hold."""
    control = study.control
    decay, frequency, damping = control.pole_decay, control.pole_frequency_hz, control.damping
    if damping != ():
        _check_damping(study)
    elif frequency != () and decay == ():
        raise field_error(
            "control.pole_decay",
            decay,
            "more than 0, where control.pole_frequency_hz is given",
            "1/s",
        )
    if not control.has_poles:
        return
    if not LAWS[control.law].places_poles:
        able = ", ".join(name for name, law in LAWS.items() if law.places_poles)
        poles = "damping" if damping != () else "pole_decay"
        raise field_error("control.law", control.law, f"{able}, with control.{poles}")
    for name, value, unit in (
        ("control.damping", damping, "1"),
        ("control.pole_decay", decay, "1/s"),
        ("control.pole_frequency_hz", frequency, "Hz"),
    ):
        if not _is_nested(value):
            continue
        lengths = [len(row) for row in value]  # type: ignore[union-attr,arg-type]
        if min(lengths) < 1 or max(lengths) > control.modes:
            allowed = f"one list a link of 1 to {control.modes} entries (control.modes)"
            raise field_error(name, value, allowed, unit)
    if control.modes > 1 and frequency != () and not _is_nested(frequency):
        raise field_error(
            "control.pole_frequency_hz",
            frequency,
            "one list a link by mode, where control.modes is more than 1: "
            "[[130.0], [120.0], [125.0]] moves mode 1 alone",
            "Hz",
        )


def _check_damping(study: Study) -> None:
    """Check that nothing else decides poles and gains, and that modes still vibrate."""
    control, default = study.control, defaults_of(type(study), study.mechanism, "control")
    for leaf in ("pole_decay", "pole_frequency_hz", "velocity_gain", "position_gain"):
        value = getattr(control, leaf)
        if value != default[leaf]:
            raise StudyError(
                f"control.{leaf} = {shown(value)}: control.damping = {shown(control.damping)} "
                "decides the gains; leave one of them out"
            )
    most = 1 - _largest(study.link.damping_ratio)
    if _largest(control.damping) >= most:
        allowed = f"below {most:g}, 1 less link.damping_ratio"
        raise field_error("control.damping", control.damping, allowed, "1")


def _largest(value: Any) -> float:
    """Largest number of a nested list."""
    return max(map(_largest, value), default=0.0) if isinstance(value, tuple) else value


def _check_own_fields(
    place: str,
    written: dict[str, dict[str, Any]],
    table: Table[Law] | Table[DriveLaw] | Table[Mechanism],
) -> None:
    """Check own fields of laws and their like; a sweep can include those that are not selected."""
    for name, fields in written.items():
        path = f"{place}.{name}"
        if name not in table:
            raise field_error(path, fields, ", ".join(table), hint=nearest(name, table))
        parameters = {parameter.name: parameter for parameter in table[name].parameters}
        for leaf, value in fields.items():
            if leaf not in parameters:
                allowed = ", ".join(parameters) or "no field of its own"
                raise field_error(f"{path}.{leaf}", value, allowed, hint=nearest(leaf, parameters))
            low, high, unit = parameters[leaf].low, parameters[leaf].high, parameters[leaf].unit
            if not np.all((np.asarray(value) >= low) & (np.asarray(value) <= high)):
                raise field_error(f"{path}.{leaf}", value, f"{low:g} to {high:g}", unit)


def _check_patches(study: Study) -> None:
    """Reject patches that leave their link, or overlap."""
    patches, link = study.patches, study.link
    pitches, lengths, is_own = (
        patch_pitch(study),
        study.each_link(link.length),
        _differs(link.length),
    )
    sensor = study.each_link(patches.sensor_length)
    for i, (row, pitch, length) in enumerate(
        zip(patch_centers(study), pitches, lengths, strict=True)
    ):
        of_link = f" (link {i + 1})" if is_own or _differs(list(pitches)) else ""
        if pitch > length:
            name = "sensor" if sensor[i] == pitch else "actuator"
            raise field_error(
                f"patches.{name}_length", pitch, f"at most link.length = {length:g}{of_link}", "m"
            )
        most = int(length / pitch * (1 + 1e-9))
        if len(row) > most:  # no places would do
            raise field_error(
                "patches.centers",
                row.tolist(),
                f"{most} at most, so that patches {pitch:g} m long do not overlap on a link "
                f"{length:g} m long{of_link}",
            )
        ordered, centers = np.sort(row), [float(f"{x:.9g}") for x in row]
        if ordered[0] < pitch / 2 - 1e-12 or ordered[-1] > length - pitch / 2 + 1e-12:
            raise field_error(
                "patches.centers",
                centers,
                f"{pitch / 2:g} to {length - pitch / 2:g}, so that no patch leaves the "
                f"link{of_link}",
                "m",
            )
        if np.any(np.diff(ordered) < pitch - 1e-12):
            raise field_error(
                "patches.centers",
                centers,
                f"centres at least {pitch:g} apart, so that no patches overlap{of_link}",
                "m",
            )
    drain = study.electronics.sensor_highpass_hz
    if patches.sensor == "strain_gauge" and drain > 0:
        raise field_error(
            "electronics.sensor_highpass_hz", drain, "0 where patches.sensor = 'strain_gauge'", "Hz"
        )
    if patches.hysteresis > 0 and study.control.feedback == "ideal":
        raise field_error(
            "patches.hysteresis", patches.hysteresis, "0 where control.feedback = 'ideal'", "1"
        )
    widths = study.each_link(patches.width)
    for i in np.flatnonzero(widths > study.each_link(link.width) * (1 + 1e-9))[:1]:
        raise field_error(
            "patches.width",
            widths[i],
            f"at most link.width = {study.each_link(link.width)[i]:g}",
            "m",
        )


def _differs(value: Any) -> bool:
    return bool(np.ptp(value) > 0)


def check_locked(study: Study) -> None:
    """Reject a path with locked drives, which a run cannot follow; a linearisation can.

    Raises:
        StudyError: more than one way-point.
    """
    if study.drive.locked and len(study.motion.waypoints) > 1:
        raise field_error(
            "motion.waypoints",
            study.motion.waypoints,
            "one pose where drive.locked is true: locked drives follow no path",
            "m, m, rad",
        )


def _check_coupling(study: Study) -> None:
    """The ceramic must couple, but not completely: k31^2 = d31^2 E_p/eps33T in (0, 1)."""
    patches = study.patches
    permittivity = study.each_link(patches.relative_permittivity) * VACUUM_PERMITTIVITY
    highest = np.sqrt(permittivity / study.each_link(patches.youngs_modulus))
    size = np.abs(study.each_link(patches.d31))
    for i in np.flatnonzero((size <= 1e-6 * highest) | (size >= highest))[:1]:
        raise field_error(
            "patches.d31",
            patches.d31,
            f"{1e-6 * highest[i]:.3g} to {highest[i]:.3g} in size, for a coupling k31^2 below 1 "
            "with patches.youngs_modulus and patches.relative_permittivity",
            "C/N",
        )


def _check_pulses(study: Study) -> None:
    """Reject a pulse that starts after the run and would silently do nothing."""
    for name, pulse, start in (
        ("drive.pulse_start", study.drive.pulse_force, study.drive.pulse_start),
        ("load.pulse_start", study.load.pulse, study.load.pulse_start),
    ):
        if any(pulse) and start >= study.run.duration:
            raise field_error(name, start, f"below run.duration = {study.run.duration:g}", "s")


def _check_sampling(study: Study) -> None:
    """Check everything that must fit the sample rate."""
    electronics, rate = study.electronics, study.electronics.sample_rate_hz
    for name in ("antialias_hz", "sensor_highpass_hz"):
        value = getattr(electronics, name)
        if value >= rate / 2:
            raise field_error(
                f"electronics.{name}", value, f"below half the sample rate, {rate / 2:g}", "Hz"
            )
    if 0 < electronics.amplifier_hz < SLOWEST_AMPLIFIER:
        raise field_error(
            "electronics.amplifier_hz",
            electronics.amplifier_hz,
            f"0 (no limit) or {SLOWEST_AMPLIFIER:g} and more",
            "Hz",
        )
    delay, more = electronics.delay, electronics.unmodelled_delay
    if not 0 <= delay + more <= LONGEST:
        raise field_error(
            "electronics.unmodelled_delay",
            more,
            f"{-delay:g} to {LONGEST - delay:g} at electronics.delay = {delay:g}",
            "samples",
        )
    notches = study.control.notch_hz
    if max(notches) >= rate / 2:
        raise field_error(
            "control.notch_hz", notches, f"below half the sample rate, {rate / 2:g}", "Hz"
        )
    for value in study.shaper.frequencies_hz:
        if value >= rate / 2:
            raise field_error(
                "shaper.frequencies_hz", value, f"below half the sample rate, {rate / 2:g}", "Hz"
            )
    longest = SAMPLE_LIMIT / (rate * max(study.run.substeps, 1))
    if study.run.duration > longest:
        raise field_error(
            "run.duration",
            study.run.duration,
            f"up to {longest:g} at this electronics.sample_rate_hz and run.substeps, "
            f"{SAMPLE_LIMIT} plant steps",
            "s",
        )


def _nested(lists: Any) -> tuple[Any, ...]:
    """A table of lists, one a link; empty if one number or list serves all links."""
    return lists if isinstance(lists, tuple) and lists and isinstance(lists[0], tuple) else ()


def _check_basis(study: Study) -> None:
    link, basis = study.link, BASES[study.link.basis]
    with_joints = " or ".join(name for name, one in BASES.items() if one.has_joints)
    on_chord = " or ".join(name for name, one in BASES.items() if one.is_on_chord)
    faults = {
        f"{with_joints}, where a joint has rotary inertia": not basis.has_joints
        and any(map(np.any, (link.joint_inertia_b, link.joint_inertia_c))),
        f"{on_chord}, where drive.locked is true": not basis.is_on_chord and study.drive.locked,
        f"{on_chord}, where run.model is ked: rigid motion prescribes both ends": (
            not basis.is_on_chord and study.run.model == "ked"
        ),
    }
    for allowed, is_fault in faults.items():
        if is_fault:
            raise field_error("link.basis", link.basis, allowed)


def _check_lists(study: Study) -> None:
    moves = len(study.motion.waypoints) - 1
    for name in ("move_time", "dwell"):
        value = getattr(study.motion, name)
        if isinstance(value, tuple) and len(value) != moves:
            raise field_error(
                f"motion.{name}", value, f"one number, or {moves} of them (one per move)", "s"
            )
    control = study.control
    tables = (
        ("control.ratios", control.ratios, control.modes, "1"),
        ("control.mode_mask", control.mode_mask, control.modes, ""),
        ("initial.modal", study.initial.modal, study.link.modes, "m"),
        ("control.frequencies_hz", _nested(control.frequencies_hz), control.modes, "Hz"),
        ("link.damping_ratio", _nested(study.link.damping_ratio), study.link.modes, "1"),
    )
    damping = study.link.damping_ratio
    if damping == () or any(row == () for row in _nested(damping)):
        raise field_error("link.damping_ratio", damping, "at least one number per link", "1")
    hertz = control.frequencies_hz
    for row in _nested(hertz) or (hertz,):
        if any(b <= a for a, b in itertools.pairwise(row)):
            raise field_error("control.frequencies_hz", hertz, "rising from mode to mode", "Hz")
    for name, flat, most, limit, unit in (
        ("control.frequencies_hz", hertz, "control.modes", control.modes, "Hz"),
        ("link.damping_ratio", damping, "link.modes", study.link.modes, "1"),
    ):
        if isinstance(flat, tuple) and not _nested(flat) and len(flat) > limit:
            raise field_error(name, flat, f"at most {most} = {limit} entries", unit)
    for name, table, width, unit in tables[1:]:
        if any(len(row) > width for row in table):
            raise field_error(name, table, f"at most {width} entries per link", unit)
