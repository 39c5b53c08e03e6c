"""The sampled loop: known designs, leakage into the modal filter, and a nonlinear run."""

from functools import partial

import jax
import numpy as np
import pytest
import scipy.interpolate
import scipy.linalg

from jaxmodel import sampled_loop
from jaxmodel.defaults import HOME
from jaxmodel.linear import linearise, natural_modes
from jaxmodel.linear_residual import linear_residual
from jaxmodel.loop_figures import LOWEST
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import (
    closed_loop,
    slowest_decay,
    spillover,
    summed_squares,
)
from studies.engine.programs import kept_jit
from studies.engine.runs import _simulate
from studies.engine.stability import gain_margin, loop_report
from studies.study.cases import as_arrays, build_case, build_structure
from tests import DATA
from tests.bare import paper_study
from tests.elements import plant_of_elements

STUDY = paper_study()
HOME_POSE = np.array(HOME)
PAPER = (3.1, 3.5, 3.4)  # gains [N s/m]; the default design has half of them
PER_MODE = {
    "control__velocity_gain": (1.0, 1.0, 1.0),
    "control__ratios": ((1.55, 2.0, 3.0),) * 3,
    "electronics__lowpass_ratio": (3.0, 1.5, 1.5),
    "electronics__lowpass_zeta": (0.7, 0.3, 0.15),
}
TRUNCATED = {"link__static_correction": False}
FAST = {
    "control__velocity_gain": PAPER,
    "electronics__sample_rate_hz": 20_000.0,
    "electronics__antialias_hz": 4_000.0,
}
#: Of truncated plants, found elsewhere: margins at 8 and 12 modes [dB], damping ratios of three
#: modes at 8.
TABLE = {
    "half gain": ({}, (12.9, 8.6), (0.248, 0.028, 0.011)),
    "paper's gain": ({"control__velocity_gain": PAPER}, (6.9, 2.6), (0.177, 0.047, 0.012)),
    "20 kHz": (FAST, (10.5, 6.6), (0.189, 0.047, 0.012)),
    "per mode": (PER_MODE, (14.0, 9.6), (0.248, 0.088, 0.058)),
}


def arrays(**changes):
    """(Structure, Case) of a changed study; the run's length does not matter here."""
    study = STUDY.change(**changes)
    return build_structure(study)._replace(n_steps=1), as_arrays(build_case(study))


prepared = kept_jit(static_argnums=0)(prepare)


@partial(jax.jit, static_argnums=0)
def linear_plant(structure, case):
    loop = prepare(structure, case).loop
    return linearise(structure, loop, HOME_POSE)


loop_matrices = kept_jit(static_argnums=0)(closed_loop)
lengthening = kept_jit(static_argnums=0)(spillover)
slowest = jax.jit(slowest_decay)


@pytest.fixture(scope="module")
def reports():
    """Loop reports of the table at eight plant modes."""
    return {
        name: loop_report(*arrays(**TRUNCATED, **changes), HOME_POSE, n_modes=8)
        for name, (changes, _, _) in TABLE.items()
    }


def margin_of(matrices):
    opened, feedback = np.asarray(matrices.open), np.asarray(matrices.feedback)
    return gain_margin(lambda factor: np.linalg.eigvals(opened + factor * feedback))


def decibels(factor):
    return 20 * np.log10(factor)


@pytest.mark.parametrize("name", TABLE)
def test_table_of_designs(reports, name):
    _, (margin, _), damping = TABLE[name]
    report = reports[name]
    assert report.is_stable and report.spectral_radius < 1
    np.testing.assert_allclose(decibels(report.gain_margin), margin, atol=0.2)
    np.testing.assert_allclose(report.damping_ratio.min(axis=1), damping, atol=2e-3)


@pytest.mark.long  # in short: with eight, and with three in test_static
@pytest.mark.parametrize("name", TABLE)
def test_margins_with_twelve_plant_modes(name):
    changes, (_, margin), _ = TABLE[name]
    matrices = loop_matrices(*arrays(link__modes=12, **TRUNCATED, **changes), HOME_POSE)
    np.testing.assert_allclose(decibels(margin_of(matrices)), margin, atol=0.2)


def finite_element_plant():
    """The plant at home from independent finite elements, 40 cable elements a link."""
    with np.load(DATA / "fe_plant.npz") as given:
        return plant_of_elements(dict(given))


@partial(jax.jit, static_argnums=0)
def around_finite_elements(structure, case):
    """Loop matrices; called only while `linearise` gives the finite elements."""
    return closed_loop(structure, case, HOME_POSE)


@pytest.mark.long  # in short: of links that lengthen, in test_stretch
@pytest.mark.parametrize("name", TABLE)
def test_loops_are_those_of_finite_elements(name, monkeypatch):
    """The controller around an independent plant; nothing is shared but how it is sampled."""
    structure, case = arrays(link__modes=12, **TABLE[name][0])
    found = loop_matrices(structure, case, HOME_POSE)
    plant = finite_element_plant()
    monkeypatch.setattr(sampled_loop, "linearise", lambda *_: plant)
    wanted = around_finite_elements(structure, case)
    np.testing.assert_allclose(margin_of(found), margin_of(wanted), rtol=1e-4)
    # and the poles of the controlled modes
    mine, true = (np.log(np.linalg.eigvals(x.open + x.feedback)) for x in (found, wanted))
    highest = 2 * np.pi * 1100 * float(case.electronics.period)
    mine = mine[(mine.imag > 0.02) & (np.abs(mine) < highest)]
    near = true[np.abs(mine[:, None] - true).argmin(axis=1)]
    assert len(mine) >= 12 and (np.abs(mine - near) < 1e-3 * np.abs(near)).all()


def test_frequencies_stay_near_the_assembled_ones(reports):
    found = reports["half gain"].frequency_hz[1:]  # mode 1 is damped too much to compare
    np.testing.assert_allclose(found, np.repeat([[457.55], [1029.5]], 3, axis=1), rtol=0.01)


def by_difference(n_modes):
    changes = {
        "control__velocity_gain": PAPER,
        "electronics__estimator": "difference",
        "electronics__antialias_hz": 1_000.0,
        "electronics__difference_cutoff_hz": 1e5,
    }
    return loop_report(*arrays(link__modes=n_modes, **changes), HOME_POSE, n_modes=n_modes)


def test_difference_destabilises_the_paper_gains_with_eight_modes():
    report = by_difference(8)
    assert not report.is_stable and report.spectral_radius > 1.1 and report.gain_margin < 0.5


@pytest.mark.long
def test_so_it_does_with_six_modes_and_the_static_correction_of_the_others():
    report = by_difference(6)  # truncated, six modes would be stable
    assert not report.is_stable and report.gain_margin < 0.5


def test_gain_margin_stops_at_the_first_unstable_gap():
    def poles(factor):  # stable again above 3: a conditional margin does not count
        return np.array([0.5, 1.5 if 2 < factor < 3 else 0.9])

    np.testing.assert_allclose(gain_margin(poles), 2, rtol=1e-4)
    # no factor to start with is left out
    found = gain_margin(lambda factor: poles(4 * factor), np.array([0.2, 0.6, 1.0]))
    np.testing.assert_allclose(found, 0.5, rtol=1e-4)


def test_gain_margin_of_known_poles():
    def poles(factor):
        return np.array([0.5, 0.9 + 0.1 * factor / 0.37])

    for first in (None, np.array([0.2, 0.6, 1.0])):
        np.testing.assert_allclose(gain_margin(poles, first), 0.37, rtol=1e-4)
    assert gain_margin(lambda factor: np.array([1.1])) == 0
    assert gain_margin(lambda factor: np.array([0.9])) == 64
    assert gain_margin(lambda factor: np.array([0.9]), highest=3.0) == 3
    found = gain_margin(lambda factor: np.array([0.99 + factor]), np.array([0.5]))
    np.testing.assert_allclose(found, 0.01, rtol=1e-4)
    assert gain_margin(lambda factor: np.array([0.9]), highest=1e-3) == 1e-3
    found = gain_margin(lambda factor: np.array([0.9 + 1e3 * factor]), highest=1e-3)
    np.testing.assert_allclose(found, 1e-4, rtol=1e-4)
    weak = gain_margin(lambda factor: np.array([0.9 + 1e3 * factor]))
    np.testing.assert_allclose(weak, 1e-4, rtol=1e-4)
    assert gain_margin(lambda factor: np.array([0.9 + factor / LOWEST])) == 0


# --- ideal feedback: units and limits of the gains ------------------------------------------------

PAPER_LOCKED = {
    "link__modes": 3,
    "control__feedback": "ideal",
    "control__basis": "pinned_free",
    "control__gain_factor": 1.0,
    "control__velocity_gain": (3.1, 3.1, 3.1),
    "drive__locked": True,
}


def first_mode_damping(**changes):
    modes = natural_modes(linear_plant(*arrays(**{**PAPER_LOCKED, **changes})))
    is_first = (modes.frequency > 100) & (modes.frequency < 200)
    assert is_first.sum() == 3
    return modes.damping_ratio[is_first]


def test_gain_in_newton_seconds_per_metre_damps_the_assembled_mode():
    np.testing.assert_allclose(first_mode_damping(), 0.320, atol=1e-3)
    np.testing.assert_allclose(first_mode_damping(control__gain_factor=0.0), 0.01, rtol=1e-6)


def test_gain_per_second_adds_next_to_nothing():
    np.testing.assert_allclose(first_mode_damping(control__gain_unit="1/s"), 0.011, atol=5e-4)


def ideal_damping(factor):
    """Damping ratios of the oscillating modes near link modes 1 to 3, (3, 3)."""
    gains = {"control__velocity_gain": PAPER, "control__gain_factor": factor}
    changes = {"control__feedback": "ideal", **gains}
    modes = natural_modes(linear_plant(*arrays(**changes)))
    bands = ((100, 250), (400, 600), (1000, 1100))
    is_oscillating = modes.damping_ratio < 0.99
    inside = [
        modes.damping_ratio[is_oscillating & (modes.frequency > low) & (modes.frequency < high)]
        for low, high in bands
    ]
    return np.stack(inside)


def test_ideal_feedback_damps_up_to_a_limit():
    zeta = ideal_damping(1.0)
    assert np.all((zeta[0] > 0.325) & (zeta[0] < 0.345))
    np.testing.assert_allclose(zeta[1:].min(axis=1), [0.044, 0.012], atol=5e-4)
    # ten times the gain damps mode 1 less: the aliased modes' feed-through closes a loop of its own
    np.testing.assert_allclose(ideal_damping(10.0)[0].min(), 0.046, atol=1e-3)


def at_home(**changes):
    """(Structure, Case) of a short run that stays where it is."""
    study = STUDY.change(
        motion__waypoints=(HOME, HOME),
        motion__move_time=0.01,
        run__duration=0.03,
        metrics__residual_delay=0.0,
        metrics__residual_length=0.01,
        **changes,
    )
    return build_structure(study), as_arrays(build_case(study))


def run(structure, case):
    """A run with its record and few metrics: what nobody asks for takes time to compile."""
    few = structure._replace(metrics=("residual_rms",), n_frequencies=1)
    return _simulate(few, case, True)


def test_ideal_feedback_of_a_run_is_its_gains_times_rates():
    """Rates by splines through deflections sampled ten times in a period of the fastest mode."""
    structure, case = at_home(
        link__modes=2,
        control__feedback="ideal",
        control__modes=2,
        control__velocity_gain=(1.0, 0.5, 0.7),
        initial__modal=((1e-4, 2e-5), (), (-1e-4, 0.0)),
    )
    record = run(structure, case).record
    on_rate = np.asarray(prepared(structure, case).loop.ideal[0])
    path = scipy.interpolate.CubicSpline(record.time, record.modal_coordinate)
    wanted = np.einsum("ikr,nir->nik", on_rate, path(record.time, 1))
    inside = slice(3, -3)
    size = np.abs(wanted).max()
    assert 1 < size < 50  # below the limit
    found = np.asarray(record.actuator_voltage)
    np.testing.assert_allclose(found[inside], wanted[inside], rtol=0, atol=0.01 * size)


def test_feedthrough_of_the_aliased_modes():
    structure, case = arrays(link__modes=16)
    many = 24  # 0.58 at 8 modes, 0.68 in the limit: modes 7, 9, 23, 25 against 15, 17
    still = case.initial._replace(modal=np.zeros((3, many)))
    case = case._replace(n_modes=np.array(many), initial=still)
    loop = prepared(structure._replace(n_modes=many), case).loop
    compliance = 1 / np.asarray(loop.omega[0]) ** 2  # per modal mass, as is the actuator
    drive = np.asarray(loop.actuator[0] @ loop.controller.feedback.synthesizer[0])[:, 0]
    through = np.asarray(loop.observer[0, 0]) * compliance * drive
    np.testing.assert_allclose(through[3:].sum() / through[0], 0.65, atol=5e-3)


# --- modal filter ---------------------------------------------------------------------------------


def test_leakage_into_the_first_pinned_free_mode():
    same = prepared(*arrays(link__basis="pinned_free", control__basis="pinned_free"))
    row = np.asarray(same.loop.observer[0, 0])
    np.testing.assert_allclose(row[:3], [1, 0, 0], atol=1e-10)
    np.testing.assert_allclose(row[3:6], [0.21, 1.29, 10.4], atol=0.04)
    other = prepared(*arrays(control__basis="pinned_free"))
    row = np.asarray(other.loop.observer[0, 0])
    np.testing.assert_allclose(row[4:7], [-1.1, 6.5, 41], rtol=0.02)
    np.testing.assert_allclose(row[[3, 7]], 0, atol=1e-10)  # nodes at the paper's patches
    for condition in (same.sensor_condition, same.actuator_condition):
        np.testing.assert_allclose(condition, 7, atol=0.5)


# --- against the nonlinear run --------------------------------------------------------------------

SMALL = 1e-7  # initial modal displacement [m]: linear to about one part in 10^5
#: Runs that share a program.
LINEAR = {
    "link__modes": 3,
    "run__duration": 0.05,
    "run__smooth": True,
    "electronics__adc_bits": 32,
    "motion__move_time": 0.03,
    "shaper__kind": "none",
    "metrics__residual_delay": 0.0,
    "metrics__residual_length": 0.015,
}
RELEASED = {"motion__waypoints": (HOME, HOME), "initial__modal": ((SMALL,), (), ())}


def released(**changes):
    """Structure, case and modal coordinates (n_steps, 3, R) after letting link 1 go."""
    study = STUDY.change(**LINEAR, **RELEASED, **changes)
    structure, case = build_structure(study), as_arrays(build_case(study))
    result = run(structure, case)
    assert result.status == 0
    return structure, case, np.asarray(result.record.modal_coordinate)


def test_overdamped_link_modes_are_not_followed():
    structure, case = arrays(
        link__modes=3, link__damping_ratio=0.9999999999999999, motion__waypoints=(HOME, HOME)
    )
    report = loop_report(structure, case, HOME_POSE)
    assert report.damping_ratio.shape == (3, 3)
    assert 0 < report.spectral_radius < 1 and report.gain_margin > 1


def test_decay_of_the_nonlinear_run_is_the_predicted_damping():
    changes = {"control__gain_factor": 0.2, "drive__locked": True}
    structure, case, q = released(**changes)
    first = q[:, 0, 0]
    is_peak = (first[1:-1] > first[:-2]) & (first[1:-1] > first[2:])
    before, peak, after = (first[k : len(first) - 2 + k][is_peak] for k in range(3))
    top = peak + (after - before) ** 2 / (8 * (2 * peak - before - after))  # parabola
    top = top[1:]  # the first half period holds the start of the filters
    decrement = np.log(top[0] / top[-1]) / (len(top) - 1)
    measured = decrement / np.sqrt(4 * np.pi**2 + decrement**2)
    assert len(top) >= 4 and measured > 0.03
    predicted = loop_report(structure, case, HOME_POSE).damping_ratio[0]
    assert np.abs(predicted - measured).min() < 0.05 * measured


def test_slowest_decay_is_that_of_the_largest_eigenvalue():
    """Stable and unstable, of a loop as it is and of a matrix with a repeated eigenvalue."""
    structure, case = arrays()
    matrices = loop_matrices(structure, case, HOME_POSE)
    period = case.electronics.period
    for factor in (0.0, 1.0, 40.0):
        whole = np.asarray(matrices.open + factor * matrices.feedback)
        wanted = -np.log(np.abs(np.linalg.eigvals(whole)).max()) / period
        assert abs(slowest(whole, period) - wanted) < 1e-3
    assert wanted < -1  # the last one is unstable
    jordan = np.array([[0.9, 1.0], [0.0, 0.9]])
    np.testing.assert_allclose(slowest(jordan, 1.0), -np.log(0.9), atol=1e-6)


@pytest.mark.parametrize("swing", [0.3, 0.02, 0.0])
def test_slowest_decay_has_a_gradient(swing):
    """Of a complex pair, also a nearly real one, and of a real number, beside faster motions."""
    random = np.random.default_rng(0)
    shape = random.normal(size=(4, 4))
    block = np.zeros((4, 4))
    block[:2, :2] = [[0.9, swing], [-2 * swing, 0.9 - (swing == 0)]]
    block[2:, 2:] = np.diag([0.5, -0.4])
    matrix, change = shape @ block @ np.linalg.inv(shape), random.normal(size=(4, 4))
    value, left, right = scipy.linalg.eig(matrix, left=True)
    k = np.argmax(np.abs(value))
    y, x = left[:, k].conj(), right[:, k]
    exact = -((y @ change @ x) / (y @ x) / value[k]).real / 0.01

    np.testing.assert_allclose(decay_slope(matrix, change), exact, rtol=1e-4)
    np.testing.assert_allclose(decay_tangent(matrix, change), exact, rtol=1e-4)
    up, down = (slowest(matrix + e * change, 0.01) for e in (1e-5, -1e-5))
    np.testing.assert_allclose((up - down) / 2e-5, exact, rtol=1e-6)


def decay_along(matrix, change, e):
    return slowest_decay(matrix + e * change, 0.01)


@jax.jit
def decay_slope(matrix, change):
    return jax.grad(partial(decay_along, matrix, change))(0.0)


@jax.jit
def decay_tangent(matrix, change):
    return jax.jvp(partial(decay_along, matrix, change), (0.0,), (1.0,))[1]


# --- sums over all that follows -------------------------------------------------------------------


@jax.jit
def sums(matrix, start, factor):
    """Of a matrix times a factor, and the derivative of their size's logarithm."""

    def found(factor):
        sums = summed_squares(factor * matrix, start)
        return sums.log_size, sums

    (_, sums), slope = jax.value_and_grad(found, has_aux=True)(factor)
    return sums, slope


@pytest.mark.parametrize("radius", [0.3, 0.99, 1.01])
def test_sum_of_squares_solves_its_equation(radius):
    """P = M P M' + S where M is stable; else it is large but a number, and so is its derivative."""
    random = np.random.default_rng(3)
    matrix = random.normal(size=(5, 5))
    matrix *= radius / np.abs(np.linalg.eigvals(matrix)).max()
    start = np.diag(random.uniform(size=5))
    found, slope = sums(matrix, start, 1.0)
    if radius < 1:
        whole = found.share * np.exp(found.log_size)
        np.testing.assert_allclose(whole, scipy.linalg.solve_discrete_lyapunov(matrix, start))

    up, down = (sums(matrix, start, 1 + e)[0].log_size for e in (1e-6, -1e-6))
    difference = (up - down) / 2e-6
    assert np.isfinite(slope)
    np.testing.assert_allclose(slope, difference, rtol=1e-4)


def test_optimal_damping_of_one_mode_has_a_closed_form():
    """sum x^2 of a released oscillator is (1 + 4 zeta^2)/(4 zeta omega T): least at zeta = 1/2."""
    omega, period = 2 * np.pi * 100, 1e-5

    def energy(zeta):
        rates = np.array([[0.0, 1.0], [-(omega**2), 0.0]])
        damped = rates - 2 * omega * zeta * np.array([[0.0, 0.0], [0.0, 1.0]])
        matrix = jax.scipy.linalg.expm(damped * period)
        found = summed_squares(matrix, np.diag([1.0, 0.0]))
        return found.share[0, 0] * jax.numpy.exp(found.log_size) * period

    found = jax.jit(jax.value_and_grad(energy))
    for zeta in (0.1, 0.5, 0.9):
        wanted = (1 + 4 * zeta**2) / (4 * zeta * omega)
        np.testing.assert_allclose(found(zeta)[0], wanted, rtol=0.01)
    assert abs(found(0.5)[1]) < 0.01 * abs(found(0.4)[1])


def test_spillover_is_what_damping_of_the_uncontrolled_modes_loses():
    """1 without gains; with them above 1, and the more the higher the gains."""
    found = []
    for factor in (0.0, 1.0, 2.0):
        structure, case = arrays(control__gain_factor=factor)
        matrices = loop_matrices(structure, case, HOME_POSE)
        found.append(float(lengthening(structure, case, matrices)))
        period = float(case.electronics.period)
        plant, poles = (
            np.linalg.eigvals(np.asarray(m))
            for m in (
                matrices.plant,
                matrices.open + matrices.feedback,
            )
        )
        weak = plant[(np.abs(plant) > 4**2 * 100 * 2 * np.pi) & (plant.imag > 0)]
        weak = weak[-weak.real < 0.1 * np.abs(weak)]  # filters are damped well
        near = np.array([poles[np.argmin(np.abs(poles - np.exp(s * period)))] for s in weak])
        kept = -np.log(np.abs(near)) / period / -weak.real
        assert len(weak) == 15
        np.testing.assert_allclose(found[-1] - 1, 1 / kept.min() - 1, rtol=0.06, atol=1e-6)
    np.testing.assert_allclose(found[0], 1, atol=1e-6)
    assert 1.01 < found[1] < found[2]


@pytest.mark.long  # in short: slopes of a tuning's limits
def test_spillover_has_a_gradient():
    structure, case = arrays(link__modes=5)

    def lengthened(x):
        factor, thickness = x
        beam = case.machine.beam._replace(thickness=thickness * case.machine.beam.thickness)
        changed = case._replace(
            control=case.control._replace(gain_factor=factor),
            machine=case.machine._replace(beam=beam),
        )
        return spillover(structure, changed, closed_loop(structure, changed, HOME_POSE))

    @jax.jit
    def pushed(x, way):
        return jax.jvp(lengthened, (x,), (way,))

    x = np.array([0.7, 1.01])
    for way in np.eye(2):
        slope = pushed(x, way)[1]
        up, down = (pushed(x + e * way, way)[0] for e in (1e-4, -1e-4))
        assert abs(slope) > 1e-4
        np.testing.assert_allclose(slope, (up - down) / 2e-4, rtol=1e-4)


def test_linear_residual_agrees_with_the_run():
    study = STUDY.change(**LINEAR, motion__waypoints=(HOME, (0.0, 0.002, HOME[2])))
    structure, case = build_structure(study), as_arrays(build_case(study))
    matrices = loop_matrices(structure._replace(n_steps=1), case, HOME_POSE)
    linear = jax.jit(linear_residual, static_argnums=0)(structure, case, matrices)
    result = run(structure, case)
    assert result.status == 0
    np.testing.assert_allclose(linear, result.metrics.residual_rms, rtol=0.1)
