"""Delays of any length between a sample and its command."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.case import Structure
from jaxmodel.delay import LONGEST, command_change
from jaxmodel.drives import DRIVES
from jaxmodel.electronics import measurement_chain
from jaxmodel.pairs import Pair
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import delayed
from jaxmodel.sampled_loop import closed_loop
from jaxmodel.sampled_response import command_gain, response_of_loop
from jaxmodel.simulate import simulate
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.space.machines import ModelMismatch
from studies.spillover.certificate import certify
from studies.study.cases import build_structure
from studies.tuning.optimise import optimise
from studies.tuning.run import make_evaluator
from studies.tuning.spec import parse_tuning
from tests.bare import paper_study, parse_study
from tests.jaxmodel.kept import arrays, loop_at, nominal_of, plant_at, simulated
from tests.jaxmodel.test_notch import NOTCHES
from tests.jaxmodel.test_onset import BASE, HOME, is_growing
from tests.studies.kernels.test_kernel import both, check_equal
from tests.sweeps import small_spec
from tests.tunings import GAIN, SMALL

POSE = np.array(HOME)
ELECTRONICS = {"sensor_highpass_hz": 5.0, "amplifier_hz": 2e3}
#: Without electronics each kind of check is a program of its own, and their special case.
KINDS = [pytest.param({}, marks=pytest.mark.long), ELECTRONICS]
DELAYS = (0.0, 0.125, 1.0, 2.625, 4.0)


def small(delay, unmodelled=0.0, electronics=None, **sections):
    own = {**BASE["electronics"], **(electronics or {})}
    own |= {"delay": delay, "unmodelled_delay": unmodelled}
    return parse_study({**BASE, "link": {"modes": 2}, **sections, "electronics": own})


@pytest.mark.parametrize(
    ("delay", "before", "after", "share"),
    [(0.0, 1, 0, 0.0), (0.25, 1, 0, 0.25), (1.0, 1, 0, 1.0), (1.25, 2, 1, 0.25), (4.0, 4, 3, 1.0)],
)
def test_command_changes_once_a_sample(delay, before, after, share):
    change = command_change(delay)
    order = np.arange(LONGEST + 1)
    np.testing.assert_array_equal(change.before, order == before)
    np.testing.assert_array_equal(change.after, order == after)
    assert float(change.share) == share


def test_a_command_that_changes_within_samples_needs_a_step_on_either_side():
    plain = Structure(substeps=3)
    assert [plain._replace(has_delay=x).plant_steps for x in (False, True)] == [3, 6]
    assert plain._replace(has_delay=True, feedback="none").plant_steps == 3


@pytest.mark.parametrize(("delay", "more", "most"), [(4.01, 0.0, "4"), (2.5, 1.6, "1.5")])
def test_delays_of_more_than_four_samples_are_refused(delay, more, most):
    with pytest.raises(StudyError, match=rf"delay = {more or delay}; allowed: .* {most}\b"):
        small(delay, more)


def test_whole_samples_of_delay_turn_the_phase_alone():
    """Of the gain around the loop, whose delay is one sample where the study says nothing."""

    @partial(jax.jit, static_argnums=0)
    def gain(structure, case):
        response = response_of_loop(structure, case, prepare(structure, case).loop, np.array(HOME))
        return command_gain(response, omega)

    omega = 2 * np.pi * 200.0
    structure, case = arrays(small(3.0))
    late, once = (gain(structure._replace(has_delay=x), case) for x in (True, False))
    turned = once * np.exp(-2j * omega * case.electronics.period)
    np.testing.assert_allclose(late, turned, atol=1e-9 * np.abs(once).max())


def test_exponential_by_arithmetic():
    rng = np.random.default_rng(1)
    s = (rng.normal(size=50) * 1e4 + 2j * np.pi * rng.uniform(-5e3, 5e3, 50)).astype(complex)
    found = delayed(Pair(jnp.asarray(s.real), jnp.asarray(s.imag)), 3e-4)
    np.testing.assert_allclose(found.re + 1j * found.im, np.exp(-s * 3e-4), rtol=1e-12)


def test_controller_knows_its_own_delay_only():
    omega = 2 * np.pi * np.array([114.4, 1029.5])
    one, other = (
        measurement_chain(omega, arrays(study)[1].electronics)
        for study in (small(1.0), small(2.5, -0.5))
    )
    np.testing.assert_allclose(other / one, np.exp(-1.5j * omega * 1e-4), rtol=1e-12)


@pytest.mark.parametrize("electronics", KINDS, ids=["plain", "amplifier, high-pass"])
@pytest.mark.parametrize("delay", [0.0, 0.375, 2.625, 4.0])
def test_sampled_plant_is_that_of_a_queue_at_eight_times_the_rate(delay, electronics):
    """At 80 kHz, whole samples of delay, commands held for eight of them, by brute force."""
    study = small(1.0, delay - 1.0, electronics)
    slow = jax.tree.map(np.asarray, plant_at(*arrays(study), POSE))
    fast = jax.tree.map(
        np.asarray, plant_at(*arrays(small(1.0, 0.0, {**electronics, "sample_rate_hz": 8e4})), POSE)
    )
    rng, n_inputs = np.random.default_rng(0), slow.enter.shape[1]
    commands = rng.normal(size=(40, n_inputs))
    later = np.concatenate([np.zeros((int(8 * delay), n_inputs)), np.repeat(commands, 8, axis=0)])
    x, y = np.zeros(len(slow.state)), []
    z, seen = np.zeros(len(fast.state)), []
    for k, command in enumerate(commands):
        y.append(slow.leave @ x)
        x = slow.state @ x + slow.enter @ command
        seen.append(fast.leave @ z)
        for j in range(8):
            z[-n_inputs:] = later[8 * k + j]  # on the actuators from this instant on
            z = fast.state @ z
    y, seen = np.array(y), np.array(seen)
    np.testing.assert_allclose(y, seen, rtol=0, atol=1e-9 * np.abs(seen).max())


@partial(jax.jit, static_argnums=0)
def sensors(structure, case):
    """Without the controller's design, which takes longest."""
    return prepare(structure, case).loop.sensor


def released(delay, electronics, modal):
    """Structure, case and record of a run from so far deflected modes, with a law of own states."""
    study = small(
        0.5,
        delay - 0.5,
        electronics,
        run={"duration": 0.02, "smooth": True},
        initial={"modal": modal},
        metrics={"residual_delay": 0.0, "residual_length": 0.01},
        control={"law": "observer"},
    )
    structure, case = arrays(study)
    structure = structure._replace(has_noise=False, has_delay=True)
    return structure, case, jax.tree.map(np.asarray, simulated(structure, case, True).record)


def test_what_rests_stays_at_rest():
    """With every state of the electronics."""
    record = released(1.5, ELECTRONICS, [[0.0], [], [0.0]])[2]
    for name in ("sensor_voltage", "actuator_voltage", "modal_coordinate", "pose_error"):
        np.testing.assert_allclose(getattr(record, name), 0.0, rtol=0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("electronics", KINDS, ids=["plain", "amplifier, high-pass"])
@pytest.mark.parametrize("delay", DELAYS)
def test_run_is_that_of_the_matrices(delay, electronics):
    """Deflections so small that the machine is linear, without rounding."""
    structure, case, record = released(delay, electronics, [[1e-8], [], [2e-8]])
    matrices = loop_at(structure, case, POSE)
    loop = np.asarray(matrices.open + matrices.feedback)
    n = structure.n_modes
    x = np.zeros(len(loop))
    x[6 : 6 + 3 * n] = record.modal_coordinate[0].ravel()
    is_drained = "sensor_highpass_hz" in electronics
    sensor = np.asarray(sensors(structure, case))
    settled = np.einsum("ikr,ir->ik", sensor, record.modal_coordinate[0]).ravel()
    if is_drained:  # nothing of a steady bend; of the vibration after the release nearly all
        first, later = record.sensor_voltage[0], record.sensor_voltage[1:]
        np.testing.assert_allclose(first, 0, atol=1e-15)
        assert np.abs(later).max() > 0.9 * np.abs(settled).max()
    at = 6 + 6 * n + (2 * settled.size if is_drained else 0)
    x[at : at + settled.size] = settled
    q = []
    for _ in range(len(record.time)):
        q.append(x[6 : 6 + 3 * n])
        x = loop @ x
    q, found = np.array(q), record.modal_coordinate.reshape(len(record.time), -1)
    np.testing.assert_allclose(found, q, rtol=0, atol=2e-5 * np.abs(q).max())


SPECIFIED = {"pole_decay": 150.0, "pole_frequency_hz": [[110.0], [110.0], [110.0]]}


@pytest.mark.parametrize("law", ["imsc", "observer"])
@pytest.mark.parametrize("delay", [0.0, 2.5])
def test_poles_are_placed_on_the_loop_with_its_delay(law, delay):
    """The nominal loop, with the commands on their way, has the specified poles."""
    study = small(delay, 0.25, ELECTRONICS, control={"law": law, **SPECIFIED})
    structure, case = arrays(study)
    wanted, matrices = nominal_of(structure, case)
    z = np.exp(np.asarray(wanted) * float(case.electronics.period))
    for link in range(3):
        for mode in range(z.shape[1]):
            block = matrices[link, min(mode, matrices.shape[1] - 1)]
            apart = np.abs(np.linalg.eigvals(block) - z[link, mode])
            assert apart.min() < 1e-7


#: A linear system that is told of limits, the same for each link, and a drive with memory, friction
#: and a limit.
ALL_PARTS = {
    "link": {"modes": 2},
    "control": {"law": "state_space", **NOTCHES},
    "state_space": {
        "a": [[0.9, 0.2], [-0.2, 0.9]],
        "b": [[0.3, -0.2, 0.1], [0.1, 0.2, -0.3]],
        "c": [[2.0, 0.4], [-1.2, 0.8], [0.8, -1.6]],
        "d": [[-2.0, 0.4, 0.0], [0.4, -1.6, 0.4], [0.0, 0.4, -2.0]],
        "anti_windup": [[0.1, 0.0, 0.05], [0.0, 0.1, 0.0]],
        "sample_time": 1e-4,
    },
    "drive": {
        "kind": "super_twisting",
        "coulomb_friction": 0.5,
        "friction_speed": 0.05,
        "ripple": 0.3,
        "force_limit": 3.0,
    },
    "patches": {"gauge_gain": 800.0},
    "metrics": {
        "residual_delay": 0.0,
        "residual_length": 0.004,
        "saturation_limit": 1.0,
        "arrival_tolerance": 1.0,
    },
}


def test_kernel_equals_scan_with_all_parts_at_once():
    """Delays, notch filters, hysteresis, gauges; each alone is long, in the files of the parts."""
    axes = {
        "control.notch_hz[0]": [0.0, 1500.0, 1900.0],
        "electronics.delay": {"from": 0.0, "to": 2.0},
        "electronics.amplifier_hz": [0.0, 2e3],
        "electronics.voltage_limit": {"from": 0.05, "to": 0.5},
        "patches.hysteresis": [0.0, 0.1, 0.2],
        "patches.sensor": ["piezo", "strain_gauge"],
        "patches.gauge_noise": [0.0, 0.01],
    } | {
        f"drive.kinds.super_twisting.{x.name}": {"from": 0.5 * x.default, "to": 1.5 * x.default}
        for x in DRIVES["super_twisting"].parameters[:2]
    }
    sweep = {"method": "random", "count": 16, "axes": axes}
    fast, reference = both(small_spec(sweep, **ALL_PARTS))
    assert np.all(reference.status == status.OK)
    assert np.max(reference.metrics.motor_saturated_fraction) > 0
    assert np.sum(reference.metrics.saturated_fraction[:16] > 0) >= 8
    assert len(np.unique(reference.metrics.pose_error_peak[:, 1])) >= 16
    check_equal(fast, reference)


@pytest.mark.long  # in short: above
def test_kernel_equals_scan():
    """With notch filters of the links, too."""
    axes = {
        "control.notch_hz[0]": [0.0, 1500.0, 1900.0],
        "control.notch_depth[2]": {"from": 0.0, "to": 0.5},
        "electronics.delay": {"from": 0.0, "to": 2.0},
        "electronics.unmodelled_delay": [0.0, 0.25, 1.5],
        "drive.kp": {"from": 1e4, "to": 2e4},
    }
    sweep = {"method": "random", "count": 16, "axes": axes}
    sections = {"link": {"modes": 2}, "electronics": ELECTRONICS, "control": NOTCHES}
    fast, reference = both(small_spec(sweep, **sections))
    assert np.sum(reference.status == status.OK) >= 8
    check_equal(fast, reference)


def changed(case, name, by):
    electronics = case.electronics
    return case._replace(
        electronics=electronics._replace(**{name: getattr(electronics, name) + by})
    )


def assert_slope(function, step=1e-3):
    """Of a function of a delay, at 0; at whole numbers of samples it is that from below."""
    both = jax.jit(lambda by: jax.jvp(function, (by,), (1.0,)))  # one program for both
    (value, slope), once, twice = both(0.0), both(-step)[0], both(-2 * step)[0]
    np.testing.assert_allclose(slope, (3 * value - 4 * once + twice) / (2 * step), rtol=1e-4)


@pytest.mark.parametrize(
    "name", ["delay", pytest.param("unmodelled_delay", marks=pytest.mark.long)]
)
def test_derivative_of_the_matrices_by_the_delay(name):
    """Of the machine, and of what the controller designs for the delay that it knows."""
    structure, case = arrays(small(1.5, -0.5))

    def loop(by):
        matrices = closed_loop(structure, changed(case, name, by), POSE)
        loop = matrices.open + matrices.feedback
        return jnp.linalg.slogdet(loop - 1.3 * jnp.eye(len(loop)))[1]

    assert_slope(loop)


@pytest.mark.long
@pytest.mark.parametrize("delay", [0.4375, 1.0, 1.3])
def test_derivative_of_a_run_by_the_delay(delay):
    study = small(
        1.5,
        delay - 1.5,
        run={"duration": 0.01, "smooth": True},
        metrics={"residual_delay": 0.0, "residual_length": 0.005},
    )
    structure, case = arrays(study)
    structure = structure._replace(has_noise=False, metrics=("residual_rms",))

    def residual(by):
        result = simulate(structure, changed(case, "unmodelled_delay", by))
        return 1e6 * jnp.sum(result.metrics.residual_rms)

    assert_slope(residual)


def test_delay_of_one_sample_costs_nothing():
    assert not build_structure(paper_study()).has_delay
    assert build_structure(small(0.5, 0.5)).has_delay


def grows(structure, case, delay):
    """Whether a small vibration grows under more delay than the controller knows [samples]."""
    electronics = case.electronics._replace(unmodelled_delay=delay)
    return is_growing(_record(structure, case._replace(electronics=electronics)))


@partial(jax.jit, static_argnums=0)
def _record(structure, case):
    return simulate(structure, case, has_record=True).record.actuator_voltage


@pytest.mark.long
@pytest.mark.parametrize("law", ["imsc", "lqg"])
def test_runs_grow_beyond_the_delay_at_which_eigenvalues_leave_the_circle(law):
    """The extra delay that the loop bears, by bisection on its matrices, within 5 %."""
    structure, case = arrays(
        small(
            1.0,
            0.1,
            control={"law": law, "gain_factor": STRONG[law]},
            initial=DEFLECTED,
        )
    )

    @jax.jit
    def radius(delay):
        electronics = case.electronics._replace(unmodelled_delay=delay)
        matrices = closed_loop(structure, case._replace(electronics=electronics), POSE)
        return matrices.open + matrices.feedback

    low, high = 0.0, 3.0
    for _ in range(12):
        middle = (low + high) / 2
        is_stable = np.abs(np.linalg.eigvals(radius(middle))).max() <= 1
        low, high = (middle, high) if is_stable else (low, middle)
    assert 0.05 < low < 2.9, low
    assert not grows(structure, case, 0.95 * low)
    assert grows(structure, case, 1.05 * high)


#: Gains with which the delay that a loop bears is a sample or so.
STRONG = {"imsc": 3.0, "lqg": 1.0}
DEFLECTED = {"load_deflection": (1e-5, 1e-5, -1e-5)}


@pytest.mark.long
def test_a_design_is_tuned_at_its_delay():
    """Downhill, by derivatives that are those of differences, and not as at another delay."""
    evaluators, at = [], []
    for delay in (1.5, 1.25):
        spec = parse_tuning(
            {
                **SMALL,
                "run": {"duration": 0.05},
                "electronics": {"delay": delay},
                "tune": {"free": GAIN, "objective": {"residual_rms": 1.0}, **TINY},
            }
        )
        evaluators.append(make_evaluator(spec))
        at.append(evaluators[-1].evaluate(np.array([[0.4]])))
    assert abs(at[1].objective[0] / at[0].objective[0] - 1) > 1e-3
    after, before = (
        evaluators[1].evaluate(np.array([[gain]])).objective[0] for gain in (0.4004, 0.3996)
    )
    assert at[1].slope[0, 0] == pytest.approx((after - before) / 8e-4, rel=1e-4)
    end = optimise(spec, evaluators[1], None, lambda progress: None)
    assert end.best_objective[end.winner(0)] < 0.97


#: The least that a tuning does.
TINY = {"limits": {}, "starts": 1, "iterations": 3}


@pytest.mark.long  # in short: of a controller from a file, in test_state_space
def test_a_certificate_judges_the_loop_with_its_delay():
    study = paper_study().change(link__modes=3, electronics__delay=1.5)
    found = certify(study, sizes=(3,), bases=("pinned_pinned",), mismatches=(ModelMismatch(),))
    pose = np.array(study.motion.waypoints[0])
    report = loop_report(*arrays(study), pose, n_modes=3)
    np.testing.assert_allclose(found.margin[0, 0, 0], report.gain_margin, rtol=2e-4)
    np.testing.assert_allclose(found.radius[0, 0, 0], report.spectral_radius, rtol=1e-9)
    other = loop_report(*arrays(study.change(electronics__delay=1.25)), pose, n_modes=3)
    assert abs(other.gain_margin / report.gain_margin - 1) > 0.02
