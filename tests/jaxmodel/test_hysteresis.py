"""Hysteresis of the actuators near their voltage limit."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.controller import controller_step, rest_controller
from jaxmodel.hysteresis import (
    PLAYS,
    added_voltage,
    advance_plays,
    design_hysteresis,
    slope_at_limit,
)
from jaxmodel.prepare import prepare
from jaxmodel.simulate import simulate
from studies.engine.run_data import chord_deflection
from studies.engine.runs import Run
from studies.errors import StudyError
from studies.study.margin import hysteresis_text
from studies.twin.compare import check_supported
from tests.bare import paper_study, parse_study
from tests.jaxmodel.kept import arrays, plant_at, prepared, simulated
from tests.jaxmodel.test_notch import NOTCHES
from tests.jaxmodel.test_onset import BASE, HOME
from tests.studies.kernels.test_kernel import both, check_equal
from tests.sweeps import small_spec

WIDTH, LIMIT = 0.15, 80.0
POSE, PERIOD, PARTS = np.array(HOME), 1e-4, 8
#: Deflections so small that the machine is linear, and a limit as small.
TINY = 1e-3


def dragged(voltage, play):
    """A play operator by its definition: v pushes y once it is `play` away from it."""
    y, found = 0.0, []
    for v in voltage:
        if v - y > play:
            y = v - play
        elif y - v > play:
            y = v + play
        found.append(y)
    return np.array(found)


def acting(voltage, limit, weight):
    """By which voltage an actuator acts [V], (n,)."""
    return voltage + weight * sum(dragged(voltage, x * limit) for x in PLAYS)


def weight_of(width):
    return float(design_hysteresis(width, 1.0).weight)


def test_long_moves_are_exact():
    """Any voltages one after the other are as good as the same ones reached in small steps."""
    turns = np.concatenate([[0.0], np.random.default_rng(0).uniform(-LIMIT, LIMIT, 60)])
    fine = np.interp(np.arange(60 * 50 + 1) / 50, np.arange(61), turns)
    wanted = acting(fine, LIMIT, weight_of(WIDTH))[::50]
    operators = design_hysteresis(WIDTH, LIMIT)
    plays, found = jnp.zeros((len(PLAYS), 1, 1)), []
    for v in turns:
        plays = advance_plays(operators, plays, jnp.full((1, 1), v))
        found.append(v + float(added_voltage(operators, plays)[0, 0]))
    np.testing.assert_allclose(found, wanted, atol=1e-11)


@pytest.mark.parametrize("width", [0.05, 0.15, 0.3])
def test_loop_of_a_full_cycle(width):
    """Width as asked; area that of the parallelograms, 4 w r (limit - r) each; first slope 1."""
    n = 4000
    rise = np.linspace(-LIMIT, LIMIT, 2 * n + 1)
    force = acting(np.concatenate([rise[n:], rise[-2::-1], rise[1:]]), LIMIT, weight_of(width))
    inside = np.abs(rise[n:]) <= PLAYS[0] * LIMIT
    np.testing.assert_array_equal(force[: n + 1][inside], rise[n:][inside])
    down, up = force[n : 3 * n + 1][::-1], force[3 * n :]
    assert (down - up).max() / np.ptp(up) == pytest.approx(width, rel=1e-9)
    wanted = weight_of(width) * sum(4 * x * (1 - x) for x in PLAYS) * LIMIT**2
    assert np.trapezoid(down - up, rise) == pytest.approx(wanted, rel=1e-6)
    assert np.ptp(up) / (2 * LIMIT) == pytest.approx(slope_at_limit(width), rel=1e-9)


def small(width, limit=TINY, electronics=None, **sections):
    own = {**BASE["electronics"], "voltage_limit": limit, **(electronics or {})}
    return parse_study(
        {
            **BASE,
            "link": {"modes": 2},
            "run": {"duration": 0.015, "smooth": True},
            "initial": {"load_deflection": (4e-9, 2e-9, -4e-9)},
            "metrics": {"residual_delay": 0.0, "residual_length": 0.01},
            "patches": {"hysteresis": width},
            "electronics": own,
            **sections,
        }
    )


def quiet(study, has_all=True):
    """Of one program, with amplifiers and delays, or of one that has what the study has."""
    structure, case = arrays(study)
    electronics = {"has_amplifier": True, "has_delay": True} if has_all else {}
    return structure._replace(has_noise=False, **electronics), case


def acting_course(command, lag, share):
    """Mean acting voltage over eighths of the samples, with exact amplifiers, (n, PARTS, 3, 3).

    Commands change at a share of each sample to that of the next one.
    """
    fine = 32 * PARTS
    v, course = np.zeros(command.shape[1:]), []
    left = np.exp(-PERIOD / fine / lag) if lag > 0 else 0.0
    for k, part in np.ndindex(len(command) - 1, fine):
        change = v - command[k + (part >= share * fine)]
        course.append(v - change + np.sqrt(left) * change)
        v = v - change + left * change
    acts = np.array(course)
    for i, j in np.ndindex(3, 3):
        acts[:, i, j] = acting(acts[:, i, j], TINY, weight_of(WIDTH))
    return acts.reshape(-1, PARTS, fine // PARTS, 3, 3).mean(axis=2)


@pytest.mark.parametrize(
    ("electronics", "has_all", "share", "within"),
    [
        pytest.param({}, False, 1.0, 1e-7, marks=pytest.mark.long),
        # plays that are used up within a step count from its start
        ({}, True, 1.0, 2e-5),
        pytest.param({"amplifier_hz": 2e3}, False, 1.0, 4e-4, marks=pytest.mark.long),
        ({"amplifier_hz": 2e3, "delay": 1.375}, True, 0.375, 4e-4),
    ],
    ids=["plain", "plain among others", "amplifier", "amplifier, delay"],
)
def test_run_is_that_of_the_plant_behind_operators(electronics, has_all, share, within):
    """Links by a plant at eight times the rate, and the controller on what its sensors show."""
    structure, case = quiet(small(WIDTH, electronics=electronics), has_all)
    result = simulated(structure, case, True)
    record = jax.tree.map(np.asarray, result.record)
    assert int(result.status) in status.FINISHED
    command = record.actuator_voltage
    assert np.abs(command).max() > 0.95 * TINY
    fast = small(0.0, electronics={"sample_rate_hz": PARTS / PERIOD})
    plant = jax.tree.map(np.asarray, plant_at(*quiet(fast), POSE))
    lag = float(case.electronics.amplifier_lag)
    volts = acting_course(command, lag, share).reshape(-1, PARTS, 9)
    z, n = np.zeros(len(plant.state)), 3 * structure.n_modes
    z[6 : 6 + n] = record.modal_coordinate[0].ravel()
    z[6 + 2 * n : 6 + 2 * n + 9] = record.sensor_voltage[0].ravel()
    q, seen = [], []
    for eighths in volts:
        q.append(z[6 : 6 + n])
        seen.append(plant.leave @ z)
        for held in eighths:
            z[-9:] = held
            z = plant.state @ z
            z[-9:] = held
    q, found = np.array(q), record.modal_coordinate[:-1].reshape(len(q), -1)
    np.testing.assert_allclose(found, q, rtol=0, atol=within * np.abs(q).max())
    controller = prepared(structure, case).loop.controller

    def sample(before, voltage):
        after, _ = controller_step(controller, before, voltage, None, True)
        return after, before.voltage

    _, wanted = jax.lax.scan(sample, rest_controller(controller), np.reshape(seen, (-1, 3, 3)))
    wanted = np.asarray(wanted)[: len(wanted) - (share < 1)]  # a sample later still
    np.testing.assert_allclose(command[share < 1 : -1], wanted, rtol=0, atol=10 * within * TINY)


def test_deflection_along_the_links_is_that_of_the_run():
    """What the voltages add at mid-span, from the commands of a run that is saved."""
    electronics = {"amplifier_hz": 2e3, "delay": 1.375}
    study = small(WIDTH, electronics=electronics)
    structure, case = quiet(study)
    result = jax.tree.map(np.asarray, simulated(structure, case, True))
    found = Run(study, structure, case, result, int(result.status))
    wanted = result.record.chord_deflection_stations
    at = found.study.metrics.stations.index(0.5)
    difference = chord_deflection(found) - wanted[:, :, at]
    assert np.abs(difference).max() < 1e-9 * np.abs(wanted).max()


def test_without_effect_results_are_the_same():
    """Without width, or below the least play; what a run is that has neither is tested above."""
    structure, _ = quiet(small(WIDTH))
    plain, wide, moving = (
        simulated(structure, quiet(small(*numbers))[1], True)
        for numbers in ((0.0, 1.0), (WIDTH, 1.0), (0.0, 5e-3))
    )
    assert PLAYS[0] * 5e-3 < float(np.max(plain.metrics.peak_voltage)) < 5e-3
    for other in (wide, moving):
        parts = (x._replace(record=None) for x in (other, plain))
        for a, b in zip(*map(jax.tree.leaves, parts), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.long  # in short: above
@pytest.mark.parametrize(
    ("width", "limit"), [(WIDTH, 1.0), (0.0, 5e-3)], ids=["below the least play", "of no width"]
)
def test_it_is_the_same_to_have_none(width, limit):
    structure, case = quiet(small(width, limit))
    with_it, without = (
        simulated(structure._replace(has_hysteresis=is_on), case, True)._replace(record=None)
        for is_on in (True, False)
    )
    for a, b in zip(jax.tree.leaves(with_it), jax.tree.leaves(without), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_it_costs_nothing_when_off():
    structure, case = arrays(paper_study())
    assert not structure.has_hysteresis
    assert jax.eval_shape(partial(prepare, structure), case).loop.hysteresis is None
    assert arrays(small(WIDTH))[0].has_hysteresis


@pytest.mark.long  # in short: all operations of a loop, in test_delay
def test_kernel_equals_scan():
    axes = {
        "patches.hysteresis": [0.0, 0.1, 0.2],
        "electronics.voltage_limit": {"from": 0.05, "to": 0.5},
        "electronics.amplifier_hz": [0.0, 2e3],
        "electronics.delay": [0.0, 1.0, 1.625],
        "drive.kp": {"from": 1e4, "to": 2e4},
    }
    sweep = {"method": "random", "count": 16, "axes": axes}
    windows = {"residual_delay": 0.0, "residual_length": 0.01, "saturation_limit": 1.0}
    fast, reference = both(small_spec(sweep, link={"modes": 2}, metrics=windows))
    assert np.sum(reference.status == status.OK) >= 8
    assert np.mean(reference.metrics.saturated_fraction > 0) > 0.5
    check_equal(fast, reference)


def test_slopes_of_a_run_are_those_of_differences():
    """By the loop's width, the gain, a notch filter and LQG's weights; the loops are open."""
    control = {"law": "lqg", "modes": 2, **NOTCHES, "notch_hz": [300.0, 0.0, 2900.0]}
    bent = {"load_deflection": (4e-6, 2e-6, -4e-6)}
    structure, case = quiet(small(0.1, 1.0, control=control, initial=bent), has_all=False)
    structure = structure._replace(metrics=("residual_rms", "peak_voltage"))
    notch = ("notch", "notch_depth", "notch_width")
    weights = ("voltage_weight", "disturbance", "sensor_noise", "bending_hz")
    assert all(getattr(case.control, name)[0] > 0 for name in notch)

    def residual(by):
        """Width and gain, shares of the notch of link 1, logarithms of the weights."""
        control, patches = case.control, case.machine.patches
        patches = patches._replace(hysteresis=0.1 + by[0])
        filters = {
            name: jnp.asarray(getattr(control, name)).at[0].multiply(1 + by[k])
            for k, name in enumerate(notch, 2)
        }
        own = {name: control.parameters[name] * jnp.exp(by[k]) for k, name in enumerate(weights, 5)}
        control = control._replace(
            gain_factor=control.gain_factor * (1 + by[1]),
            parameters=control.parameters | own,
            **filters,
        )
        machine = case.machine._replace(patches=patches)
        found = simulate(structure, case._replace(machine=machine, control=control)).metrics
        value = 1e6 * jnp.sum(found.residual_rms)
        return value, (value, found.peak_voltage)

    both = jax.jit(jax.jacfwd(residual, has_aux=True))  # one program for both
    slope, (_, peak) = both(np.zeros(9))
    assert 0.5 < np.max(peak) < 1 and np.all(np.abs(slope) > 1e-2)
    wanted = [(both(by)[1][0] - both(-by)[1][0]) / 6e-5 for by in 3e-5 * np.eye(9)]
    np.testing.assert_allclose(slope, wanted, rtol=1e-4)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"patches": {"hysteresis": 0.5}}, r"patches.hysteresis = 0.5.*<= 0.3"),
        (
            {"patches": {"hysteresis": 0.1}, "control": {"feedback": "ideal"}},
            r"patches.hysteresis = 0.1.*0 where control.feedback = 'ideal'",
        ),
    ],
)
def test_faults_are_said(sections, message):
    with pytest.raises(StudyError, match=message):
        parse_study(sections)


def test_the_twin_says_that_it_has_none():
    with pytest.raises(StudyError, match="patches.hysteresis = 0.1.*0 for studies twin"):
        check_supported(parse_study({"patches": {"hysteresis": 0.1}}))


def test_a_run_says_that_margins_are_of_small_signals():
    assert hysteresis_text(0.0) == ""
    assert "below 0.125 of electronics.voltage_limit" in hysteresis_text(WIDTH)
    assert "up to 1.43 times as hard" in hysteresis_text(WIDTH)
