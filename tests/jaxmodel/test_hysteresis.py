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
from jaxmodel.sampled_loop import sampled_plant
from jaxmodel.simulate import simulate
from studies.engine.run_data import chord_deflection
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.margin import hysteresis_text
from studies.study.spec import paper_study, parse_study
from studies.twin.compare import check_supported
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


run = jax.jit(simulate, static_argnums=(0, 2))
plant_of = jax.jit(sampled_plant, static_argnums=0)
prepared = jax.jit(prepare, static_argnums=0)


def arrays(study):
    return build_structure(study), as_arrays(build_case(study))


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


def quiet(study):
    structure, case = arrays(study)
    return structure._replace(has_noise=False), case


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
    ("electronics", "share", "within"),
    [
        ({}, 1.0, 1e-7),
        # plays that are used up within a step count from its start
        pytest.param({"amplifier_hz": 2e3}, 1.0, 4e-4, marks=pytest.mark.long),
        ({"amplifier_hz": 2e3, "delay": 1.375}, 0.375, 4e-4),
    ],
    ids=["plain", "amplifier", "amplifier, delay"],
)
def test_run_is_that_of_the_plant_behind_operators(electronics, share, within):
    """Links by a plant at eight times the rate, and the controller on what its sensors show."""
    structure, case = quiet(small(WIDTH, electronics=electronics))
    result = run(structure, case, True)
    record = jax.tree.map(np.asarray, result.record)
    assert int(result.status) in status.FINISHED
    command = record.actuator_voltage
    assert np.abs(command).max() > 0.95 * TINY
    fast = small(0.0, electronics={"sample_rate_hz": PARTS / PERIOD})
    plant = jax.tree.map(np.asarray, plant_of(*quiet(fast), POSE))
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
    found = run_study(small(WIDTH, electronics=electronics), True, has_loop=False)
    wanted = found.result.record.chord_deflection_stations
    at = found.study.metrics.stations.index(0.5)
    difference = chord_deflection(found) - wanted[:, :, at]
    assert np.abs(difference).max() < 1e-9 * np.abs(wanted).max()


@pytest.mark.parametrize(
    ("width", "limit"), [(WIDTH, 1.0), (0.0, 5e-3)], ids=["below the least play", "of no width"]
)
def test_without_effect_results_are_the_same(width, limit):
    structure, case = quiet(small(width, limit))
    with_it, without = (
        run(structure._replace(has_hysteresis=is_on), case) for is_on in (True, False)
    )
    moves = float(np.max(without.metrics.peak_voltage)) > PLAYS[0] * limit
    assert moves == (width == 0)
    for a, b in zip(jax.tree.leaves(with_it), jax.tree.leaves(without), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_it_costs_nothing_when_off():
    structure, case = arrays(paper_study())
    assert not structure.has_hysteresis
    assert jax.eval_shape(partial(prepare, structure), case).loop.hysteresis is None
    assert arrays(small(WIDTH))[0].has_hysteresis


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
    """By the loop's width and by a gain, in a run that opens the loops."""
    structure, case = quiet(small(0.1, 4e-3))
    structure = structure._replace(metrics=("residual_rms",))

    def residual(by):
        patches = case.machine.patches._replace(hysteresis=0.1 + by[0])
        control = case.control._replace(gain_factor=case.control.gain_factor * (1 + by[1]))
        machine = case.machine._replace(patches=patches)
        result = simulate(structure, case._replace(machine=machine, control=control))
        return 1e9 * jnp.sum(result.metrics.residual_rms)

    slope = np.asarray(jax.jit(jax.jacfwd(residual))(np.zeros(2)))
    function, step = jax.jit(residual), 1e-5 * np.eye(2)
    wanted = [(function(by) - function(-by)) / 2e-5 for by in step]
    assert np.all(np.abs(slope) > 1e-3)
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
