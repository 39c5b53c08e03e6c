"""Converters and one sample of the controller, number by number on made-up coefficients."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxmodel.channels import Channels
from jaxmodel.controller import (
    Controller,
    ControllerState,
    adc_code,
    controller_step,
    convert,
    read_back,
    with_gains,
)
from jaxmodel.estimator import Estimator, FilterState
from jaxmodel.simulate import _disturbance, _windows
from studies.study.cases import as_arrays, build_case, build_structure
from tests.studies.engine.test_batch import short_study

LINKS, PATCHES, CHANNELS = 3, 2, 2
GAIN, BIAS, STEP, TOP = 0.25, 1.5, 2.0**-6, 255


def controller(**changes):
    rng = np.random.default_rng(5)

    def random(*shape):
        return rng.normal(size=(LINKS, *shape))

    channels = Channels(
        filter=random(CHANNELS, PATCHES),
        estimator=Estimator(
            first=random(3, CHANNELS).swapaxes(0, 1),
            velocity=random(3, CHANNELS).swapaxes(0, 1),
            position=random(3, CHANNELS).swapaxes(0, 1),
            denominator=random(2, CHANNELS).swapaxes(0, 1),
            direct=random(CHANNELS),
        ),
        velocity_gain=random(CHANNELS),
        position_gain=random(CHANNELS),
        synthesizer=random(PATCHES, CHANNELS),
    )
    coefficients = {
        "feedthrough": 0.1 * random(PATCHES, PATCHES),
        "voltage_limit": 4.0,
        "adc_gain": GAIN,
        "adc_bias": BIAS,
        "adc_step": STEP,
        "adc_top": float(TOP),
        "adc_noise": 3 * STEP,
    }
    if "position_gain" in changes:
        channels = channels._replace(position_gain=changes.pop("position_gain"))
    return Controller(feedback=channels, **(coefficients | changes))


def at_code(code):
    """Sensor voltage that lies at a code, which need not be a whole number."""
    return np.zeros((LINKS, PATCHES)) + (np.asarray(code) * STEP - BIAS) / GAIN


# --- converters -----------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [0, 1, 2, 95, 96, 97, 128, 254, 255])
@pytest.mark.parametrize("off", [-0.49, 0.0, 0.49])
def test_the_nearest_code_is_read(code, off):
    found, is_clipped = adc_code(controller(), at_code(code + off), None)
    np.testing.assert_array_equal(found, code)
    np.testing.assert_array_equal(is_clipped, 0)
    measured, _ = convert(controller(), at_code(code + off), None, False)
    np.testing.assert_allclose(measured, at_code(code), rtol=1e-14)


@pytest.mark.parametrize(
    ("level", "code"), [(-0.51, 0), (-1.0, 0), (-100.0, 0), (255.51, 255), (256.0, 255), (1e4, 255)]
)
def test_beyond_the_ends_a_channel_clips(level, code):
    found, is_clipped = adc_code(controller(), at_code(level), None)
    np.testing.assert_array_equal(found, code)
    np.testing.assert_array_equal(is_clipped, 1)


def test_each_channel_clips_by_itself():
    voltage = at_code(10.0)
    voltage[1, 0], voltage[2, 1] = at_code(400.0)[0, 0], at_code(-5.0)[0, 0]
    found, is_clipped = adc_code(controller(), voltage, None)
    np.testing.assert_array_equal(is_clipped, [[0, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(found, [[10, 10], [255, 10], [10, 0]])


def test_noise_is_added_at_the_converter_s_input():
    """3 steps rms: 2 standard deviations are 6 codes."""
    noise = np.array([[0.0, 1.0], [2.0, -1.0], [-2.0, 0.5]])
    found, _ = adc_code(controller(), at_code(100.0), noise)
    np.testing.assert_array_equal(found, [[100, 103], [106, 97], [94, 102]])


def test_the_number_of_codes_is_that_of_the_bits():
    study = short_study(electronics__adc_bits=10, electronics__adc_range=2.5)
    electronics = build_case(study).electronics
    assert float(electronics.adc_levels) == 1024 and float(electronics.adc_range) == 2.5


def test_smooth_converters_have_the_noise_of_rounding():
    """Rounding a ramp has the variance step^2/12; to it comes that of the converter's own noise."""
    n = 40_000
    ramp = at_code(np.linspace(20.0, 200.0, n)[:, None, None])
    noise = np.random.default_rng(3).normal(size=(n, LINKS, PATCHES))
    for own in (0.0, 0.4 * STEP):
        one = controller(adc_noise=own)
        rounded, _ = convert(one, ramp, noise, False)
        smooth, is_clipped = convert(one, ramp, noise, True)
        wanted = (own**2 + STEP**2 / 12) / GAIN**2
        assert np.var(rounded - ramp) == pytest.approx(wanted, rel=0.02)
        assert np.var(smooth - ramp) == pytest.approx(wanted, rel=0.02)
        np.testing.assert_allclose(smooth - ramp, np.sqrt(wanted) * noise, atol=1e-12)
        assert not np.any(is_clipped)
    np.testing.assert_allclose(convert(one, ramp, None, True)[0], ramp, atol=1e-12)


def test_codes_are_read_back_as_voltages():
    np.testing.assert_allclose(read_back(controller(), np.array([0.0, 96.0])), [-6.0, 0.0])


# --- one sample -----------------------------------------------------------------------------------


def by_hand(one, state, measured):
    """Next state and command by the difference equations, channel by channel."""
    first, second = np.zeros((LINKS, CHANNELS)), np.zeros((LINKS, CHANNELS))
    command = np.zeros((LINKS, PATCHES))
    law, memory = one.feedback, state.feedback
    b0, b1, a1 = law.estimator.first
    for i in range(LINKS):
        seen = measured[i] - one.feedthrough[i] @ state.voltage[i]
        force = np.zeros(CHANNELS)
        for j in range(CHANNELS):
            channel = law.filter[i, j] @ seen
            high = b0[i, j] * channel + memory.first[i, j]
            past = [x[i, j] for x in memory.second]
            newest = high - sum(
                d[i, j] * x for d, x in zip(law.estimator.denominator, past, strict=True)
            )
            line = [newest, *past]
            rate, value = (
                sum(n[i, j] * x for n, x in zip(numerator, line, strict=True))
                for numerator in (law.estimator.velocity, law.estimator.position)
            )
            value += law.estimator.direct[i, j] * channel
            force[j] = -law.velocity_gain[i, j] * rate
            if law.position_gain is not None:
                force[j] -= law.position_gain[i, j] * value
            first[i, j], second[i, j] = b1[i, j] * channel - a1[i, j] * high, newest
        command[i] = np.clip(law.synthesizer[i] @ force, -one.voltage_limit, one.voltage_limit)
    return ControllerState(FilterState(first, (second, memory.second[0])), command)


@pytest.mark.parametrize("changes", [{}, {"position_gain": None}, {"voltage_limit": 0.3}])
def test_a_sample_is_the_difference_equations(changes):
    one, rng = controller(**changes), np.random.default_rng(8)
    size = LINKS, CHANNELS
    state = ControllerState(
        FilterState(rng.normal(size=size), (rng.normal(size=size), rng.normal(size=size))),
        rng.normal(size=(LINKS, PATCHES)),
    )
    at_limit = 0
    for _ in range(3):
        voltage = at_code(rng.uniform(80, 110, (LINKS, PATCHES)))
        measured = (np.rint((GAIN * voltage + BIAS) / STEP) * STEP - BIAS) / GAIN
        after, info = controller_step(one, state, voltage)
        wanted = by_hand(one, state, measured)
        np.testing.assert_allclose(info.measured, measured, rtol=1e-12)
        np.testing.assert_allclose(info.command, wanted.voltage, rtol=1e-10)
        kept = zip(*map(jax.tree.leaves, (after.feedback, wanted.feedback)), strict=True)
        for found, right in kept:
            np.testing.assert_allclose(found, right, rtol=1e-10)
        np.testing.assert_array_equal(after.voltage, info.command)
        at_limit += np.sum(np.abs(wanted.voltage) == one.voltage_limit)
        state = wanted
    assert at_limit > 0 or "voltage_limit" not in changes


def test_a_factor_scales_every_gain():
    one = with_gains(controller(), 0.25)
    np.testing.assert_allclose(
        one.feedback.velocity_gain, 0.25 * controller().feedback.velocity_gain
    )
    np.testing.assert_allclose(
        one.feedback.position_gain, 0.25 * controller().feedback.position_gain
    )


# --- noise and windows ----------------------------------------------------------------------------


def disturbance(**changes):
    """(noise of the converters, force on the sliders) of a case."""
    study = short_study(run__duration=0.4, **changes)
    structure, case = build_structure(study), as_arrays(build_case(study))
    prepared = SimpleNamespace(loop=SimpleNamespace(drive=case.drive))
    found = _disturbance(structure, case, prepared, 1e-4 * np.arange(structure.n_steps))
    return tuple(map(np.asarray, found))


def test_ripple_and_converter_noise_are_independent():
    noise, force = disturbance(electronics__adc_noise=1e-3, drive__ripple=2.0)
    assert noise.shape == (4000, 3, 3) and force.shape == (4000, 3)
    assert force.std() == pytest.approx(2.0, rel=0.03) and noise.std() == pytest.approx(1, rel=0.03)
    signals = np.concatenate([noise.reshape(4000, 9), force], axis=1)
    correlation = np.corrcoef(signals.T) - np.eye(12)
    assert np.abs(correlation).max() < 5 / np.sqrt(4000)
    # nor is one drawn in the other's order
    flat = noise.ravel()[: force.size]
    assert abs(np.corrcoef(flat, force.ravel())[0, 1]) < 5 / np.sqrt(force.size)


def test_noise_belongs_to_the_seed():
    changes = {"electronics__adc_noise": 1e-3, "drive__ripple": 1.0}
    one, same, other = (disturbance(run__seed=seed, **changes) for seed in (1, 1, 2))
    for a, b, c in zip(one, same, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 0.05


def test_the_pulse_comes_on_top_of_the_ripple():
    pulse = {
        "drive__pulse_force": (1.0, -2.0, 3.0),
        "drive__pulse_start": 0.1,
        "drive__pulse_length": 0.002,
    }
    alone, both = disturbance(**pulse)[1], disturbance(drive__ripple=1.0, **pulse)[1]
    ripple = disturbance(drive__ripple=1.0)[1]
    np.testing.assert_allclose(alone.sum(axis=0) * 1e-4, 0.002 * np.array([1, -2, 3]), rtol=1e-9)
    assert np.flatnonzero(alone[:, 0] > 1e-9)[[0, -1]].tolist() == [1000, 1019]
    np.testing.assert_allclose(both, alone + ripple, atol=1e-12)


@pytest.mark.parametrize("first", range(100, 130))
def test_windows_have_whole_numbers_of_samples(first):
    """However the ends round: `first` samples of moving, 7 of rest, 20 of the residual window."""
    study = short_study(metrics__residual_delay=7e-4, metrics__residual_length=2e-3)
    structure, case = build_structure(study), as_arrays(build_case(study))
    period = 1e-4
    for end in (first * period, (first / 3) * (3 * period), first * period * (1 + 1e-12)):
        window = _windows(structure, case, period * np.arange(structure.n_steps), end)
        assert window.is_moving.sum() == first and np.all(window.is_moving[:first] == 1)
        np.testing.assert_array_equal(np.flatnonzero(window.is_residual), first + 7 + np.arange(20))
        after = np.asarray(window.after_command)
        wanted = np.maximum(period * np.arange(-first, structure.n_steps - first), 0)
        np.testing.assert_allclose(after, wanted, atol=1e-9)
        assert np.count_nonzero(after) == len(after) - first - 1  # no rounding error as a time
