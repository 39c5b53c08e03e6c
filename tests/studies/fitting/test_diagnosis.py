"""What is said of data that the model does not explain: the fault that was put in, and no other."""

import copy
import re
from functools import partial
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

from studies.fitting import diagnosis
from studies.fitting.diagnosis import BETTER, _of_data, _of_links, diagnose
from studies.fitting.faults import fault_of
from studies.fitting.say import sentences
from studies.fitting.solve import descend
from studies.fitting.statistics import describe_fit
from studies.fitting.verb import fit
from tests.fits import (
    DECAY,
    FREE_OF_UNEQUAL,
    FREQUENCY,
    MAGNITUDE,
    MODES,
    RESPONSE,
    SENSORS,
    SPECTRUM,
    TRACE,
    UNEQUAL,
    Ringing,
    blank,
    followed,
    give_data,
    made,
    posed,
    spec_of,
    write,
    write_decays,
)

SIGNALS = [
    ("actuator 1.1", "sensor 1.2"),
    ("actuator 2.2", "sensor 2.3"),
    ("slider 3", "sensor 3.1"),
]
LINES, NOISE = FREQUENCY[::3], 0.01
TRUE = np.array([0.94, 0.009])


def entries():
    exact = RESPONSE | {"sigma_percent": 100 * NOISE}
    return [
        exact | {"name": f"response {k + 1}", "input": a, "output": b, "file": f"r{k}.csv"}
        for k, (a, b) in enumerate(SIGNALS)
    ]


def asked(folder, *entries):
    return spec_of(folder, *entries, free=FREE_OF_UNEQUAL, study=UNEQUAL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("data")
    blank(path)
    one = np.ones(len(LINES))
    for k in range(len(SIGNALS)):
        write(path, f"r{k}.csv", frequency_hz=LINES, real=one, imag=one)
    return path


@pytest.fixture(scope="module")
def bench(folder):
    """The machine, whose programs all tests here share."""
    return made(asked(folder, *entries()))[0]


@pytest.fixture(scope="module")
def measured(folder, bench):
    """Specification and problem with noisy responses of the true machine."""
    spec = asked(folder, *entries())
    problem = posed(spec, bench)
    rng = np.random.default_rng(0)
    for one in problem.measurements:
        exact, _ = one.predict(TRUE, False)
        one.reweigh(TRUE)
        one.sigma = np.hypot(NOISE * np.abs(exact), 1e-5)
        one.measured = exact + one.sigma * (rng.normal(size=(2, len(exact))).T @ [1, 1j])
    return spec, problem


def spoilt_fit(problem, spoilt):
    """A fit in which some measurements are spoilt, by functions of number and measurement."""
    every = [spoilt(k, copy.copy(one)) for k, one in enumerate(problem.measurements)]
    problem = problem._replace(measurements=tuple(every))
    return problem, descend(problem, problem.free.places(), 40).u


#: Without what has large programs of its own: more modes, fields of all sections at once.
few_programs = partial(
    mock.patch.multiple, diagnosis, _of_modes=lambda *_: [], SECTIONS=("machine", "load")
)


def scaled(one, factor):
    """With another gain, and its noise as it is then seen."""
    one.measured, one.sigma = factor * one.measured, abs(factor) * one.sigma
    one._noise = one._noise._replace(fixed=abs(factor) * one._noise.fixed)
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
    (best,) = _of_data(*spoilt_fit(measured[1], spoilt))
    found = re.match(text, best.text)
    assert found, best.text
    assert size is None or float(found[1]) == pytest.approx(size, rel=0.02)
    count = 2 * len(LINES) * len(SIGNALS)
    assert best.after < 1.3 * count and best.before > 3 * best.after


@pytest.mark.parametrize("entry", [RESPONSE, MAGNITUDE])
@pytest.mark.parametrize("gain", [2.0, 0.5, 3.3])
def test_a_mended_gain_leaves_the_chi_square_of_sound_data(folder, bench, entry, gain):
    """Noise that is a share of the model does not grow with a gain of the data."""
    (one,) = posed(asked(folder, entry | {"sigma_percent": 1.0}), bench).measurements
    give_data(bench, one, TRUE, np.random.default_rng(0))
    one.reweigh(TRUE)
    wanted = np.sum(one.residual(TRUE, False).value ** 2)
    sigma = one.sigma
    one = scaled(one, gain)
    one.sigma = sigma  # from the model
    mended = fault_of(one, TRUE, BETTER).mended
    np.testing.assert_allclose(np.sum(mended.residual(TRUE, False).value ** 2), wanted, rtol=0.01)


def test_a_measurement_without_a_number_has_no_fault():
    lost = SimpleNamespace(residual=lambda *_: SimpleNamespace(value=np.array([np.nan, np.inf])))
    assert fault_of(lost, TRUE, BETTER) is None


def test_exchanged_channels_are_named(measured):
    def swapped(k, one):
        if k == 1:  # the cable of sensor 2.2 in the socket of 2.3
            true = copy.copy(one)
            true.signals = one.signals[0], one.signals[1]._replace(patch=1)
            exact, _ = true.predict(TRUE, False)
            noise = one.measured / one.predict(TRUE, False)[0]
            one.measured, one.sigma = exact * noise, np.hypot(NOISE * np.abs(exact), 1e-5)
        return one

    (best,) = _of_data(*spoilt_fit(measured[1], swapped))
    assert best.text == "response 2: its sensor is 2.2"


#: Of parameters of traces.
GUESS = np.array([66e9, 0.009, 0.27])


def moved(one, delay):
    one.time = one.time + delay
    return one


def of_another_sensor(one):
    other = copy.copy(one)
    other.signal = one.signal._replace(link=2)
    one.measured = one.measured + other.predict(GUESS, False)[0] - one.predict(GUESS, False)[0]
    return one


BENDING = SPECTRUM | {"input": "actuator 1.1", "output": "sensor 1.2"}
#: Kind, what is done to it, and what is said of it; beside a sound response.
OTHER_KINDS = [
    (MAGNITUDE, lambda x: scaled(x, 1e3), r"other: it is too large by a factor of 1000"),
    (MAGNITUDE, lambda x: scaled(x, 1.7), r"other: its gain is wrong by a factor of 1\.7"),
    (MAGNITUDE, in_radians, "other: its frequencies are in rad/s"),
    (BENDING, in_radians, "other: its frequencies are in rad/s"),
    (MODES, lambda x: x.stretched(2 * np.pi), "other: its frequencies are in rad/s"),
    (MODES, lambda x: x.stretched(1.0, 100.0), "other: its damping ratios are in percent"),
]


@pytest.mark.parametrize("entry, spoil, said", OTHER_KINDS)
def test_faults_of_other_kinds_are_named(folder, bench, entry, spoil, said):
    sound = RESPONSE | {"sigma_percent": 0.3, "sigma": 1e-6}
    problem = posed(asked(folder, sound, entry | {"name": "other"}), bench)
    rng = np.random.default_rng(0)
    for one in problem.measurements:
        give_data(bench, one, TRUE, rng)
    (best,) = _of_data(*spoilt_fit(problem, only(1, spoil)))
    assert re.match(said, best.text), best.text


@pytest.mark.parametrize(
    "spoil, said",
    [
        (lambda x: scaled(x, -1.0), "its polarity is reversed"),
        (lambda x: scaled(x, 9.80665), "it is too large by a factor of 9.81"),
        (lambda x: scaled(x, 1 / 9.80665), "it is too large by a factor of 1/9.81, as of acc"),
        (lambda x: moved(x, 3e-4), r"it is late by 0\.(29|30|31)\d* ms"),
        (of_another_sensor, r"its sensor is 3\.2"),
    ],
)
def test_faults_of_traces_are_named(folder, bench, spoil, said):
    """At the true machine: their fits take long."""
    _, (one,), _ = made(spec_of(folder, TRACE | {"sigma": 0.05}), bench)
    one._motion = Ringing()
    give_data(bench, one, GUESS, np.random.default_rng(0))
    fault = fault_of(spoil(one), GUESS, BETTER)
    assert re.match(said, fault.text.format(fault.size)), fault.text


def of_decays(folder, bench, study, **entry):
    """A fit that does not explain a record of decays: specification, problem and where it ends."""
    write_decays(folder, bench, np.array([1.0, 0.012]))
    entry = DECAY | {"name": "decay", "segment_s": 0.5} | entry
    spec = spec_of(folder, entry, free=FREE_OF_UNEQUAL, study=study)
    problem = posed(spec)
    u = followed(problem)
    assert not describe_fit(problem, u).is_explained
    return spec, problem, u


def test_exchanged_channels_of_a_record_are_named(folder, bench):
    """The cables of two sensors: shapes and frequencies no longer belong together."""
    exchanged = [SENSORS[1], SENSORS[0], SENSORS[2]]
    (best,) = _of_data(*of_decays(folder, bench, UNEQUAL, values=exchanged)[1:])
    assert best.text == "decay: sensor 1.1 and sensor 2.1 are exchanged"
    assert best.after * BETTER < best.before


def test_links_that_differ_are_named(folder, bench):
    """Three unequal links, fitted as equal ones."""
    equal = {"link": UNEQUAL["link"] | {"youngs_modulus": [70e9] * 3}}
    (best,) = _of_links(*of_decays(folder, bench, equal))
    assert "the links differ in link.stiffness_factor" in best.text
    assert best.after * BETTER < best.before


def test_good_data_have_no_remedy(measured):
    spec, problem = measured
    with few_programs():
        assert diagnose(spec, *spoilt_fit(problem, lambda _, one: one)) == ()


@pytest.mark.long  # in short: without large programs
def test_good_data_have_no_remedy_of_any_kind(measured):
    spec, problem = measured
    assert diagnose(spec, *spoilt_fit(problem, lambda _, one: one)) == ()


def test_the_fixed_field_that_is_wrong_is_named(folder, measured):
    """A platform of 0.25 kg, held at 0.14 kg in the fit of two other parameters."""
    for k, one in enumerate(measured[1].measurements):
        parts = {"real": one.measured.real, "imag": one.measured.imag}
        write(folder, f"r{k}.csv", frequency_hz=LINES, **parts)
    study = UNEQUAL | {"machine": {"platform_mass": 0.14}}
    options = {"starts": 2, "refine": 1, "profile": False}
    with few_programs():
        found = fit(spec_of(folder, *entries(), free=FREE_OF_UNEQUAL, study=study, **options))
    assert not found.answer.is_explained
    (text,) = (x.text for x in found.remedies if x.text.startswith("machine.platform_mass"))
    value = float(re.fullmatch(".*, which is fixed at 0.14 kg, is (.*) kg", text)[1])
    assert value == pytest.approx(0.25, rel=0.02)
    best = found.remedies[0]  # a payload would do as well
    assert best.text.startswith(("machine.platform_mass", "load.mass, which is fixed at 0 kg,"))
    assert any(text in line for line in sentences(found))
