"""Fits to measurements: derivatives, uncertainty, what is not identifiable, and bad data."""

import json
import re
import time
from types import SimpleNamespace
from unittest import mock

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import pyuff
import scipy
from scipy.stats import chi2

from jaxmodel import status
from studies.errors import StudyError
from studies.fitting import bench as benches
from studies.fitting import estimate as estimating
from studies.fitting.kinds.contract import Line
from studies.fitting.kinds.modes import TWO_PI, pair_modes
from studies.fitting.measurements import make_bench
from studies.fitting.plots import curves, drawings, samples
from studies.fitting.posterior import log_density, sample, shape
from studies.fitting.problem import check_sanity, make_problem
from studies.fitting.profiles import profile
from studies.fitting.run import machines
from studies.fitting.say import sentences, undetermined
from studies.fitting.solve import descend, solve
from studies.fitting.statistics import describe_fit
from studies.fitting.tables import column, read_columns
from studies.fitting.verb import fit
from studies.publish import check_folder
from studies.study.spec import load_study
from studies.tuning.spec import load_tuning
from tests.bare import parse_fit
from tests.fits import (
    ACCELEROMETER,
    FIGURES,
    FREE,
    FREQUENCY,
    MAGNITUDE,
    MODES,
    MOTOR,
    REDUCTION,
    RESPONSE,
    SETTLING,
    SHORT,
    SPECTRUM,
    TIME,
    TRACE,
    Ringing,
    blank,
    fit_of,
    made,
    measured_modes,
    posed,
    spec_of,
    write,
)
from tests.pages import text_of

LOADED = {"basis": "loaded", "joint_inertia_c": 1.1e-5}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("data")
    blank(found)
    return found


def fourth_order(f, x, step):
    def along(d):
        return (f(x - 2 * d) - 8 * f(x - d) + 8 * f(x + d) - f(x + 2 * d)) / 12

    return np.stack([along(step * e) / step for e in np.diag(x)], axis=1) / x


ENTRIES = {
    "modes": MODES,
    "response": RESPONSE,
    "magnitude": MAGNITUDE,
    "accelerometer": ACCELEROMETER,
    "motor": MOTOR,
    "spectrum": SPECTRUM,
    "trace": TRACE,
    "settling": SETTLING,
}
#: Of runs with one mode, whose kernel is small.
OF_RUNS = {"figures": FIGURES, "reduction": REDUCTION}
ONE = {name: SHORT[name] | {"modes": 1} for name in ("link", "control")}


@pytest.fixture(scope="module")
def bench(folder):
    """The machine of all kinds of entries, whose programs all tests with `FREE` share."""
    return make_bench(spec_of(folder, *ENTRIES.values()))


@pytest.fixture(scope="module")
def every_kind(folder, bench):
    """Values and measurements by kind; signals over time are of runs in closed form."""
    _, measurements, values = made(spec_of(folder, *ENTRIES.values()), bench)
    found = dict(zip(ENTRIES, measurements, strict=True))
    _, measurements, _ = made(spec_of(folder, *OF_RUNS.values(), study=ONE), bench)
    found |= zip(OF_RUNS, measurements, strict=True)
    ring(found["trace"])
    ring(found["settling"])
    return values, found


def ring(one):
    one._motion = Ringing()
    if one.kind == "settling":
        one._band = one._band._replace(without=one._motion)


@pytest.mark.parametrize("kind", [*ENTRIES, *OF_RUNS])
def test_derivatives_of_every_kind(bench, every_kind, kind):
    """Against central differences of fourth order, each column within 1e-5 of its size."""
    values, measurements = every_kind
    one = measurements[kind]
    if kind == "modes":
        one.use(measured_modes(bench, one, values * 1.001))
    found = one.residual(values, True)
    step = 1e-3 if kind == "reduction" else 1e-4  # whose steps round off
    wanted = fourth_order(lambda x: one.residual(x, False).value, values, step)
    size = np.abs(wanted).max(axis=0)
    assert np.all(size > 0)
    assert np.max(np.abs(found.slope - wanted) / size) < 1e-5


def test_modes_are_paired_by_shape(folder, bench):
    """Three nearly equal modes, measured in another order and mixed with noise."""
    _, (one,), values = made(spec_of(folder, MODES), bench)
    truth = measured_modes(bench, one, values)
    order = [2, 0, 1, 5, 3, 4]
    noise = np.random.default_rng(0).normal(size=(6, 9)) * 0.03 * np.abs(truth.shapes).max()
    mixed = truth._replace(frequency=truth.frequency[order], shapes=truth.shapes[order] + noise)
    plant = bench.plant(one._pose, values, False)
    modes = plant.modes
    pairs = pair_modes(mixed, modes, np.asarray(plant.value.sensor @ modes.shape))
    frequency = np.abs(modes.pole[pairs.mode]) / TWO_PI
    np.testing.assert_allclose(frequency, mixed.frequency, rtol=1e-9)
    assert np.ptp(truth.frequency[:3]) < 0.02 * truth.frequency[0] and pairs.mac.min() > 0.9


def noisy(one, kind, values, rng):
    """Give a measurement the model's values with its noise."""
    if kind == "modes":
        truth = measured_modes(one._bench, one, values)
        n = len(truth.frequency)
        one.use(
            truth._replace(
                frequency=truth.frequency + truth.sigma * rng.normal(size=n),
                damping=truth.damping + truth.damping_sigma * rng.normal(size=n),
            )
        )
        return
    found = one.predict(values, False)[0]
    if kind == "spectrum":
        shape = 64
        one.measured = np.abs(found) ** 2 * rng.gamma(shape, 1 / shape, len(found))
        return
    found = np.abs(found) if kind == "magnitude" else found
    sigma = one._noise.sigma(found)
    noise = rng.normal(size=len(found)) + (
        1j * rng.normal(size=len(found)) if kind == "response" else 0
    )
    one.measured = found + sigma * noise
    one.sigma = one._noise.sigma(one.measured)


def repeated(folder, bench, kind, repetitions, seed=0):
    """How many repetitions have the truth in their 95 % region."""
    spec = spec_of(folder, ENTRIES[kind])
    _, (one,), values = made(spec, bench)
    problem = make_problem(spec, bench, [one])
    truth, rng, inside = spec.free.places(), np.random.default_rng(seed), 0
    for _ in range(repetitions):
        noisy(one, kind, values, rng)
        first = np.clip(truth + rng.uniform(-0.03, 0.03, len(truth)), 0.01, 0.99)
        found = descend(problem, first, 60)
        one.reweigh(spec.free.values(found.u))
        found = descend(problem, found.u, 60)
        answer = describe_fit(problem, found.u)
        assert answer.is_explained or answer.probability > 1e-5
        rise = np.sum(problem.residual(truth) ** 2) - np.sum(problem.residual(found.u) ** 2)
        inside += rise <= chi2.ppf(0.95, len(truth))  # as the profiles say it for each number
    return inside


@pytest.mark.parametrize("kind", ["modes", "response"])
def test_the_truth_is_inside_the_region(folder, bench, kind):
    """In 20 repetitions; of 95 %, fewer than 15 would come 3 times in 10,000."""
    assert repeated(folder, bench, kind, 20) >= 15


@pytest.mark.long
@pytest.mark.parametrize("kind", ["modes", "response", "magnitude", "spectrum", "trace"])
def test_the_truth_is_inside_95_percent_of_the_regions(folder, bench, kind):
    inside = repeated(folder, bench, kind, 100, 1)
    print(f"{kind}: the truth is inside {inside} of 100 regions")
    assert 90 <= inside <= 99


def test_three_numbers_that_belong_together_are_one_group(folder):
    """E, a factor on the stiffness and the density, of which frequencies know one ratio."""
    free = {
        "link.youngs_modulus": {"from": 60e9, "to": 80e9},
        "link.stiffness_factor": {"from": 0.9, "to": 1.1},
        "link.density": {"from": 2600.0, "to": 2900.0},
    }
    entry = {"kind": "modes", "ends": "held", "frequency_hz": [114.4, 457.6], "sigma_hz": 0.5}
    study = {"link": SHORT["link"] | {"youngs_modulus": 71e9}}
    options = {"starts": 4, "profile": False}
    found = fit_of(spec_of(folder, entry, entry | {"link": 2}, free=free, study=study, **options))
    (sentence,) = undetermined(found)
    assert "determine 1 combination of these 3 parameters" in sentence and "Fix 2" in sentence


def test_outliers_pull_less(folder, bench):
    """One point in twenty is half as large again; profiles follow the same loss."""
    spec = spec_of(folder, RESPONSE)
    _, (one,), values = made(spec, bench)
    noisy(one, "response", values, np.random.default_rng(4))
    one.measured[::20] *= 1.5
    found = {}
    for is_robust in (False, True):
        problem = make_problem(spec, bench, [one])._replace(is_robust=is_robust)
        u = descend(problem, spec.free.places(), 60).u
        found[is_robust] = np.abs(u - spec.free.places())
        numbers = fourth_order(problem.residual, u, 1e-4)
        assert np.abs(problem.jacobian(u) - numbers).max() < 1e-5 * np.abs(numbers).max()
        sigma = float(np.sqrt(describe_fit(problem, u).covariance[0, 0]))
        likelihood = profile(problem, u, 0, sigma)
        assert likelihood.rise.min() >= -1e-9
    assert np.all(found[True] < 0.6 * found[False])


def test_a_wrong_model_is_noticed(folder, bench):
    """Another drive than that of the fitted model."""
    _, (one,), values = made(spec_of(folder, RESPONSE, study={"drive": {"kp": 1e4, "kd": 30.0}}))
    noisy(one, "response", values, np.random.default_rng(0))
    problem = posed(spec_of(folder, RESPONSE), bench)
    (other,) = problem.measurements
    other.measured, other.sigma = one.measured, one.sigma
    answer = describe_fit(problem, descend(problem, problem.free.places(), 60).u)
    assert not answer.is_explained and not answer.misfits[0].is_noise


@pytest.mark.long
def test_the_paper_s_frequencies_from_modulus_and_joint(tmp_path):
    """92.5 and 241.3 Hz: a joint inertia of about 1.1e-5 kg m2 is inside the interval."""
    free = {
        "link.youngs_modulus": {"from": 55e9, "to": 85e9},
        "link.joint_inertia_c": {"from": 1e-7, "to": 5e-5, "scale": "log"},
    }
    entry = {"kind": "modes", "ends": "held", "frequency_hz": [92.5, 241.3], "sigma_hz": 0.5}
    study = {"link": SHORT["link"] | {"basis": "loaded", "joint_inertia_c": 5e-6}}
    found = fit_of(spec_of(tmp_path, entry, free=free, study=study, starts=4))
    answer = found.answer
    assert answer.chi_square < 1e-6
    low, high = answer.interval.T
    assert low[0] < 70e9 < high[0] and low[1] < 1.1e-5 < high[1]
    assert 0 < answer.sigma[0] < 5e9 and abs(answer.correlation[0, 1]) > 0.9
    assert found.study.link.youngs_modulus == pytest.approx(answer.values[0], rel=1e-12)
    written = machines(found)
    assert set(written) == set(free)
    drawn = np.corrcoef(list(written.values()))[0, 1]  # drawn together, not number by number
    assert abs(drawn) > 0.8 and np.sign(drawn) == np.sign(answer.correlation[0, 1])
    assert "strongly correlated" in " ".join(sentences(found))


PAIR = {
    "link.youngs_modulus": {"from": 60e9, "to": 80e9},
    "link.damping_ratio": {"from": 0.005, "to": 0.02},
}
#: The second number has a wide, skewed posterior, cut off by its bounds.
ONE_MODE = {
    "kind": "modes",
    "ends": "held",
    "frequency_hz": [114.0],
    "sigma_hz": 1.5,
    "damping_ratio": [0.014],
    "damping_sigma": 0.004,
}


def integrated(problem, size=31):
    """Mean and standard deviation of places between the bounds, from a grid of densities."""
    axis = (np.arange(size) + 0.5) / size
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.5 * np.array([np.sum(problem.residual(u) ** 2) for u in grid]))
    weight /= weight.sum()
    mean = weight @ grid
    return mean, np.sqrt(weight @ (grid - mean) ** 2)


def pair(folder, **changed):
    """A problem of two numbers, and the shape of its posterior."""
    problem = posed(spec_of(folder, ONE_MODE | changed, free=PAIR))
    return problem, shape(describe_fit(problem, solve(problem, 4, 1, 60, 0).best.u))


def test_each_starting_point_is_followed_once():
    """Of two valleys, the study is in the better one and the point drawn, at 0.85, in the other."""

    def residual(u):
        return np.append((u - 0.2) * (u - 0.8), 0.01 * (u - 0.2))

    problem = SimpleNamespace(
        free=SimpleNamespace(places=lambda: np.array([0.21]), numbers=()),
        bench=SimpleNamespace(study=SimpleNamespace(n_links=3)),
        measurements=(),
        costs=lambda places: np.array([0.5 * np.sum(residual(u) ** 2) for u in places]),
        residual=residual,
        jacobian=lambda u: np.array([2 * u - 1, [0.01]]),
    )
    found = solve(problem, starts=2, refine=2, iterations=60, seed=0)
    assert [float(x.u[0]) for x in found.optima] == pytest.approx([0.2, 0.8], abs=1e-3)


def test_posterior(folder):
    """Its derivatives; machines drawn from its shape."""
    problem, about = pair(folder, damping_sigma=0.0015)
    mean, deviation = integrated(problem)
    drawn = about.draw(4000, 0)
    assert np.all(
        np.abs(drawn.mean(axis=0) - mean) < 0.2 * deviation
    )  # a normal distribution of logits
    np.testing.assert_allclose(drawn.std(axis=0), deviation, rtol=0.1)
    density, at = log_density(problem, about), jnp.array([0.7, -0.4])
    steps = 1e-5 * np.eye(2)
    wanted = [(density(at + d) - density(at - d)) / 2e-5 for d in steps]
    np.testing.assert_allclose(jax.grad(density)(at), wanted, rtol=1e-6)


@pytest.mark.long
def test_samples_have_the_posterior_s_mean_and_deviation(folder):
    problem, about = pair(folder)
    found = sample(problem, about, 1600, 1)
    mean, deviation = integrated(problem)
    assert found.is_settled
    error = deviation / np.sqrt(found.effective)
    assert np.all(np.abs(found.places.mean(axis=0) - mean) < 4 * error)
    np.testing.assert_allclose(found.places.std(axis=0), deviation, rtol=0.15)


def test_an_optimum_at_a_bound(folder):
    """Profiles to one side, samples of one number, and figures of both."""
    entry = ONE_MODE | {"frequency_hz": [150.0]}
    entry = {k: v for k, v in entry.items() if not k.startswith("damping")}
    spec = spec_of(folder, entry, free={"link.youngs_modulus": {"from": 60e9, "to": 72e9}})
    with pytest.raises(StudyError, match="samples = 3; allowed: 0, or 20"):
        parse_fit(spec.data | {"fit": spec.data["fit"] | {"samples": 3}})
    found = fit_of(spec._replace(fit=spec.fit.model_copy(update={"samples": 20, "starts": 4})))
    assert found.answer.values[0] == pytest.approx(72e9, rel=1e-6)
    assert np.all(np.diff(found.profiles[0].values) > 0)
    assert "link.youngs_modulus ended at its upper bound, 72 GPa" in " ".join(sentences(found))
    places = found.posterior.places
    assert places.shape == (20, 1) and np.all((places > 0) & (places < 1))
    assert found.posterior.effective.shape == (1,)
    drawn = drawings(found)
    drawn["profiles"].draw().canvas.draw()
    assert "samples" not in drawn  # against which other number?


FAULTS = {
    "late": (SETTLING | {"time_s": 5.0}, {}, "within the run, at most 0.06"),
    "no third mode": (
        FIGURES | {"values": {"spectral_density[controlled_mode=3]": 1.0}},
        {},
        "controlled_mode=1 to 2",
    ),
    "not a figure": (
        FIGURES | {"values": {"residual_rms": np.nan}},
        {},
        "values.residual_rms = nan",
    ),
    "negative root": (
        FIGURES | {"values": {"residual_rms": -5.0}, "amplitude": True},
        {},
        "0 or more",
    ),
    "no time": (
        {"kind": "settling", "output": "sensor 1.1", "sigma_s": 0.1},
        {},
        "fit.data[0].time_s: missing; allowed: a finite number >= 0",
    ),
    "no frequency": ({"kind": "modes", "sigma_hz": 1.0}, {}, "frequency_hz: missing"),
    "two bands": (SETTLING | {"band": 1.0}, {}, "give band [unit of the output] or band_percent"),
    "settles elsewhere": (SETTLING | {"output": "slider 1"}, {}, "which settle about 0"),
    "not a number": (RESPONSE, {"real": np.nan}, "column 'real': 1 of 200 entries are not finite"),
    "another unit": (RESPONSE, {"scale": 1e3}, "the model at the starting point; expected V/V"),
    "kilohertz": (RESPONSE, {"frequency": 1e-3}, "check the units"),
    "no column": (RESPONSE | {"imag": "imaginary"}, {}, "no column 'imaginary'"),
    "no file": (RESPONSE | {"file": "none.csv"}, {}, "No such file"),
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
    "far away": (MODES | {"pose": [0.5, 0.0, 0.0]}, {}, "fit.data[0].pose = [0.5, 0.0, 0.0]"),
    "shapes of nothing": (
        {k: v for k, v in MODES.items() if not k.startswith("damping")}
        | {
            "frequency_hz": [90.0, 95.0, 98.0],
            "shapes": [[0.7, 1.0, 0.7, 1.0, 0.0, -1.0, 0.8, -0.9, 0.8]] * 3,
        },
        {},
        "alike to any of the model's",
    ),
    "no kind": (MODES | {"kind": "mode"}, {}, "did you mean 'modes'"),
    "no field": (MODES | {"frequencies": 1}, {}, "did you mean 'fit.data[0].frequency_hz'"),
    "no derivative": (FIGURES | {"values": {"settling_time": 0.1}}, {}, "has no derivative"),
    "short pose": (MODES | {"pose": [0.0, 0.0]}, {}, "fit.data[0].pose"),
    "nothing controlled": (REDUCTION | {"links": [False] * 3}, {}, "no link is under control"),
    "no meaning": (SPECTRUM | {"sigma": 1.0}, {}, "'fit.data[0].sigma' = 1.0: unknown field"),
    "a link of the machine": (MODES | {"link": 2}, {}, "has no meaning with ends = 'machine'"),
    "no values": (FIGURES | {"values": {}}, {}, "fit.data[0].values"),
    "out of the run": (TRACE, {"late": True}, "within the run"),
    "negative frequencies": (SPECTRUM, {"frequency": -1.0}, "must ascend"),
    "mirrored": (SPECTRUM, {"shift": -100.0}, "frequencies from -40 to 400"),
    "a share of nothing": (
        {k: v for k, v in RESPONSE.items() if k != "sigma"},
        {"scale": 0.0},
        "value 1 is 0, where sigma_percent alone means no noise",
    ),
    "huge": (RESPONSE, {"real": 1e200}, "column 'real', row 8: 1e+200; allowed: up to 1e+30"),
    "a folder": (RESPONSE | {"file": "folder.csv"}, {}, "cannot be read (a folder)"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_data_are_answered(tmp_path, fault):
    entry, change, said = FAULTS[fault]
    real = np.full(200, 1e-3 * change.get("scale", 1.0))
    if "real" in change:
        real[7] = change["real"]
    frequency = FREQUENCY * change.get("frequency", 1.0) + change.get("shift", 0.0)
    write(tmp_path, "response.csv", frequency_hz=frequency, real=real, imag=0 * real)
    write(tmp_path, "spectrum.csv", frequency_hz=frequency, density=1.0 + np.abs(real))
    write(tmp_path, "trace.csv", time=TIME + 1.0, value=TIME)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(StudyError, match=re.escape(said)):
        fit(spec_of(tmp_path, entry))


def test_a_signal_that_never_settles_is_refused(folder, bench):
    _, (one,), values = made(spec_of(folder, SETTLING | {"band_percent": 0.01}), bench)
    ring(one)
    with pytest.raises(StudyError, match="does not settle to"):
        check_sanity([one], values)


def numbers_of(found):
    return {name: column(found, name, "a.csv", "file") for name in found}


def test_damaged_files_and_columns_nobody_asked_for(tmp_path):
    (tmp_path / "a.csv").write_text("x,note\n1,ok\n2,\n")
    found = read_columns("a.csv", tmp_path, "file")
    assert list(column(found, "x", "a.csv", "file")) == [1.0, 2.0]
    with pytest.raises(StudyError, match="row 1, column 'note': 'ok' is not a number"):
        column(found, "note", "a.csv", "file")
    (tmp_path / "b.uff").write_text("    -1\n    58\n garbage\n    -1\n")
    with pytest.raises(StudyError, match="cannot be read"):
        read_columns("b.uff", tmp_path, "file")


@pytest.mark.parametrize("mark", [";", "\t"])
def test_columns_are_separated_by_semicolons_or_tabs(mark, tmp_path):
    rows = [["# from a logger"], ["time", "value"], ["0", "1.5"], ["0.5", "-2e-3"]]
    (tmp_path / "a.csv").write_text("\n".join(mark.join(row) for row in rows) + "\n\n")
    if mark == ";":  # as written where decimals have commas
        text = (tmp_path / "a.csv").read_text()
        (tmp_path / "b.csv").write_text(text.replace(".", ","))
    for name in ("a.csv", "b.csv")[: 2 if mark == ";" else 1]:
        found = numbers_of(read_columns(name, tmp_path, "file"))
        assert found["time"].tolist() == [0.0, 0.5] and found["value"].tolist() == [1.5, -2e-3]


@pytest.mark.parametrize(
    "rows, values",
    [
        (["0;1,5", "1;2,25"], [1.5, 2.25]),
        (["0;0,125", "1;3"], [0.125, 3.0]),
        (["01.02.2026;1,5", "02.02.2026;2"], [1.5, 2.0]),  # a column of dates is another one
        (["0;1,234", "1;999"], "can be thousands or decimals"),
    ],
)
def test_decimal_commas_are_those_of_their_column(rows, values, tmp_path):
    (tmp_path / "a.csv").write_text("\n".join(["time;value", *rows]))
    if isinstance(values, str):
        with pytest.raises(StudyError, match=values):
            read_columns("a.csv", tmp_path, "file")
        return
    found = read_columns("a.csv", tmp_path, "file")
    assert column(found, "value", "a.csv", "file").tolist() == values


def test_a_matlab_file_that_unpacks_to_too_much_is_refused_at_once(tmp_path):
    zeros = np.zeros(4_000_000)
    scipy.io.savemat(tmp_path / "a.mat", {"rec": {"x": zeros}}, do_compression=True)
    assert "x" in read_columns("a.mat::rec", tmp_path, "file")
    content = (tmp_path / "a.mat").read_bytes()
    (tmp_path / "b.mat").write_bytes(content + 8 * content[128:])  # nine such variables
    with pytest.raises(StudyError, match="unpacks to more than 256 MiB"):
        read_columns("b.mat::rec", tmp_path, "file")


def test_only_columns_that_are_asked_for_have_one_length(folder, tmp_path):
    time = np.linspace(0.01, 0.059, 50)
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file["time"], file["value"], file["other"] = time[:, None], time[None], np.arange(7.0)
        file["note"] = np.array([[104, 105, 33]], np.uint16)
        file["note"].attrs["MATLAB_class"] = b"char"
    entry = TRACE | {"file": "a.mat"}
    _, (one,), _ = made(spec_of(tmp_path, entry))
    assert len(one.measured) == 50 and "note" not in read_columns("a.mat", tmp_path, "file")
    with pytest.raises(StudyError, match="differ in length: time 50, other 7; allowed: one length"):
        made(spec_of(tmp_path, entry | {"value": "other"}))


def test_columns_come_from_matlab(tmp_path):
    f, h = FREQUENCY, np.exp(0.01j * FREQUENCY)
    inner = {"frequency_hz": f[:, None], "real": h, "note": "hammer"}
    scipy.io.savemat(tmp_path / "a.mat", {"run1": inner, **inner, "gain": 2.0})
    with h5py.File(tmp_path / "b.mat", "w") as file:  # as version 7.3 has it
        whole = np.empty(len(h), [("real", float), ("imag", float)])
        whole["real"], whole["imag"] = h.real, h.imag
        for at in (file, file.create_group("run1")):
            at["frequency_hz"], at["real"], at["gain"] = f[None], whole[None], [[2.0]]
    for name in ("a.mat", "a.mat::run1", "b.mat", "b.mat::run1"):
        found = read_columns(name, tmp_path, "file")
        np.testing.assert_array_equal(column(found, "frequency_hz", name, "file"), f)
        np.testing.assert_array_equal(column(found, "real", name, "file"), h)
    with pytest.raises(StudyError, match="has no struct run2"):
        read_columns("a.mat::run2", tmp_path, "file")
    (tmp_path / "c.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(range(256)) * 2)
    with pytest.raises(StudyError, match="cannot be read"):
        read_columns("c.mat", tmp_path, "file")


def test_columns_come_from_three_formats(tmp_path):
    f, h = FREQUENCY, np.exp(0.01j * FREQUENCY)
    write(tmp_path, "a.csv", frequency_hz=f, real=h.real, imag=h.imag)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("run 1")
        group["frequency_hz"], group["real"], group["imag"] = f, h.real, h.imag
    sets = pyuff.prepare_58(
        binary=0,
        func_type=4,
        rsp_node=1,
        rsp_dir=1,
        ref_node=1,
        ref_dir=1,
        data=h,
        x=f,
        id1="response",
        rsp_ent_name="a",
        ref_ent_name="b",
        abscissa_spacing=1,
        abscissa_spec_data_type=18,
        ordinate_spec_data_type=12,
        orddenom_spec_data_type=13,
        return_full_dict=False,
    )
    pyuff.UFF(str(tmp_path / "a.uff")).write_sets(sets, "add")
    one = numbers_of(read_columns("a.csv", tmp_path, "file"))
    two = numbers_of(read_columns("a.h5::run 1", tmp_path, "file"))
    three = read_columns("a.uff::1", tmp_path, "file")
    assert all(np.array_equal(one[name], two[name]) for name in one)
    np.testing.assert_allclose(three["frequency_hz"], f, rtol=1e-4)
    np.testing.assert_allclose(three["value"], h, atol=1e-4)
    with pytest.raises(StudyError, match="has functions 1 to 1"):
        read_columns("a.uff::2", tmp_path, "file")


@pytest.mark.long
def test_twenty_numbers_from_fifteen_responses(tmp_path):
    """Three responses of 2,000 points at five poses, in two minutes on two cores."""
    frequency = np.linspace(20, 1200, 2000)
    write(tmp_path, "response.csv", frequency_hz=frequency, real=0 * frequency + 1, imag=frequency)
    poses = [(0, 0, 0.52), (0.02, 0, 0.52), (0, 0.02, 0.45), (-0.02, 0.01, 0.6), (0.01, -0.02, 0.5)]
    pairs = (
        ("actuator 1.1", "sensor 1.2", 1e-4),
        ("hammer 2 at 0.07", "sensor 2.1", 0.1),
        ("slider 3", "deflection 3 at 0.1", 1e-7),
    )
    entries = [
        RESPONSE | {"pose": pose, "input": one, "output": other, "sigma": sigma}
        for pose in ([float(x) for x in pose] for pose in poses)
        for one, other, sigma in pairs
    ]
    ratio = [[0.011, 0.02, 0.02], [0.01, 0.021, 0.02], [0.012, 0.02, 0.02]]
    link = LOADED | {
        "modes": 8,
        "youngs_modulus": [69e9, 70.5e9, 71e9],
        "thickness": [2e-3, 2e-3, 2e-3],
        "damping_ratio": ratio,
    }
    free = {
        "link.youngs_modulus": {"from": 60e9, "to": 80e9},
        "link.joint_inertia_c": {"from": 1e-7, "to": 5e-5},
        "link.thickness": {"from": 1.8e-3, "to": 2.2e-3},
        "machine.platform_mass": {"from": 0.15, "to": 0.35},
        "machine.platform_inertia": {"from": 1e-4, "to": 6e-4},
        "link.damping_ratio": {"from": 0.001, "to": 0.05},
        "drive.kd": {"from": 30.0, "to": 100.0},
        "drive.kp": {"from": 1e4, "to": 4e4},
    }
    spec = spec_of(tmp_path, *entries, free=free, study={"link": link})
    bench, measurements, values = made(spec)
    rng = np.random.default_rng(5)
    for one in measurements:
        noisy(one, "response", values, rng)
    started = time.perf_counter()
    problem = make_problem(spec, bench, measurements)
    answer = describe_fit(problem, solve(problem, 32, 4, 60, 0).best.u)
    took = time.perf_counter() - started
    truth = spec.free.places()
    away = np.linalg.norm(
        np.linalg.solve(np.linalg.cholesky(answer.covariance), answer.place - truth)
    )
    print(f"{len(values)} numbers in {took:.0f} s; truth {away**2:.1f} away, 20 expected")
    assert len(values) == 20 and answer.is_explained
    assert away**2 < chi2.ppf(0.999, 20) and took < 120


def test_curves_have_their_residuals_below():
    """Of complex responses both parts, each in its standard deviations."""
    x = np.linspace(1.0, 2.0, 5)
    away = np.arange(10.0)
    line = Line(
        abscissa="f [Hz]",
        ordinate="h [1]",
        x=x,
        measured=x,
        model=x,
        away=away,
        is_log=True,
    )
    above, below = curves([("tap", line)]).axes
    assert above.get_title(loc="left") == "tap" and len(above.lines) == 2
    assert [list(part.get_ydata()) for part in below.lines] == [list(away[:5]), list(away[5:])]


def test_samples_are_drawn_in_pairs():
    """In the units of the report."""
    values = np.random.default_rng(0).normal(size=(50, 3))
    names = "link.youngs_modulus", "drive.kp", "link.damping_ratio"
    fitted = SimpleNamespace(names=names, posterior=SimpleNamespace(values=values))
    shown = samples(fitted).axes
    assert [ax.get_visible() for ax in shown] == [k // 3 >= k % 3 for k in range(9)]
    assert shown[6].get_xlabel() == "link.youngs_modulus [GPa]"
    assert shown[6].get_ylabel() == "link.damping_ratio"
    np.testing.assert_allclose(shown[6].lines[0].get_xdata(), 1e-9 * values[:, 0])


def test_samples_of_two_numbers_are_drawn():
    fitted = SimpleNamespace(
        names=("control.gain_factor", "drive.kp"),
        comparisons=[],
        answer=SimpleNamespace(correlation=np.eye(2)),
        profiles=[],
        posterior=SimpleNamespace(values=np.random.default_rng(0).normal(size=(50, 2))),
    )
    assert list(drawings(fitted)) == ["correlations", "samples"]


def test_folders_that_cannot_be_are_refused_before_the_work(tmp_path):
    with pytest.raises(StudyError, match="a name of 300 bytes; allowed: 255"):
        check_folder(tmp_path / ("a" * 300))


def test_poses_out_of_reach_are_no_data(folder, bench):
    """Kinematics are finite everywhere; a machine that does not reach a pose is not fitted."""
    problem = posed(spec_of(folder, RESPONSE), bench)
    (one,), u = problem.measurements, problem.free.places()
    batch, codes = benches._plant_batch, np.full(benches.BATCH, status.OK)
    codes[0] = status.OUT_OF_REACH
    with mock.patch.object(benches, "_plant_batch", lambda *x: (batch(*x)[0], codes)):
        found = bench.many(problem.free.values(np.stack([u, u])))
    assert [list(x) for x in found] == [[], list(bench.poses)]
    assert np.all(np.isfinite(problem.costs(u[None])))
    one._pose = 0.5, 0.0, 0.0
    for has_slopes in (True, False):
        with pytest.raises(StudyError, match="pose out of reach at .* with the values tried"):
            one.residual(problem.free.values(u), has_slopes)
    assert list(problem.costs(u[None])) == [np.inf]


def test_spectra_of_few_averages_have_the_residuals_of_their_likelihood(folder, bench):
    """Squares add up to twice the negative log likelihood, up to a constant."""
    _, (one,), values = made(spec_of(folder, SPECTRUM | {"averages": 2}), bench)
    model = np.abs(one.predict(values, False)[0]) ** 2
    rng = np.random.default_rng(0)
    one.measured = 3.0 * model * rng.gamma(2, 0.5, len(model))

    def likelihood(values):
        model = np.abs(one.predict(values, False)[0]) ** 2
        level = np.mean(one.measured / model)
        return 2 * np.sum(2 * (np.log(level * model) + one.measured / (level * model)))

    other = values * np.array([1.01, 1.2, 0.97])
    squares = [np.sum(one.residual(x, False).value ** 2) for x in (values, other)]
    assert squares[1] - squares[0] == pytest.approx(likelihood(other) - likelihood(values))
    away = [
        np.mean(one.residual(values, False).value ** 2)
        for one.measured in model * rng.gamma(2, 0.5, (200, len(model)))
    ]
    assert np.mean(away) == pytest.approx(one.mean_square, rel=0.02)


def test_a_fit_is_written_with_what_it_cannot_predict(folder, tmp_path):
    """Held-out data do not end a finished fit; names are text, not formulas."""
    held_out = MODES | {"name": "far", "pose": [0.2, 0.2, 0.5], "check": True}
    with pytest.raises(StudyError, match="fit.data"):  # unreachable from the start: refused
        fit(spec_of(folder, ONE_MODE, held_out))
    second = {"name": "second link", "link": 2, "check": True, "frequency_hz": [114.0, 457.5]}
    second |= {"kind": "modes", "ends": "held", "sigma_hz": 1.5}
    swapped = RESPONSE | {"name": r"$\frac{a}$", "check": True, "file": "huge.csv"}
    one = np.full(len(FREQUENCY), 1e9)
    write(folder, "huge.csv", frequency_hz=FREQUENCY, real=one, imag=one)
    mass = FREE["machine.platform_mass"] | {"mean": 0.25, "sigma": 0.01}
    own = {"inputs": ["actuator 1.1"], "outputs": ["sensor 1.1", "modes"]}
    options = {"starts": 2, "refine": 1, "profile": False, "next": own}
    free = FREE | {"machine.platform_mass": mass}
    spec = spec_of(folder, ONE_MODE, second, swapped, free=free, **options)
    found = fit(spec, tmp_path / "out", progress=False)
    assert "check the units" in found.unpredicted[0]
    whole = (tmp_path / "out" / "fit.json").read_bytes()
    again = ("solve", "describe_confirmed", "draw_machines", "next_experiments")
    with mock.patch.multiple(estimating, **dict.fromkeys(again)):  # no part is found twice
        fit(spec, tmp_path / "out", resume=True, progress=False)
    assert (tmp_path / "out" / "fit.json").read_bytes() == whole
    document = json.loads((tmp_path / "out" / "fit.json").read_text())
    is_noise = {x["name"]: x["is_noise"] for x in document["held_out"]}
    assert is_noise == {"second link": True, swapped["name"]: False} and document["messages"]
    answer = found.answer
    given = load_study(tmp_path / "out" / "fitted.toml")
    assert given.link.youngs_modulus == pytest.approx(answer.values[0], rel=1e-12)
    written = load_tuning(tmp_path / "out" / "fitted_tune.toml").tune.scenarios.machines
    assert {name: list(x) for name, x in written.items()} == machines(found)
    text = text_of((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    assert "from 1 measurement (and 2 held out)" in text and "## Next experiment" in text
    head, _, rest = text.partition("## Values")
    assert head.index("![machine]") < head.index("![fit]") < head.index("![numbers]")
    low, high = 1e-9 * answer.interval[0]
    value, sigma, unit, interval = re.search(
        r"\| link.youngs_modulus \| (\S+) \| (\S+) \| (\S+) \| (.*?) \|", rest
    ).groups()
    assert float(value) == pytest.approx(1e-9 * answer.values[0], rel=1e-2) and unit == "GPa"
    assert float(sigma) == pytest.approx(1e-9 * answer.sigma[0], rel=0.1)
    assert [float(x) for x in interval.split(" to ")] == pytest.approx([low, high], rel=1e-2)
    assert found._repr_html_().count("data:image/png;base64,") == 1
    assert "| second link (held out) | mode 2 [Hz] | 457.5 |" in text
    assert "mode 2 of the model" in text
    assert found.experiments[0].widest < 0.5 * np.sqrt(np.linalg.eigvalsh(answer.covariance)[-1])


def test_long_files_are_thinned_or_refused(folder, tmp_path):
    """At once, and with the number that would do."""
    time = np.linspace(0.01, 0.059, 50_001)
    write(tmp_path, "trace.csv", time=time, value=np.arange(len(time)))
    with pytest.raises(
        StudyError, match=r"data\[0\].thin = 1; allowed: 3 or more .* of 50001 rows"
    ):
        made(spec_of(tmp_path, TRACE))
    _, (one,), _ = made(spec_of(tmp_path, TRACE | {"thin": 500}))
    assert one.measured.tolist() == list(range(0, 50_001, 500))
