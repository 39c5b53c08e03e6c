"""Accelerometers on moving links, recorded commands and motor forces."""

import numpy as np
import pytest

from studies.errors import StudyError
from studies.fitting.bench import Bench, response
from studies.space.free import join_numbers
from studies.study.cases import build_case, build_structure
from studies.study.signals import OUTPUTS, Signal, parse_signal, signal_name
from studies.twin.chain import close_chain
from studies.twin.machine import describe_machine
from tests.canonical import study_of
from tests.fits import (
    ACCELEROMETER,
    ASKEW,
    FREQUENCY,
    MOTOR,
    SHORT,
    TRACE,
    answered,
    blank,
    give_data,
    made,
    posed,
    spec_of,
    write,
)

STUDY = study_of(SHORT)
NONE = np.nan
END = 0.19999  # of a link [m], just before its joint


@pytest.fixture(scope="module")
def bench():
    return Bench(STUDY, join_numbers([]).place, (tuple(ASKEW),), (0.1, END))


def gain(bench, source, output, frequency):
    plant = bench.plant(tuple(ASKEW), np.zeros(0), False)
    signals = source, output
    omega = 2 * np.pi * np.atleast_1d(frequency)
    return response(plant, signals, bench.places(signals), omega).value


def directions(bench, source, link, place, frequency):
    """Along and across a link."""
    return (
        gain(bench, source, Signal("accelerometer", link, 0, place, angle), frequency)
        for angle in (0.0, 90.0)
    )


@pytest.mark.parametrize("link", range(3))
def test_an_accelerometer_at_a_joint_moves_as_the_platform(bench, link):
    """Along and across the link, by the plane geometry of the joints and the platform's motion."""
    source, f = Signal("slider", 1, 0, NONE), [3.0, 40.0]
    x, y, phi = (gain(bench, source, Signal("platform", k, 0, NONE), f) for k in range(3))
    machine = describe_machine(build_structure(STUDY), build_case(STUDY))
    _, ends = close_chain(machine, np.array(ASKEW))
    axis = (ends[link][1] - ends[link][0]) / np.hypot(*(ends[link][1] - ends[link][0]))
    arm = ends[link][1] - ASKEW[:2]
    joint = np.stack([x - arm[1] * phi, y + arm[0] * phi])
    along, across = directions(bench, source, link, END, f)
    np.testing.assert_allclose(along, axis @ joint, rtol=1e-3)
    np.testing.assert_allclose(across, np.array([-axis[1], axis[0]]) @ joint, rtol=1e-3)


def test_between_the_joints_a_link_adds_its_bending(bench):
    """Motion across it at mid-span is the mean of both ends' and the deflection from the chord."""
    source, f = Signal("actuator", 0, 1, NONE), [20.0, 110.0, 300.0]
    machine = describe_machine(build_structure(STUDY), build_case(STUDY))
    _, ends = close_chain(machine, np.array(ASKEW))
    axis, guide = ends[0][1] - ends[0][0], machine.carriers[0].direction
    normal = np.array([-axis[1], axis[0]]) / np.hypot(*axis)
    left = gain(bench, source, Signal("slider", 0, 0, NONE), f) * (normal @ guide)
    _, right = directions(bench, source, 0, END, f)
    bent = gain(bench, source, Signal("deflection", 0, 0, 0.1), f)
    _, found = directions(bench, source, 0, 0.1, f)
    # the end is not quite at the joint
    np.testing.assert_allclose(found, (left + right) / 2 + bent, rtol=1e-3, atol=3e-11)


def test_a_drive_follows_slow_commands_without_force(bench):
    command, slow = Signal("command", 0, 0, NONE), [1e-3]
    for i in range(3):
        follows = gain(bench, command, Signal("slider", i, 0, NONE), slow)
        np.testing.assert_allclose(follows, 1.0 if i == 0 else 0.0, atol=1e-6)
        force = gain(bench, command, Signal("motor", i, 0, NONE), slow)
        assert np.abs(force) < 1e-6 * STUDY.drive.kp
    # far above all modes a slider stands still, and the motor gives all that the drive asks for
    fast = 2e5
    own = gain(bench, command, Signal("motor", 0, 0, NONE), fast)
    asked = STUDY.drive.kp + 2j * np.pi * fast * STUDY.drive.kd
    np.testing.assert_allclose(own, asked, rtol=0.01)


def test_a_motor_s_force_for_a_force_on_its_slider(bench):
    """What the drive answers to a displacement, and no friction."""
    f = np.array([5.0, 60.0, 115.0])
    source = Signal("slider", 0, 0, NONE)
    moved = gain(bench, source, Signal("slider", 2, 0, NONE), f)
    force = gain(bench, source, Signal("motor", 2, 0, NONE), f)
    np.testing.assert_allclose(force, -(STUDY.drive.kp + 2j * np.pi * f * STUDY.drive.kd) * moved)


def test_a_drive_is_identified_from_command_and_motor(tmp_path):
    """Its stiffness, damping and the slope of its friction, which a force cannot tell apart."""
    free = {
        "drive.kp": {"from": 1e4, "to": 4e4},
        "drive.kd": {"from": 20.0, "to": 200.0},
        "drive.coulomb_friction": {"from": 0.0, "to": 0.5},
    }
    blank(tmp_path)
    problem = posed(spec_of(tmp_path, MOTOR, MOTOR | {"output": "slider 1"}, free=free))
    truth = np.array([2.3e4, 70.0, 0.12])
    rng = np.random.default_rng(0)
    for one in problem.measurements:
        give_data(problem.bench, one, truth, rng)
    answer = answered(problem)
    assert answer.is_explained
    assert np.all(np.abs(answer.values - truth) < 4 * answer.sigma)
    assert np.all(answer.sigma < 0.03 * truth)
    has_effect(problem.measurements[0], [2e4, 60.0, 0.0], 2)


def has_effect(measurement, values, number):
    """A number that is 0 in the study, whose programs leave it out where it is not free."""
    none, slope = measurement.predict(np.array(values), True)
    some, _ = measurement.predict(np.array(values) + 1e-3 * np.eye(len(values))[number], False)
    assert np.abs(slope[:, number]).max() > 0
    atol = 3e-5 * np.abs(slope[:, number]).max()
    np.testing.assert_allclose(some - none, 1e-3 * slope[:, number], atol=atol)


def test_friction_from_the_motor_s_force_of_a_move(tmp_path):
    """A recorded move tells friction and damping apart; a response at rest does not."""
    free = {
        "drive.coulomb_friction": {"from": 0.0, "to": 3.0},
        "drive.viscous_friction": {"from": 0.0, "to": 30.0},
    }
    time = np.arange(0.0, 0.03, 1e-4)
    entry = TRACE | {"output": "motor 1", "sigma": 0.05}
    write(tmp_path, "trace.csv", time=time, value=np.ones(len(time)))
    study = {"drive": {"friction_speed": 0.01}, "shaper": {"kind": "none"}}
    study |= {"run": {"duration": 0.032}, "motion": SHORT["motion"] | {"move_time": 0.02}}
    study["control"] = {"modes": 2, "feedback": "none"}
    problem = posed(spec_of(tmp_path, entry, free=free, study=study))
    (one,), truth = problem.measurements, np.array([0.8, 9.0])
    exact, _ = one.predict(truth, False)
    one.measured = exact + 0.05 * np.random.default_rng(0).normal(size=len(time))
    answer = answered(problem)
    assert answer.is_explained
    assert np.all(np.abs(answer.values - truth) < 4 * answer.sigma)
    assert np.all(answer.sigma < 0.1 * truth)
    for number in range(2):
        has_effect(one, [0.0, 0.0], number)


def test_friction_of_the_joints_from_a_decay_from_20_to_1_um(tmp_path):
    """Structural damping takes a share of the amplitude, friction an amount."""
    free = {
        "machine.joint_friction": {"from": 0.0, "to": 3e-4},
        "link.damping_ratio": {"from": 0.001, "to": 0.02},
    }
    time = np.arange(0.0, 0.06, 1e-4)
    entry = TRACE | {"output": "sensor 1.2", "sigma": 5e-4}
    write(tmp_path, "trace.csv", time=time, value=np.ones(len(time)))
    study = {"run": {"duration": 0.065}, "control": {"modes": 2, "feedback": "none"}}
    study |= {"motion": {"waypoints": SHORT["motion"]["waypoints"][:1]}}
    study |= {"metrics": {"residual_delay": 0.002, "residual_length": 0.05}}
    study |= {"initial": {"modal": [[20e-6, 0.0]] * 3}}
    problem = posed(spec_of(tmp_path, entry, free=free, study=study))
    (one,), truth = problem.measurements, np.array([7e-5, 0.006])
    exact, _ = one.predict(truth, False)
    start, end = (np.abs(exact[part]).max() for part in (slice(0, 90), slice(-90, None)))
    assert 12 < start / end < 40
    one.measured = exact + 5e-4 * np.random.default_rng(0).normal(size=len(time))
    answer = answered(problem)
    assert answer.is_explained
    assert np.all(np.abs(answer.values - truth) < 4 * answer.sigma)
    assert np.all(answer.sigma < 0.05 * truth)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"output": "accelerometer 2"}, "accelerometer LINK at X to ANGLE"),
        ({"output": "accelerometer 2 at 0.1 to 400"}, "angles of -360 to 360"),
        ({"output": "accelerometer 2 at 0.1", "quantity": "velocity"}, "quantity: has no meaning"),
        ({"output": "deflection 2 at 0.1 to 30"}, "deflection LINK at X"),
        ({"output": "motor 4"}, "links 1 to 3"),
        ({"input": "motor 1"}, "actuator LINK.PATCH"),
    ],
)
def test_what_is_no_instrument_is_refused(change, message, tmp_path):
    one = np.ones(len(FREQUENCY))
    write(tmp_path, "response.csv", frequency_hz=FREQUENCY, real=one, imag=one)
    with pytest.raises(StudyError, match=message):
        made(spec_of(tmp_path, ACCELEROMETER | change))


def test_commands_need_a_drive_without_forward_path(tmp_path):
    one = np.ones(len(FREQUENCY))
    write(tmp_path, "response.csv", frequency_hz=FREQUENCY, real=one, imag=one)
    study = {"drive": {"kind": "computed_torque"}}
    with pytest.raises(StudyError, match="known of drive.kind = 'pd' only"):
        made(spec_of(tmp_path, MOTOR, study=study))
    own = {"inputs": ["command"], "outputs": ["motor"]}
    with pytest.raises(StudyError, match="fit.next: command: known of drive.kind = 'pd' only"):
        made(spec_of(tmp_path, ACCELEROMETER, study=study, next=own))
    with pytest.raises(StudyError, match="sensor LINK.PATCH,.* slider LINK, motor LINK"):
        made(spec_of(tmp_path, TRACE | {"output": "accelerometer 1 at 0.1"}))


def test_names_of_instruments_read_back():
    for text in ("accelerometer 2 at 0.06 to 40", "accelerometer 1 at 0.1", "motor 3"):
        assert signal_name(parse_signal(text, OUTPUTS, 3, np.full(3, 0.2), "output")) == text
