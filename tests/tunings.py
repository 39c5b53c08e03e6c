"""A tuning of a small machine that the tests of tunings share."""

from tests.bare import paper_study, parse_tuning

HOME = list(paper_study().motion.waypoints[0])
SMALL = {
    "run": {"duration": 0.06},
    "link": {"modes": 2},
    "control": {"modes": 2, "ratios": [[1.0, 0.3]] * 3},
    "motion": {"waypoints": [HOME, [0.0, 0.01, HOME[2]]], "move_time": 0.03},
    "shaper": {"kind": "none"},
    "metrics": {"residual_delay": 0.002, "residual_length": 0.015},
}


def tuning(free, **tune):
    """A tuning of a small machine."""
    return parse_tuning({**SMALL, "tune": {"free": free, **tune}})


GAIN = {"control.gain_factor": {"from": 0.05, "to": 2.0, "scale": "log"}}
EVERY_KIND = {
    **GAIN,
    "control.velocity_gain": {"from": 1.0, "to": 100.0, "scale": "log"},
    "control.ratios[1]": {"from": 0.0, "to": 2.0},
    "electronics.lowpass_ratio[0]": {"from": 1.0, "to": 5.0},
    "electronics.highpass_hz": {"from": 20.0, "to": 100.0},
    "shaper.tolerance": {"from": 0.01, "to": 0.2},
    "drive.kp": {"from": 1e4, "to": 4e4},
    "patches.centers[1]": {"from": 0.08, "to": 0.12},
    "machine.platform_mass": {"from": 0.1, "to": 0.4},
}
EACH = {"each": {"motion.move_time": [0.03, 0.035]}}
