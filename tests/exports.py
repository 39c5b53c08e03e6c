"""Designs that tests of exports share; few samples and modes, and one program for all."""

import shutil
import subprocess

import numpy as np
import pytest

from studies.engine.controller import fixed_controller
from studies.export.compiler import find_compiler
from studies.study.template import study_template
from tests.bare import paper_study, parse_study

_HOME = list(paper_study().motion.waypoints[0])
_SHORT = {
    "run": {"duration": 0.08},
    "link": {"modes": 3},
    "motion": {"waypoints": [_HOME, [0.0, 0.01, _HOME[2]]], "move_time": 0.02},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.03},
    "load": {"mass": 0.05, "offset": [0.01, -0.005]},
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
    "link": {"modes": 3, "length": [0.2, 0.21, 0.2], "thickness": [2.0e-3, 2.1e-3, 1.9e-3]},
    "machine": {"guide_offsets": [0.0, 0.005, 0.0]},
    "title": "two modes, one link of three different ones",
    "control": {
        "links": [False, True, False],
        "mode_mask": [[True, True, False]] * 3,  # of as many modes as PAPER has: one program
        "feedthrough_factor": 0.7,
    },
}
DESIGNS = {"paper": PAPER, "tuned": TUNED, "single": SINGLE}


def changed(data, **sections):
    """A design with other values in some sections."""
    merged = {name: {**data.get(name, {}), **values} for name, values in sections.items()}
    return {**data, **merged}


#: Kinds of controllers: laws, estimators, position gains, feed-through, converters.
KINDS = {
    "paper": PAPER,
    "tuned": TUNED,
    "feed-through": {
        **SINGLE,
        "control": {"modes": 2, "links": [False, True, False], "feedthrough_factor": 0.7},
    },
    "difference and position gain": changed(
        PAPER,
        electronics={"estimator": "difference"},
        control={"gain_factor": 0.02, "position_gain": [100.0, 50.0, 0.0]},
    ),
    "strain rate feedback": changed(
        PAPER, control={"law": "srf", "velocity_gain": [0.001] * 3, "gain_factor": 0.5}
    ),
    "other converters": changed(
        PAPER,
        electronics={
            "conditioner_bias": 1.234,
            "adc_bits": 10,
            "voltage_limit": 30.0,
            "conditioner_gain": 0.7,
        },
    ),
}


def found_and_codes(data, length=500):
    """A controller with ADC codes around its bias, no matter what plant makes them."""
    found = fixed_controller(parse_study(data))
    middle = float(found.controller.adc_bias / found.controller.adc_step)
    top = float(found.controller.adc_top)
    rng = np.random.default_rng(0)
    time = np.arange(length)[:, None, None]
    phase, frequency = rng.uniform(0, 6, (3, 3)), rng.uniform(0.02, 0.4, (3, 3))
    wave = middle + 0.2 * top * np.sin(frequency * time + phase) + rng.normal(size=(length, 3, 3))
    return found, np.clip(np.round(wave), 1, top - 1)


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


def needs_sanitizers(folder, command=(), kinds="address,undefined"):
    """A compiler's command with sanitizers; skips the test where it has none of these kinds."""
    command = command or needs_compiler()
    if not shutil.which(command[0]):
        pytest.skip(f"no {command[0]} here")
    command = [*command, f"-fsanitize={kinds}", "-fno-sanitize-recover=all"]
    source, program = folder / "nothing.c", folder / "nothing"
    source.write_text("int main(void) { return 0; }\n")
    for trial in ([*command, "-o", program, source], [program]):
        if subprocess.run(trial, capture_output=True, timeout=120).returncode:
            pytest.skip(f"{command[0]} has no sanitizers {kinds} here")
    return command


def needs_cpp():
    """A C++ compiler's command; skips the test where there is none."""
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    pytest.skip("no C++ compiler here (c++, g++, clang++)")
