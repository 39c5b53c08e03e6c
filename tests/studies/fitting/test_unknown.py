"""Gain, delay and offset of a measurement that nobody knows, fitted beside the parameters."""

import json

import jsonschema
import numpy as np
import pytest
from scipy.stats import chi2

from studies.documents import schema
from studies.errors import StudyError
from studies.fitting.verb import fit
from tests.fits import (
    FREQUENCY,
    MAGNITUDE,
    RESPONSE,
    TIME,
    TRACE,
    Ringing,
    answered,
    blank,
    made,
    posed,
    spec_of,
    write,
)
from tests.pages import tables_of

GAIN, DELAY = -0.8, 3.1e-4
UNKNOWN = {"unknown": ["gain", "delay"]}
OWN = RESPONSE | {"output": "sensor 1.1"}


def noisy(exact, seed=0):
    """A response with a wrong gain, late, with its 3 % of noise; and the deviations of that."""
    exact = GAIN * exact * np.exp(-2j * np.pi * FREQUENCY * DELAY)
    sigma = np.hypot(0.03 * np.abs(exact), 1e-5)
    noise = np.random.default_rng(seed).normal(size=(2, len(exact))).T @ [1, 1j]
    return exact + sigma * noise, sigma


def measure(folder):
    """A file of that response; the true parameters."""
    blank(folder)
    _, (one,), truth = made(spec_of(folder, OWN))
    measured, _ = noisy(one.predict(truth, False)[0])
    columns = {"real": measured.real, "imag": measured.imag}
    write(folder, "response.csv", frequency_hz=FREQUENCY, **columns)
    return truth


def test_they_are_found_beside_the_parameters(tmp_path):
    truth = measure(tmp_path)
    quick = {"starts": 2, "refine": 1, "profile": False}
    quick["next"] = {"inputs": ["actuator 1.1"], "outputs": ["sensor 1.1"]}
    spec = spec_of(tmp_path, OWN | UNKNOWN, **quick)
    found = fit(spec, tmp_path / "out", progress=False)
    assert found.answer.is_explained
    assert 2 * len(FREQUENCY) - found.answer.freedom in (4, 5)  # one direction may be open
    assert np.all(np.abs(found.answer.values - truth) < 4 * found.answer.sigma)
    document = json.loads((tmp_path / "out" / "fit.json").read_text())
    jsonschema.validate(document, schema("fit"))
    own = document["unknown"]["response 1"]
    assert own["gain"] == pytest.approx(GAIN, rel=0.02)
    assert own["delay"] == pytest.approx(DELAY, abs=3e-6)
    page = (tmp_path / "out" / "report.html").read_text()
    (table,) = tables_of(page)["Unknown numbers of measurements"]
    assert float(table["delay [ms]"][0]) == pytest.approx(1e3 * own["delay"], rel=1e-3)
    # without them the model does not explain the data
    assert not answered(posed(spec_of(tmp_path, OWN), found.problem.bench)).is_explained


def test_uncertainties_include_them(tmp_path):
    """Three parameters of 6 records scatter as their deviations say."""
    blank(tmp_path)
    bench, (one,), truth = made(spec_of(tmp_path, OWN))
    exact, _ = one.predict(truth, False)
    problem = posed(spec_of(tmp_path, OWN | UNKNOWN), bench)
    (one,), away = problem.measurements, []
    for seed in range(6):
        one.measured, one.sigma = noisy(exact, seed)
        answer = answered(problem)
        away.append((answer.values - truth) / answer.sigma)
    assert chi2.ppf(1e-3, 18) < np.sum(np.square(away)) < chi2.ppf(1 - 1e-3, 18)


@pytest.mark.parametrize("entry", [OWN | UNKNOWN, TRACE | {"unknown": ["gain", "offset"]}])
def test_the_slope_of_chi_square_is_exact(entry, tmp_path):
    """Although derivatives of single values leave out how the unknown numbers move."""
    truth = measure(tmp_path)
    rng = np.random.default_rng(0)
    write(tmp_path, "trace.csv", time=TIME, value=0.1 * rng.normal(size=len(TIME)))
    _, (one,), _ = made(spec_of(tmp_path, entry))
    if one.kind == "trace":
        one._motion = Ringing()
    place = truth * [1.02, 0.9, 1.05]

    def square(x):
        return np.sum(one.residual(x, False).value ** 2) / 2

    residual = one.residual(place, True)
    found = residual.value @ residual.slope
    for k, step in enumerate(1e-5 * place):
        ends = (square(place + sign * step * np.eye(3)[k]) for sign in (1, -1))
        wanted = np.subtract(*ends) / (2 * step)
        assert found[k] * place[k] == pytest.approx(wanted * place[k], rel=2e-4, abs=1e-6)


@pytest.mark.parametrize(
    "entry, message",
    [
        (MAGNITUDE | {"unknown": ["gain"]}, "unknown: has no meaning for a magnitude"),
        (OWN | {"unknown": ["offset"]}, "unknown.*'gain' or 'delay'"),
        (TRACE | {"unknown": ["delay"]}, "unknown.*'gain' or 'offset'"),
    ],
)
def test_what_cannot_be_unknown_is_refused(entry, message, tmp_path):
    blank(tmp_path)
    with pytest.raises(StudyError, match=message):
        made(spec_of(tmp_path, entry))


@pytest.mark.parametrize("entry", [OWN | UNKNOWN, TRACE | {"unknown": ["gain", "offset"]}])
def test_noise_has_no_gain(entry, tmp_path):
    """A dead channel would be explained by a gain of 0."""
    blank(tmp_path)
    rng = np.random.default_rng(0)
    noise = {"real": rng.normal(size=200), "imag": rng.normal(size=200)}
    write(tmp_path, "response.csv", frequency_hz=FREQUENCY, **noise)
    write(tmp_path, "trace.csv", time=TIME, value=3.0 + rng.normal(size=len(TIME)))
    quiet = {k: x for k, x in entry.items() if k != "sigma_percent"} | {"sigma": 1.0}
    with pytest.raises(StudyError, match="nothing that a gain could be told from"):
        fit(spec_of(tmp_path, quiet))
