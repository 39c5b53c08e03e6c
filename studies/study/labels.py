"""Names of a run's codes and numbers in files, tables and reports."""

from __future__ import annotations

from jaxmodel import status

#: Where a station is.
STATION_TEXT = "position along the link, over its length"
#: Of the platform's coordinates.
POSE_UNITS = "m; m; rad"
#: What `singularity_distance` means.
DISTANCE_TEXT = "of link angles from 0 and 90 deg, and of the links from lines through one point"


#: Unit, long name and flags of a status in a file.
STATUS_LABEL = ("1", "how the run ended", status.REASONS)


def describe(code: int) -> str:
    """A status code in words."""
    return status.REASONS.get(code, f"status {code}")


#: Names of variables in files that are no metrics.
RESERVED = (
    "actuator_condition",
    "axes",
    "bad_time",
    "breaking_frequency",
    "breaking_mode",
    "case",
    "case_id",
    "command_end",
    "control_effort_peak",
    "controlled_mode",
    "damping_ratio",
    "delay_margin",
    "disk_margin",
    "disturbance_deflection_peak",
    "frequency_error",
    "gain_margin",
    "link",
    "link_mode_masks",
    "link_subsets",
    "mode",
    "patch",
    "phase_margin",
    "pose_axis",
    "record",
    "repeat",
    "seed",
    "sensitivity_peak",
    "sensor_condition",
    "singularity_distance",
    "slider_axis",
    "spectrum_point",
    "station",
    "status",
    "status_text",
    "substeps",
    "time",
)


#: What to change where a run ends at a limit of the machine, or ends too early.
_REMEDIES = {
    status.SHAPER_TOO_LONG: "lengthen the run (run.duration)",
    status.WINDOW_TOO_LONG: "lengthen the run (run.duration), or shorten the window "
    "(metrics.residual_delay, metrics.residual_length)",
    status.CLIPPED: "lower electronics.conditioner_gain, or move more slowly (motion.move_time)",
    status.SATURATED: "lower control.gain_factor, or move more slowly (motion.move_time)",
    status.MOTORS_SATURATED: "move more slowly (motion.move_time), or raise drive.force_limit",
    status.NOT_ARRIVED: "let the run and its window begin later (metrics.residual_delay), or "
    "stiffen the drive (drive.kp)",
    status.STRAINED: "move more slowly (motion.move_time), or lower electronics.voltage_limit",
}


def remedy(code: int) -> str:
    """What to change so that a run does not end with this status; "" if nothing general helps."""
    return _REMEDIES.get(code, "")
