"""Designs that tests of exports share; few samples and modes, so that they run fast."""

import shutil
import subprocess

import pytest

from studies.export.compiler import find_compiler
from studies.study.spec import paper_study, parse_study
from studies.study.template import study_template

_HOME = list(paper_study().motion.waypoints[0])
_SHORT = {
    "run": {"duration": 0.08},
    "link": {"modes": 4},
    "motion": {"waypoints": [_HOME, [0.0, 0.01, _HOME[2]]], "move_time": 0.02},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.03},
}
#: The paper's gains at full strength, three modes on three links.
PAPER = {**_SHORT, "title": "paper's gains", "control": {"velocity_gain": [3.1, 3.5, 3.4]}}
#: What `studies tune tune` finds (family together): another placement, position gains, filters.
_CENTERS = [0.051358468594804266, 0.10036657754872896, 0.1491153157157626]
TUNED = {
    **_SHORT,
    "title": "tuned",
    "patches": {"centers": _CENTERS},
    "shaper": {"frequencies_hz": [60.0], "tolerance": 0.005007697526843319},
    "control": {
        "velocity_gain": [3.099016883379442, 2.535706103395066, 2.2332150216347353],
        "position_gain": [0.014314673035428832, 0.09940372426573292, 115.28626469722288],
    },
    "electronics": {
        "highpass_hz": 70.81098311654357,
        "lowpass_ratio": [2.896516411938981, 1.999991236388158, 2.000054185405834],
        "lowpass_zeta": [0.6518003818380292, 0.7000050347175182, 0.7000006412791807],
    },
}
#: Two modes on one link, with the modes it does not control compensated for, and a 16-bit ADC.
SINGLE = {
    **_SHORT,
    "electronics": {"adc_bits": 16},
    "link": {"modes": 4, "length": [0.2, 0.21, 0.2], "thickness": [2.0e-3, 2.1e-3, 1.9e-3]},
    "machine": {"guide_offsets": [0.0, 0.005, 0.0]},
    "load": {"mass": 0.05, "offset": [0.01, -0.005]},
    "title": "two modes, one link of three different ones",
    "control": {"modes": 2, "links": [False, True, False], "feedthrough_factor": 0.7},
}
DESIGNS = {"paper": PAPER, "tuned": TUNED, "single": SINGLE}


def write_study(path, data):
    """A complete study file; path: where."""
    path.write_text(study_template(parse_study(data)))
    return path


def needs_compiler():
    """The C compiler's command; skips the test where there is none."""
    command = find_compiler()
    if not command:
        pytest.skip("no C compiler here (cc, gcc, clang, or the variable CC)")
    return command


def needs_sanitizers(folder):
    """A compiler that has address and undefined-behaviour sanitizers, with their flags."""
    command = [*needs_compiler(), "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    source = folder / "nothing.c"
    source.write_text("int main(void) { return 0; }\n")
    done = subprocess.run(
        [*command, "-o", folder / "nothing", source], capture_output=True, timeout=120
    )
    if (
        done.returncode
        or subprocess.run([folder / "nothing"], capture_output=True, timeout=120).returncode
    ):
        pytest.skip("the C compiler here has no address and undefined-behaviour sanitizers")
    return command


def needs_cpp():
    """A C++ compiler's command; skips the test where there is none."""
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    pytest.skip("no C++ compiler here (c++, g++, clang++)")
