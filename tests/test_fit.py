"""Fits to measurements: derivatives, uncertainty, what cannot be told, and bad data."""

import io
import re

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import chi2

from studies.errors import StudyError
from studies.fitting.bench import modes_of
from studies.fitting.kinds.modes import TWO_PI, pair_modes
from studies.fitting.problem import Problem
from studies.fitting.report import told
from studies.fitting.run import fit, run_fit
from studies.fitting.solve import descend, solve
from studies.fitting.statistics import describe_fit
from studies.study.spec import load_study
from studies.tuning.spec import load_tuning
from tests.fits import (
    FIGURES,
    FREQUENCY,
    HAMMER,
    MAGNITUDE,
    MODES,
    REDUCTION,
    RESPONSE,
    SHORT,
    SPECTRUM,
    TIME,
    TRACE,
    blank,
    made,
    spec_of,
    write,
)

LOADED = {"basis": "loaded", "joint_inertia_c": 1.1e-5}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("data")
    blank(found)
    return found


def measured_modes(bench, one, values):
    """The model's own modes as if they were measured."""
    plant = bench.plant(one._pose, values, False)
    modes = modes_of(np.asarray(plant.value.state))
    frequency = np.abs(modes.pole) / TWO_PI
    bending = np.flatnonzero(frequency > 60)[: len(one._measured.frequency)]
    return one._measured._replace(
        frequency=frequency[bending],
        damping=(-modes.pole.real / np.abs(modes.pole))[bending],
        shapes=(np.asarray(plant.value.sensor) @ modes.shape[:, bending]).T,
    )


def fourth_order(f, x, step):
    def along(d):
        return (f(x - 2 * d) - 8 * f(x - d) + 8 * f(x + d) - f(x + 2 * d)) / 12

    return np.stack([along(step * e) / step for e in np.diag(x)], axis=1) / x


ENTRIES = {
    "modes": MODES,
    "response": RESPONSE,
    "magnitude": MAGNITUDE,
    "spectrum": SPECTRUM,
    "trace": TRACE,
    "figures": FIGURES,
    "reduction": REDUCTION,
}


@pytest.mark.parametrize("kind", ENTRIES)
def test_derivatives_of_every_kind(folder, kind):
    """Against central differences of fourth order, each column within 1e-5 of its size."""
    bench, (one,), values = made(spec_of(folder, ENTRIES[kind]))
    if kind == "modes":
        one._measured = measured_modes(bench, one, values * 1.001)
    found = one.residual(values, True)
    step = 1e-3 if kind in ("figures", "reduction") else 1e-4  # whose steps round off
    wanted = fourth_order(lambda x: one.residual(x, False).value, values, step)
    size = np.abs(wanted).max(axis=0)
    assert np.all(size > 0)
    assert np.max(np.abs(found.slope - wanted) / size) < 1e-5


def test_modes_are_paired_by_shape(folder):
    """Three nearly equal modes, measured in another order and mixed with noise."""
    bench, (one,), values = made(spec_of(folder, MODES))
    truth = measured_modes(bench, one, values)
    order = [2, 0, 1, 5, 3, 4]
    noise = np.random.default_rng(0).normal(size=(6, 9)) * 0.03 * np.abs(truth.shapes).max()
    mixed = truth._replace(frequency=truth.frequency[order], shapes=truth.shapes[order] + noise)
    plant = bench.plant(one._pose, values, False)
    modes = modes_of(np.asarray(plant.value.state))
    pairs = pair_modes(mixed, modes, np.asarray(plant.value.sensor))
    frequency = np.abs(modes.pole[pairs.mode]) / TWO_PI
    np.testing.assert_allclose(frequency, mixed.frequency, rtol=1e-9)
    assert np.ptp(truth.frequency[:3]) < 0.02 * truth.frequency[0] and pairs.likeness.min() > 0.9


def noisy(one, kind, values, rng):
    """Give a measurement the model's values with its noise."""
    if kind == "modes":
        truth = measured_modes(one._bench, one, values)
        n = len(truth.frequency)
        one._measured = truth._replace(
            frequency=truth.frequency + truth.sigma * rng.normal(size=n),
            damping=truth.damping + truth.damping_sigma * rng.normal(size=n),
        )
        return
    found = one.predicted(values, False)[0]
    if kind == "spectrum":
        shape = 64
        one.measured = np.abs(found) ** 2 * rng.gamma(shape, 1 / shape, len(found))
        return
    sigma = one._noise.sigma(found)
    noise = rng.normal(size=len(found)) + (
        1j * rng.normal(size=len(found)) if kind == "response" else 0
    )
    one.measured = found + sigma * noise
    one.sigma = one._noise.sigma(one.measured)


def repeated(folder, kind, repetitions, seed=0):
    """How many repetitions have the truth in their 95 % region."""
    spec = spec_of(folder, ENTRIES[kind])
    bench, (one,), values = made(spec)
    problem = Problem(free=spec.free, priors=(), measurements=(one,), checks=(), bench=bench)
    truth, rng, inside = spec.free.places(), np.random.default_rng(seed), 0
    for _ in range(repetitions):
        noisy(one, kind, values, rng)
        first = np.clip(truth + rng.uniform(-0.1, 0.1, len(truth)), 0.01, 0.99)
        found = descend(problem, first, 60, False)
        one.reweigh(spec.free.values(found.u))
        found = descend(problem, found.u, 60, False)
        answer = describe_fit(problem, found.u, False)
        assert answer.is_explained or answer.probability > 1e-5
        away = found.u - truth
        square = away @ np.linalg.solve(answer.covariance, away)
        inside += square <= chi2.ppf(0.95, len(away))
    return inside


@pytest.mark.parametrize("kind", ["modes", "response"])
def test_the_truth_is_inside_the_region(folder, kind):
    """In 40 repetitions; of 95 %, fewer than 33 would come once in 1000 times."""
    assert repeated(folder, kind, 40) >= 33


@pytest.mark.long
@pytest.mark.parametrize("kind", ["modes", "response", "magnitude", "spectrum", "trace"])
def test_the_truth_is_inside_95_percent_of_the_regions(folder, kind):
    inside = repeated(folder, kind, 100, 1)
    print(f"{kind}: the truth is inside {inside} of 100 regions")
    assert 90 <= inside <= 99


def answered(folder, entry, free, study=None, kind="response"):
    """Fit of synthetic data of the study's own machine."""
    spec = spec_of(folder, entry, free=free, study=study)
    bench, (one,), values = made(spec)
    noisy(one, kind, values, np.random.default_rng(3))
    problem = Problem(free=spec.free, priors=(), measurements=(one,), checks=(), bench=bench)
    found = solve(problem, 8, 2, 60, 0, False)
    return spec, one, describe_fit(problem, found.best.u, False)


def test_a_pair_that_cannot_be_told_apart_is_named(folder):
    """Young's modulus and a factor on the stiffness, of which the first counts for nothing else."""
    free = {
        "link.youngs_modulus": {"from": 60e9, "to": 80e9},
        "link.stiffness_factor": {"from": 0.9, "to": 1.1},
        "link.damping_ratio": {"from": 0.002, "to": 0.04},
    }
    spec, _, answer = answered(folder, HAMMER, free)
    (direction,) = answer.undetermined
    assert {spec.free.names[k] for k in direction.named()} == {*list(free)[:2]}
    assert direction.parts[0] * direction.parts[1] < 0
    assert answer.is_explained and answer.sigma[2] < 1e-3
    text = told(direction, spec.free.names)
    assert "cannot be told apart" in text and "link.stiffness_factor" in text


def test_a_wrong_model_is_noticed(folder):
    """Links with joint inertia, fitted without it."""
    spec = spec_of(folder, RESPONSE, study={"link": SHORT["link"] | LOADED})
    bench, (one,), values = made(spec)
    noisy(one, "response", values, np.random.default_rng(0))
    poor = spec_of(folder, RESPONSE)
    bench, (other,), _ = made(poor)
    other.measured, other.sigma = one.measured, one.sigma
    problem = Problem(free=poor.free, priors=(), measurements=(other,), checks=(), bench=bench)
    answer = describe_fit(problem, solve(problem, 16, 2, 60, 0, False).best.u, False)
    assert not answer.is_explained and not answer.misfits[0].is_noise


def test_the_paper_s_frequencies_from_modulus_and_joint(tmp_path):
    """92.5 and 241.3 Hz: a joint inertia of about 1.1e-5 kg m2 is inside the interval."""
    free = {
        "link.youngs_modulus": {"from": 55e9, "to": 85e9},
        "link.joint_inertia_c": {"from": 1e-7, "to": 5e-5, "scale": "log"},
    }
    entry = {"kind": "modes", "ends": "held", "frequency_hz": [92.5, 241.3], "sigma_hz": 0.5}
    study = {"link": SHORT["link"] | {"basis": "loaded", "joint_inertia_c": 5e-6}}
    spec = spec_of(tmp_path, entry, free=free, study=study)
    found = run_fit(spec, tmp_path / "out", Console(file=io.StringIO()))
    answer = found.answer
    assert answer.chi_square < 1e-6
    low, high = answer.interval.T
    assert low[0] < 70e9 < high[0] and low[1] < 1.1e-5 < high[1]
    assert 0 < answer.sigma[0] < 5e9 and abs(answer.correlation[0, 1]) > 0.9
    given = load_study(tmp_path / "out" / "fitted.toml")
    assert given.link.youngs_modulus == pytest.approx(answer.values[0], rel=1e-12)
    spread = load_tuning(tmp_path / "out" / "fitted_tune.toml").tune.scenarios.spread
    assert set(spread) == set(free)
    text = (tmp_path / "out" / "report.md").read_text()
    assert "strongly correlated" in text and "## Next experiment" in text
    assert found.experiments[0].widest < 0.5 * np.sqrt(np.linalg.eigvalsh(answer.covariance)[-1])


FAULTS = {
    "not a number": (RESPONSE, {"real": np.nan}, "column 'real': 1 of 200 entries are no finite"),
    "another unit": (RESPONSE, {"scale": 1e3}, "times the model at the first guess; expected V/V"),
    "kilohertz": (RESPONSE, {"frequency": 1e-3}, "check the units"),
    "no column": (RESPONSE | {"imag": "imaginary"}, {}, "no column 'imaginary'"),
    "no file": (RESPONSE | {"file": "none.csv"}, {}, "no such file"),
    "no format": (RESPONSE | {"file": "a.xls"}, {}, "allowed: a file .csv"),
    "no signal": (RESPONSE | {"output": "sensor 4.1"}, {}, "allowed: links 1 to 3"),
    "no noise": (
        {k: v for k, v in RESPONSE.items() if not k.startswith("sigma")},
        {},
        "sigma or sigma_percent is missing",
    ),
    "swapped": (
        {"kind": "modes", "frequency_hz": [241.3, 92.5], "sigma_hz": 1.0},
        {},
        "ascending frequencies",
    ),
    "too few": ({"kind": "modes", "frequency_hz": [92.5], "sigma_hz": 1.0}, {}, "as many or more"),
    "far away": (MODES | {"pose": [0.5, 0.0, 0.0]}, {}, "pose"),
    "no kind": (MODES | {"kind": "mode"}, {}, "did you mean 'modes'"),
    "no field": (MODES | {"frequencies": 1}, {}, "did you mean 'fit.data[0].frequency_hz'"),
    "no derivative": (FIGURES | {"values": {"settling_time": 0.1}}, {}, "has no derivative"),
    "out of the run": (TRACE, {"late": True}, "within the run"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_data_are_answered(tmp_path, fault):
    entry, change, said = FAULTS[fault]
    real = np.full(200, 1e-3 * change.get("scale", 1.0))
    if "real" in change:
        real[7] = change["real"]
    frequency = FREQUENCY * change.get("frequency", 1.0)
    write(tmp_path, "response.csv", frequency_hz=frequency, real=real, imag=0 * real)
    write(tmp_path, "trace.csv", time=TIME + 1.0, value=TIME)
    with pytest.raises(StudyError, match=re.escape(said)):
        fit(spec_of(tmp_path, entry))
