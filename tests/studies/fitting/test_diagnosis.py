"""What is said of data that the model does not explain: the fault that was put in, and no other."""

import copy
import re

import numpy as np
import pytest

from studies.fitting.diagnosis import BETTER, diagnose
from studies.fitting.estimate import fit
from studies.fitting.faults import fault_of
from studies.fitting.problem import Problem
from studies.fitting.report import sentences
from studies.fitting.solve import descend
from tests.fits import (
    FREE,
    FREQUENCY,
    MAGNITUDE,
    MODES,
    RESPONSE,
    SPECTRUM,
    TRACE,
    blank,
    give_data,
    made,
    spec_of,
    write,
)

SIGNALS = [
    ("actuator 1.1", "sensor 1.2"),
    ("actuator 2.2", "sensor 2.3"),
    ("slider 3", "sensor 3.1"),
]
TRUE = np.array([66e9, 0.009, 0.27])
FREED = {name: FREE[name] for name in ("link.youngs_modulus", "link.damping_ratio")}


def entries():
    return [
        RESPONSE | {"name": f"response {k + 1}", "input": a, "output": b, "file": f"r{k}.csv"}
        for k, (a, b) in enumerate(SIGNALS)
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("data")
    blank(path)
    one = np.ones(len(FREQUENCY))
    for k in range(len(SIGNALS)):
        write(path, f"r{k}.csv", frequency_hz=FREQUENCY, real=one, imag=one)
    return path


@pytest.fixture(scope="module")
def measured(folder):
    """Specification, bench and noisy responses of the true machine."""
    spec = spec_of(folder, *entries())
    bench, every, _ = made(spec)
    rng = np.random.default_rng(0)
    for one in every:
        exact, _ = one.predict(TRUE, False)
        one.reweigh(TRUE)
        one.sigma = np.hypot(0.03 * np.abs(exact), 1e-5)
        one.measured = exact + one.sigma * (rng.normal(size=(2, len(exact))).T @ [1, 1j])
    return spec, bench, every


def diagnosed(measured, spoilt):
    """Remedies of a fit in which some responses are spoilt, by functions of number and response."""
    spec, bench, every = measured
    every = [spoilt(k, copy.copy(one)) for k, one in enumerate(every)]
    problem = Problem(spec.free, spec.priors, tuple(every), bench)
    optimum = descend(problem, problem.free.places(), 40)
    return diagnose(spec, problem, optimum.u)


def scaled(one, factor):
    one.measured, one.sigma = factor * one.measured, abs(factor) * one.sigma
    return one


def late(one, delay):
    one.measured = one.measured * np.exp(-2j * np.pi * one.frequency * delay)
    return one


def in_radians(one):
    one.frequency = 2 * np.pi * one.frequency
    return one


def conjugated(one):
    one.measured = one.measured.conj()
    return one


def only(number, change):
    return lambda k, one: change(one) if k == number else one


#: What is done to the responses, what is said of it, and its size.
FAULTS = {
    "polarity": (only(1, lambda x: scaled(x, -1)), "response 2: its polarity is reversed", None),
    "conjugate": (only(0, conjugated), "response 1: it is conjugated", None),
    "unit": (only(1, lambda x: scaled(x, 9.80665)), "response 2: .* factor of 9.81, as of", None),
    "gain": (only(0, lambda x: scaled(x, 1.37)), r"response 1: .* factor of ([\d.]+)$", 1.37),
    "delay": (only(1, lambda x: late(x, 4e-4)), r"response 2: it is late by ([\d.]+) ms$", 0.4),
    "all delayed": (
        lambda _, x: late(x, -2.5e-4),
        r"every measurement: it is early by ([\d.]+) ms$",
        0.25,
    ),
    "rad/s": (lambda _, x: in_radians(x), "every measurement: its frequencies are in rad/s", None),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_fault_of_the_data_is_named(measured, name):
    spoilt, text, size = FAULTS[name]
    best = diagnosed(measured, spoilt)[0]
    found = re.match(text, best.text)
    assert found, best.text
    assert size is None or float(found[1]) == pytest.approx(size, rel=0.02)
    count = 2 * len(FREQUENCY) * len(SIGNALS)
    assert best.after < 1.3 * count and best.before > 3 * best.after


def test_exchanged_channels_are_named(measured):
    def swapped(k, one):
        if k == 1:  # the cable of sensor 2.2 in the socket of 2.3
            true = copy.copy(one)
            true.signals = one.signals[0], one.signals[1]._replace(patch=1)
            exact, _ = true.predict(TRUE, False)
            noise = one.measured / one.predict(TRUE, False)[0]
            one.measured, one.sigma = exact * noise, np.hypot(0.03 * np.abs(exact), 1e-5)
        return one

    best = diagnosed(measured, swapped)[0]
    assert best.text == "response 2: its sensor is 2.2"


def moved(one, delay):
    one.time = one.time + delay
    return one


def of_another_sensor(one):
    other = copy.copy(one)
    other.signal = one.signal._replace(link=2)
    one.measured = one.measured + other.predict(TRUE, False)[0] - one.predict(TRUE, False)[0]
    return one


MOVED = TRACE | {"sigma": 0.05}
BENDING = SPECTRUM | {"input": "actuator 1.1", "output": "sensor 1.2"}
#: Kind, what is done to it, and what is said of it; beside a sound response.
OTHER_KINDS = [
    (MAGNITUDE, lambda x: scaled(x, 1e3), r"other: it is too large by a factor of 1000"),
    (MAGNITUDE, lambda x: scaled(x, 1.7), r"other: its gain is wrong by a factor of 1\.7"),
    (MAGNITUDE, in_radians, "other: its frequencies are in rad/s"),
    (BENDING, in_radians, "other: its frequencies are in rad/s"),
    (MODES, lambda x: x.stretched(2 * np.pi), "other: its frequencies are in rad/s"),
    (MODES, lambda x: x.stretched(1.0, 100.0), "other: its damping ratios are in percent"),
    (MOVED, lambda x: scaled(x, -1.0), "other: its polarity is reversed"),
    (MOVED, lambda x: scaled(x, 9.80665), "other: it is too large by a factor of 9.81"),
    (MOVED, lambda x: moved(x, 3e-4), r"other: it is late by 0\.(29|30|31)\d* ms"),
    (MOVED, of_another_sensor, r"other: its sensor is 3\.2"),
]


@pytest.fixture(scope="module")
def kinds(folder):
    """By kind of the other entry: specification, bench and measurements of the true machine."""
    return {}


@pytest.mark.parametrize("entry, spoil, said", OTHER_KINDS)
def test_faults_of_other_kinds_are_named(folder, kinds, entry, spoil, said):
    if entry["kind"] not in kinds:
        sound = RESPONSE | {"sigma_percent": 0.3, "sigma": 1e-6}
        pair = [sound, entry | {"name": "other"}]
        spec = spec_of(folder, *pair)
        bench, every, _ = made(spec)
        rng = np.random.default_rng(0)
        for one in every:
            give_data(bench, one, TRUE, rng)
        kinds[entry["kind"]] = spec, bench, every
    spec, bench, every = kinds[entry["kind"]]
    if entry["kind"] == "trace":  # whose fits take long: at the true machine
        one = spoil(copy.copy(every[1]))
        fault = fault_of(one, TRUE, BETTER)
        assert re.match(said, f"other: {fault.text.format(fault.size)}"), fault.text
        return
    best = diagnosed((spec, bench, every), only(1, spoil))[0]
    assert re.match(said, best.text), best.text


def test_good_data_have_no_remedy(measured):
    assert diagnosed(measured, lambda _, one: one) == ()


def test_the_fixed_field_that_is_wrong_is_named(folder, measured):
    """A platform of 0.27 kg, held at 0.15 kg in the fit of two other parameters."""
    for k, one in enumerate(measured[2]):
        parts = {"real": one.measured.real, "imag": one.measured.imag}
        write(folder, f"r{k}.csv", frequency_hz=FREQUENCY, **parts)
    light = {"machine": {"platform_mass": 0.15}}
    options = {"starts": 2, "refine": 1, "profile": False}
    found = fit(spec_of(folder, *entries(), free=FREED, study=light, **options))
    assert not found.answer.is_explained
    (text,) = (x.text for x in found.remedies if x.text.startswith("machine.platform_mass"))
    value = float(re.fullmatch(".*, which is fixed at 0.15, is (.*) kg", text)[1])
    assert value == pytest.approx(0.27, rel=0.02)
    best = found.remedies[0]  # a payload would do as well
    assert best.text.startswith(("machine.platform_mass", "load.mass, which is fixed at 0,"))
    assert any(text in line for line in sentences(found))
