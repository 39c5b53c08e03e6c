"""Faults of a study that involve more than one field."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmodel.piezo import VACUUM_PERMITTIVITY
from studies.errors import field_error

if TYPE_CHECKING:
    from studies.spec import Study

#: A run of more plant steps than this would not fit into memory with its trajectories.
SAMPLE_LIMIT = 2_000_000
#: Bandwidth of the slowest amplifier [Hz].
SLOWEST_AMPLIFIER = 1.0


def patch_centers(study: Study) -> np.ndarray:
    """Patch centres of every link [m], (3, K)."""
    centers = study.patches.centers
    is_nested = len(centers) > 0 and isinstance(centers[0], tuple)
    rows = centers if is_nested else (centers,) * 3
    if len(rows) != 3 or len({len(row) for row in rows}) != 1 or not rows[0]:  # type: ignore[arg-type]
        raise field_error(
            "patches.centers", centers, "one list of centres, or three lists of equal length", "m"
        )
    return np.array(rows, float)


def check_consistency(study: Study) -> None:
    """Faults that involve more than one field. Those of poses are found in `studies.runs`.

    Raises:
        StudyError: the first fault.
    """
    link, patches, control = study.link, study.patches, study.control
    centers = patch_centers(study)
    half = max(patches.sensor_length, patches.actuator_length) / 2
    if 2 * half > link.length:
        name = "sensor" if patches.sensor_length > patches.actuator_length else "actuator"
        raise field_error(
            f"patches.{name}_length", 2 * half, f"at most link.length = {link.length:g}", "m"
        )
    for row in centers:
        ordered, given = np.sort(row), [float(f"{x:.9g}") for x in row]
        if ordered[0] < half - 1e-12 or ordered[-1] > link.length - half + 1e-12:
            raise field_error(
                "patches.centers",
                given,
                f"{half:g} to {link.length - half:g}, so that no patch leaves the link",
                "m",
            )
        if np.any(np.diff(ordered) < 2 * half - 1e-12):
            raise field_error(
                "patches.centers",
                given,
                f"centres at least {2 * half:g} apart, so that no patches overlap",
                "m",
            )
    if patches.width > link.width * (1 + 1e-9):
        raise field_error(
            "patches.width", patches.width, f"at most link.width = {link.width:g}", "m"
        )
    n_patches = centers.shape[1]
    if control.law == "imsc" and control.modes > n_patches:
        raise field_error(
            "control.modes",
            control.modes,
            f"1 to {n_patches}, the number of patch pairs of a link",
            "1",
        )
    _check_lists(study)
    if link.basis != "loaded" and (link.joint_inertia_b or link.joint_inertia_c):
        raise field_error("link.basis", link.basis, "loaded, where a joint has rotary inertia")
    if study.drive.locked and link.basis == "pinned_free":
        raise field_error(
            "link.basis", link.basis, "pinned_pinned or loaded, where drive.locked is true"
        )
    if study.run.model == "ked" and link.basis == "pinned_free":
        raise field_error(
            "link.basis", link.basis,
            "pinned_pinned or loaded, where run.model is ked: rigid motion prescribes both ends",
        )  # fmt: skip
    stations = ("metrics.stations", study.metrics.stations)
    for name, values in (stations, ("initial.load_station", (study.initial.load_station,))):
        for value in values:
            if not 0 < value < link.length:
                raise field_error(
                    name, value, f"between 0 and link.length = {link.length:g}, exclusive", "m"
                )
    _check_sampling(study)
    _check_pulses(study)
    _check_coupling(study)


def check_locked(study: Study) -> None:
    """Locked sliders follow no path; a linearisation does not mind, a run does.

    Raises:
        StudyError: more than one way-point.
    """
    if study.drive.locked and len(study.motion.waypoints) > 1:
        raise field_error(
            "motion.waypoints", study.motion.waypoints,
            "one pose where drive.locked is true: locked sliders follow no path", "m, m, rad",
        )  # fmt: skip


def _check_coupling(study: Study) -> None:
    """The ceramic must couple, and less than completely: k31^2 = d31^2 E_p/eps33T in (0, 1)."""
    patches = study.patches
    stiffness = patches.youngs_modulus / (patches.relative_permittivity * VACUUM_PERMITTIVITY)
    highest = 1 / stiffness**0.5
    if not 1e-6 * highest < abs(patches.d31) < highest:
        raise field_error(
            "patches.d31", patches.d31,
            f"{1e-6 * highest:.3g} to {highest:.3g} in size, for a coupling k31^2 below 1 with "
            "patches.youngs_modulus and patches.relative_permittivity", "C/N",
        )  # fmt: skip


def _check_pulses(study: Study) -> None:
    """A pulse that begins after the run would do nothing, without a word."""
    for name, pulse, start in (
        ("drive.pulse_start", study.drive.pulse_force, study.drive.pulse_start),
        ("load.pulse_start", study.load.pulse, study.load.pulse_start),
    ):
        if any(pulse) and start >= study.run.duration:
            raise field_error(name, start, f"below run.duration = {study.run.duration:g}", "s")


def _check_sampling(study: Study) -> None:
    """What must fit the sample rate."""
    electronics, rate = study.electronics, study.electronics.sample_rate_hz
    for name in ("antialias_hz", "sensor_highpass_hz"):
        value = getattr(electronics, name)
        if value >= rate / 2:
            raise field_error(
                f"electronics.{name}", value, f"below half the sample rate, {rate / 2:g}", "Hz"
            )
    if 0 < electronics.amplifier_hz < SLOWEST_AMPLIFIER:
        raise field_error(
            "electronics.amplifier_hz", electronics.amplifier_hz,
            f"0 (no limit) or {SLOWEST_AMPLIFIER:g} and more", "Hz",
        )  # fmt: skip
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


def _nested(lists: Any) -> tuple:
    """A table of three lists; empty where one number or list serves all links."""
    return lists if isinstance(lists, tuple) and lists and isinstance(lists[0], tuple) else ()


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
    given = control.frequencies_hz
    for row in _nested(given) or (given,):
        if any(b <= a for a, b in zip(row, row[1:], strict=False)):
            raise field_error("control.frequencies_hz", given, "rising from mode to mode", "Hz")
    for name, flat, most, limit, unit in (
        ("control.frequencies_hz", given, "control.modes", control.modes, "Hz"),
        ("link.damping_ratio", damping, "link.modes", study.link.modes, "1"),
    ):
        if isinstance(flat, tuple) and not _nested(flat) and len(flat) > limit:
            raise field_error(name, flat, f"at most {most} = {limit} entries", unit)
    for name, table, _width, unit in tables:
        if table and len(table) != 3:
            raise field_error(name, table, "three lists, one per link", unit)
    for name, table, width, unit in tables[1:]:
        if any(len(row) > width for row in table):
            raise field_error(name, table, f"at most {width} entries per link", unit)
