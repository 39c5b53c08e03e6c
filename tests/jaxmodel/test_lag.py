"""Motors that follow their commands late: poles, runs, responses, and what judges make of them."""

import jax
import numpy as np
import pytest

from jaxmodel.defaults import HOME
from jaxmodel.drive import late_response
from jaxmodel.linear import linearise, mass_and_stiffness, natural_modes
from jaxmodel.sampled_response import command_gain, controller_response, response_of_loop
from studies.engine.loop_gain import loop_gains
from studies.engine.margins import judge_loops
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.engine.runs import run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.study.window import _poles, settling_time
from studies.twin.compare import check_supported
from tests.bare import parse_study
from tests.jaxmodel.kept import arrays, loop_at, plant_at, prepared
from tests.jaxmodel.test_drives import MOVE, study_of

LAGS = {0.0: 0.477, 1e-3: 0.337, 2e-3: 0.054}
PD = np.array([[2e4, 60.0, 0.0], [0.0, 0.0, 0.0]])
_linearise = kept_jit(static_argnums=0)(linearise)
_matrices = kept_jit()(mass_and_stiffness)


def test_dead_time_by_its_approximant():
    s = 1j * np.linspace(0.01, 1.0, 50) / 1e-3
    np.testing.assert_allclose(late_response(s, 1e-3), np.exp(-1e-3 * s), rtol=2e-4)


def slowest(poles):
    """Damping ratio of the slowest oscillation."""
    swinging = poles[poles.imag > 1]
    pole = swinging[np.argmin(np.abs(swinging))]
    return -pole.real / np.abs(pole)


@pytest.mark.parametrize("lag", LAGS)
def test_damping_of_the_drive(lag):
    """Of a rigid mass that the default drive damps with 0.477: as exp(-s tau) has it, to 1e-4."""
    mass = (60 / 2 / 0.477) ** 2 / 2e4
    found = slowest(_poles(PD, 1 / mass, lag, 0.0))
    assert found == pytest.approx(LAGS[lag], abs=6e-4)
    s = 2 * np.pi * 60 * np.exp(1j * (np.pi / 2 + np.arcsin(found)))
    for _ in range(30):  # Newton's iteration on the true dead time
        late = np.exp(-s * lag)
        value = mass * s * s + (60 * s + 2e4) * late
        s -= value / (2 * mass * s + (60 - lag * (60 * s + 2e4)) * late)
    assert found == pytest.approx(-s.real / abs(s), abs=1e-4)


def parts(lag, **changes):
    structure, case = arrays(parse_study({"link": {"modes": 2}}).change(drive__lag=lag, **changes))
    structure = structure._replace(n_steps=1)
    return structure, case, prepared(structure, case).loop


@pytest.mark.parametrize(
    ("lag", "wanted"), [(2e-3, 0.054), pytest.param(1e-3, 0.337, marks=pytest.mark.long)]
)
def test_modes_of_the_flexible_machine_lose_as_much_and_its_run_decays_so(lag, wanted):
    structure, case, loop = parts(lag)
    plant = jax.tree.map(np.asarray, _linearise(structure, loop, np.array(HOME)))
    modes = natural_modes(plant)
    assert len(modes.frequency) == 9  # without those of the motors
    assert modes.damping_ratio[0] == pytest.approx(wanted, rel=0.03)
    prompt = parts(0.0)[2]
    for one, other in zip(
        _matrices(loop, np.array(HOME), plant),
        _matrices(prompt, np.array(HOME), _linearise(*parts(0.0)[::2], np.array(HOME))),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(other).max())
    kicked = parse_study(MOVE).change(
        drive__lag=lag,
        drive__pulse_force=(5.0, -2.5, -2.5),
        control__feedback="none",
        motion__waypoints=(HOME,),
        metrics__residual_delay=0.01,
        run__duration=0.1,
    )
    record = run_study(kicked, has_loop=False).result.record
    swing = np.asarray(record.pose)[15:, :2]
    swing = swing @ np.linalg.svd(swing, full_matrices=False)[2][0]
    inner = np.abs(swing[1:-1])
    peak = inner[(inner > np.abs(swing[:-2])) & (inner >= np.abs(swing[2:]))]
    drop = np.log(peak[0] / peak[2]) / (2 * np.pi)
    assert drop / np.hypot(1, drop) == pytest.approx(modes.damping_ratio[0], rel=0.02)


def test_frequency_responses_are_those_of_the_sampled_plant():
    structure, case, loop = parts(1e-3)
    response = jax.jit(response_of_loop, static_argnums=0)(structure, case, loop, np.array(HOME))
    plant = plant_at(structure, case, np.array(HOME))
    fast = loop_gains(jax.tree.map(lambda x: np.asarray(x)[None], response))
    gain = jax.jit(lambda omega: command_gain(response, omega))
    of_controller = jax.jit(lambda z: controller_response(response.controller, z))
    for omega in 2 * np.pi * np.array([40.0, 70.0, 115.0, 1200.0]):
        z = np.exp(1j * omega * np.asarray(case.electronics.period))
        seen = plant.leave @ np.linalg.solve(
            z * np.eye(len(plant.state)) - plant.state, plant.enter
        )
        wanted = -of_controller(z) @ seen
        size = np.abs(wanted).max()
        np.testing.assert_allclose(gain(omega), wanted, rtol=0, atol=1e-6 * size)
        np.testing.assert_allclose(
            fast.exact(np.array([[omega]]))[0, 0], gain(omega), rtol=0, atol=1e-9 * size
        )


def test_margins_of_a_batch_are_those_of_single_loops():
    structure, case, _ = parts(1e-3)
    cases = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 2), case)
    late = np.array([1e-3, 2e-3])
    found = judge_loops(structure, cases._replace(drive=cases.drive._replace(lag=late)))
    for margin, lag in zip(found.gain_margin, late, strict=True):
        own = case._replace(drive=case.drive._replace(lag=lag))
        one = loop_report(structure, own, np.array(HOME), structure.n_controlled)
        assert margin == pytest.approx(float(one.gain_margin), rel=1e-6)


def test_the_window_waits_and_what_does_not_know_it_says_so():
    times = [settling_time(parse_study(MOVE).change(drive__lag=lag)) for lag in LAGS]
    assert times[0] < times[1] < times[2]
    with pytest.raises(StudyError, match=r"drive.lag = 0.001; allowed: 0 for studies twin"):
        check_supported(study_of("pd", drive__lag=1e-3))
    with pytest.raises(StudyError, match=r"drive.lag = 1"):
        study_of("pd", drive__lag=1.0)
    with pytest.raises(StudyError, match=r"drive.lag = 0.1; allowed: a drive that settles"):
        check_run(study_of("pd", drive__lag=0.1, metrics__residual_delay="auto"))
    with pytest.raises(StudyError, match=r"drive.lag = 1e-09; allowed: 0, or 8.2e-07 or more"):
        check_run(study_of("pd", drive__lag=1e-9))


def test_a_loop_without_lag_has_no_states_for_it():
    without, late = (loop_at(*parts(lag)[:2], np.array(HOME)) for lag in (0.0, 1e-3))
    assert len(late.open) == len(without.open) + 9
    np.testing.assert_array_equal(without.motor, without.force)
