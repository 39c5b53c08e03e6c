"""Every metric by its definition, recomputed with NumPy and SciPy; nothing here calls its formula.

On made-up signals, which tell every formula from its neighbours, and on a run whose motors,
actuators and converters meet their limits, which ties them to the loop's signals and windows.
"""

from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import scipy.signal

from jaxmodel import status
from jaxmodel.axial import stretch_error
from jaxmodel.bases import find_bases
from jaxmodel.loop import _reference, plant_rates, step
from jaxmodel.metrics import (
    METRICS,
    Ending,
    Fixed,
    Instant,
    Sample,
    Sizes,
    Window,
    accumulate,
    finish,
    zero_totals,
)
from jaxmodel.prepare import spectrum_frequencies
from jaxmodel.simulate import begin, conclude
from studies.study.cases import as_arrays, build_case, build_structure
from tests.studies.engine.test_batch import short_study

#: Unit of each metric, and its axes.
LABELS = {
    "residual_rms": ("m", "link station"),
    "residual_peak": ("m", "link station"),
    "structural_rms": ("m", "link station"),
    "structural_peak": ("m", "link station"),
    "residual_modal_rms": ("m", "link mode"),
    "residual_modal_peak": ("m", "link mode"),
    "structural_modal_rms": ("m", "link mode"),
    "settling_time": ("s", "link"),
    "ringing_time": ("s", "link"),
    "pose_error_peak": ("m; m; rad", "pose_axis"),
    "pose_error_rms": ("m; m; rad", "pose_axis"),
    "peak_voltage": ("V", "link"),
    "saturated_fraction": ("1", ""),
    "clipped_fraction": ("1", ""),
    "control_energy": ("V2 s", ""),
    "peak_force": ("N", "slider_axis"),
    "motor_saturated_fraction": ("1", ""),
    "peak_tension": ("N", "link"),
    "peak_compression": ("N", "link"),
    "stretch_error_peak": ("m; m; rad", "pose_axis"),
    "patch_strain_peak": ("1", "link"),
    "plant_energy": ("m2/s2", "link mode"),
    "modal_energy": ("m2/s2", "link controlled_mode"),
    "spectral_density": ("m2/Hz", "link controlled_mode spectrum_point"),
    "energy_ratio": ("1", "link controlled_mode"),
}


def by_definition(run):
    """All metrics of signals in time: metric by name.

    run: `time`, `end` of the command, `delay`, `length` of the residual window, `band`, `omega`,
    `modal_omega`, `frequency` of the spectra [Hz], and signals with time as first axis.
    """
    after, period = run.time - run.end, run.time[1] - run.time[0]
    moving = after < -period / 2
    begins = after > run.delay - period / 2
    residual = begins & (after < run.delay + run.length - period / 2)
    assert 0 < moving.sum() < moving.size and 0 < residual.sum() < residual.size - moving.sum()

    def rms(signal, window):
        return np.sqrt(np.mean(signal[window] ** 2, axis=0))

    def peak(signal, window=slice(None)):
        return np.abs(signal[window]).max(axis=0)

    def energy(value, rate, omega):
        return np.mean((omega * value[moving]) ** 2 + rate[moving] ** 2, axis=0)

    widest = np.abs(run.deflection).max(axis=2)
    late, modal_energy = after > 0, energy(run.modal, run.modal_rate, run.modal_omega)
    outside = late[:, None] & (widest > run.band)
    relative = (widest[late] / run.band) ** 2
    return {
        "residual_rms": rms(run.deflection, residual),
        "residual_peak": peak(run.deflection, residual),
        "structural_rms": rms(run.deflection, moving),
        "structural_peak": peak(run.deflection, moving),
        "residual_modal_rms": rms(run.q, residual),
        "residual_modal_peak": peak(run.q, residual),
        "structural_modal_rms": rms(run.q, moving),
        "settling_time": np.max(outside * after[:, None], axis=0),
        "ringing_time": period * np.sum(relative / (1 + relative), axis=0),
        "pose_error_peak": peak(run.pose_error, moving),
        "pose_error_rms": rms(run.pose_error, residual),
        "peak_voltage": peak(run.voltage).max(axis=1),
        "saturated_fraction": run.is_saturated.mean(),
        "clipped_fraction": run.is_clipped.mean(),
        "control_energy": period * np.sum(run.voltage**2),
        "peak_force": peak(run.motor_force),
        "motor_saturated_fraction": run.is_motor_saturated.mean(),
        "peak_tension": np.maximum(run.axial_force.max(axis=0), 0),
        "peak_compression": np.maximum((-run.axial_force).max(axis=0), 0),
        "stretch_error_peak": peak(run.stretch_error),
        "patch_strain_peak": peak(run.strain).max(axis=1),
        "plant_energy": energy(run.q, run.q_rate, run.omega),
        "modal_energy": modal_energy,
        "spectral_density": periodogram(run.modal, 1 / period, run.frequency),
        "energy_ratio": modal_energy
        / modal_energy[:, :1]
        * (run.modal_omega[:, :1] / run.modal_omega),
    }


def periodogram(signal, rate, frequency):
    """One-sided Hann periodogram of (n, 3, C) at (3, C, F) Hz, padded to a fine grid."""
    n = max(2**19, len(signal))
    padded = np.zeros((n, *signal.shape[1:]))
    padded[: len(signal)] = signal * scipy.signal.get_window("hann", len(signal))[:, None, None]
    scale = n / np.sum(scipy.signal.get_window("hann", len(signal)) ** 2)
    grid, density = scipy.signal.periodogram(padded, rate, "boxcar", detrend=False, axis=0)
    return scale * np.array(
        [
            [np.interp(frequency[i, j], grid, density[:, i, j]) for j in range(signal.shape[2])]
            for i in range(signal.shape[1])
        ]
    )


def assert_same(found, wanted, rtol):
    """Relative to the largest entry of a row, for the notches of spectra."""
    assert set(found) == set(wanted) == set(LABELS)
    for name, value in wanted.items():
        assert np.all(np.isfinite(value)), name
        size = np.abs(np.atleast_1d(value)).max(axis=-1, keepdims=True)
        assert np.shape(found[name]) == np.shape(value), name
        assert np.all(np.abs(found[name] - value) <= rtol * size), name


def test_the_table_of_metrics_has_these_units_and_axes():
    known = {name: (x.unit, " ".join(x.dims)) for name, x in METRICS.items()}
    assert {name: known[name] for name in LABELS} == LABELS


# --- made-up signals ------------------------------------------------------------------------------

N, PERIOD = 64, 2e-3
SIZES = Sizes(n_stations=2, n_modes=3, n_controlled=2, n_frequencies=2, n_links=3, n_pose=3)


def made_up(seed):
    """Signals of random numbers, of another size for each link."""
    rng = np.random.default_rng(seed)
    size = np.array([1.0, 0.3, 2.0])

    def signal(*shape):
        one = rng.normal(size=(N, 3, *shape))
        return one * size.reshape(1, 3, *[1] * len(shape))

    def flags():
        return (rng.random(N) < rng.uniform(0.2, 0.8)).astype(float)

    time = PERIOD * np.arange(N)
    deflection = signal(2) * np.exp(-time / 0.02)[:, None, None]
    bins = rng.choice(np.arange(3, N // 2), (3, 2, 2), replace=False)
    return SimpleNamespace(
        time=time,
        end=20.6 * PERIOD,
        delay=8 * PERIOD,
        length=20 * PERIOD,
        band=0.2,
        omega=rng.uniform(0.5, 3, (3, 3)),
        modal_omega=rng.uniform(0.5, 3, (3, 2)),
        frequency=bins / (N * PERIOD),
        deflection=deflection,
        q=signal(3),
        q_rate=signal(3),
        modal=signal(2),
        modal_rate=signal(2),
        pose_error=signal(),
        voltage=signal(4),
        is_saturated=flags(),
        is_clipped=flags(),
        motor_force=signal() - 0.5,
        is_motor_saturated=flags(),
        axial_force=signal() + np.array([0.5, -0.2, 0.0]),
        stretch_error=signal(),
        strain=signal(6),
    )


def accumulated(run, wanted=()):
    """All metrics of made-up signals by the code."""
    after = run.time - run.end
    window = Window(
        time=run.time,
        is_moving=(after < 0) * 1.0,
        is_residual=((after >= run.delay) & (after < run.delay + run.length)) * 1.0,
        after_command=np.maximum(after, 0.0),
        taper=scipy.signal.get_window("hann", N),
    )
    angle = 2 * np.pi * PERIOD * run.frequency
    rotation = np.cos(angle), np.sin(angle)
    fixed = Fixed(run.omega, run.modal_omega, rotation, run.band)
    sample = Sample(**{name: getattr(run, name) for name in Sample._fields})

    def body(totals, at):
        return accumulate(totals, Instant(*at, fixed)), None

    start = zero_totals(SIZES, float, wanted)
    totals, _ = jax.lax.scan(body, start, (sample, window))
    return finish(totals, Ending(PERIOD, run.modal_omega))


@pytest.mark.parametrize("seed", range(3))
def test_metrics_of_made_up_signals(seed):
    run = made_up(seed)
    assert_same(accumulated(run), by_definition(run), rtol=1e-10)


def test_spectral_density_is_that_of_scipy():
    """At its own frequencies, without padding; a sine of amplitude a has density a^2/2 over 3/2 N T
    at its frequency."""
    run = made_up(0)
    sine = np.sin(2 * np.pi * run.time * 8 / (N * PERIOD))
    run.modal = 0.7 * sine[:, None, None] * np.ones((1, 3, 2))
    run.frequency = np.full((3, 2, 2), 8 / (N * PERIOD))
    found = np.asarray(accumulated(run)["spectral_density"])
    grid, density = scipy.signal.periodogram(
        run.modal, 1 / PERIOD, "hann", detrend=False, axis=0, scaling="density"
    )
    assert grid[8] == pytest.approx(run.frequency[0, 0, 0])
    np.testing.assert_allclose(found, np.broadcast_to(density[8, :, :, None], found.shape))
    np.testing.assert_allclose(found, 0.7**2 / 2 * N * PERIOD / 1.5)


def test_spectra_are_taken_within_a_tenth_of_the_plant_s_frequencies():
    bases = SimpleNamespace(plant_omega=2 * np.pi * np.array([[100.0, 400.0]]))
    found = spectrum_frequencies(SimpleNamespace(n_frequencies=5), bases)
    np.testing.assert_allclose(found[0, 0], [90, 95, 100, 105, 110], rtol=1e-12)
    np.testing.assert_allclose(found[0, 1], 4 * found[0, 0], rtol=1e-12)


def test_what_never_happens_is_zero():
    """Tension of a link that is only compressed, the settling of one that never left the band."""
    run = made_up(1)
    run.axial_force = -np.abs(run.axial_force) - 0.1
    run.deflection, run.voltage = 0 * run.deflection, 0 * run.voltage
    found = accumulated(run)
    names = "peak_tension", "settling_time", "ringing_time", "residual_rms", "control_energy"
    for name in names:
        assert not np.any(found[name]), name
    assert np.all(found["peak_compression"] > 0)


def test_a_program_accumulates_what_it_is_asked_for():
    """And what the status needs; with the same values."""
    run = made_up(2)
    few, every = accumulated(run, ("plant_energy",)), accumulated(run)
    assert set(few) == {
        "plant_energy",
        "saturated_fraction",
        "clipped_fraction",
        "motor_saturated_fraction",
        "pose_error_rms",
        "peak_compression",
    }
    for name, value in few.items():
        np.testing.assert_array_equal(value, every[name], err_msg=name)


def test_equal_ratios_where_mode_1_is_quiet():
    run = made_up(0)
    for signal in (run.modal, run.modal_rate):
        signal[:, 1, 0] = 0
    ratio = np.asarray(accumulated(run)["energy_ratio"])
    np.testing.assert_array_equal(ratio[1], 1)
    assert np.all(ratio[[0, 2], 1] != 1)


# --- a run ----------------------------------------------------------------------------------------


@jax.jit
def signals_at(loop, plant, inputs, voltage):
    """What the metrics read and trajectories do not hold."""
    rates = plant_rates(STRUCTURE, loop, plant, _reference(inputs, 0, None), voltage)
    axial = rates.acceleration.axial
    return axial, stretch_error(rates.chain, loop.axial_compliance * axial)


@partial(jax.jit, static_argnums=0)
def watched(structure, case):
    """A run with its constants, and its signals at every sample."""
    start = begin(structure, case)

    def body(state, inputs):
        after, record = step(structure, start.loop, state, inputs)
        signals = signals_at(start.loop, state.plant, inputs, state.controller.voltage)
        return after, (record, state.plant, *signals)

    last, signals = jax.lax.scan(body, start.state, start.inputs)
    frequency = spectrum_frequencies(structure, find_bases(structure, case))
    return conclude(start.outline, start.state.status, last), start.loop, frequency, signals


STUDY = short_study(
    link__modes=2,
    control__modes=2,
    control__velocity_gain=(6.0, 4.0, 5.0),
    control__gain_factor=1.0,
    motion__waypoints=((0.0, 0.0, np.pi / 6), (0.004, 0.005, np.pi / 6)),
    motion__move_time=0.02,
    shaper__kind="none",
    electronics__voltage_limit=40.0,
    electronics__adc_range=2.0,
    electronics__conditioner_bias=1.1,
    electronics__conditioner_gain=0.3,
    drive__force_limit=30.0,
    metrics__residual_delay=0.004,
    metrics__residual_length=0.012,
    metrics__settling_band=8e-5,
    metrics__saturation_limit=1.0,
    metrics__arrival_tolerance=1.0,
)
STRUCTURE = build_structure(STUDY)


def strain_of_sines(study, run):
    """On the faces of a bare link's patches, by its sines and the exact rest, (n, 3, K).

    An actuator bends the link by V lambda_a/(E I) between its own ends, of which two sines have
    some; ceramics are curved like the link, and further out.
    """
    beam, patches = study.link, study.patches
    center, thick = np.array(patches.centers), patches.thickness
    wave = np.arange(1, beam.modes + 1) * np.pi / beam.length

    def slopes(size):
        at = center[:, None] + np.array([-size, size]) / 2
        return np.diff(wave * np.cos(wave * at[..., None]), axis=1)[:, 0]

    seen, driven = slopes(patches.sensor_length), slopes(patches.actuator_length)
    softness = 12 / (beam.youngs_modulus * beam.width * beam.thickness**3)
    core, skin = (one.youngs_modulus * one.width * one.thickness for one in (beam, patches))
    push = patches.width * patches.youngs_modulus * abs(patches.d31)
    moment = push * (beam.thickness + thick) / 2 * core / (core + skin)
    compliance = softness * 2 / beam.length / wave**4
    rest = patches.sensor_length * softness * np.eye(len(center)) - seen * compliance @ driven.T
    turned = run.modal_coordinate @ seen.T + run.actuator_voltage @ (moment * rest).T
    return (beam.thickness / 2 + thick) * turned / patches.sensor_length


@pytest.fixture(scope="module")
def limited():
    """Metrics of the run, and its signals."""
    case = as_arrays(build_case(STUDY))
    found = jax.tree.map(np.asarray, watched(STRUCTURE, case))
    result, loop, frequency, (record, plant, axial, stretch) = found
    assert result.status == status.OK
    electronics, code = STUDY.electronics, STUDY.electronics.adc_range / 2**12
    seen = np.einsum("ikr,tir->tik", loop.sensor, plant.z)
    seen = seen + np.einsum("ikl,til->tik", loop.left_out.sensor, plant.direct_z)
    level = electronics.conditioner_gain * seen + electronics.conditioner_bias
    is_clipped = (level < -code / 2) | (level > electronics.adc_range - code / 2)
    force, limit = np.abs(record.slider_force), STUDY.drive.force_limit
    return result, SimpleNamespace(
        time=record.time,
        end=0.02,
        delay=0.004,
        length=0.012,
        band=8e-5,
        omega=loop.omega,
        modal_omega=loop.modal_omega,
        frequency=frequency,
        deflection=record.chord_deflection_stations,
        q=record.modal_coordinate,
        q_rate=plant.q_rate,
        modal=record.controlled_coordinate,
        modal_rate=np.einsum("icr,tir->tic", loop.observer, plant.q_rate),
        pose_error=record.pose_error,
        voltage=record.actuator_voltage,
        is_saturated=np.any(np.abs(record.actuator_voltage) > 40 - 1e-6, axis=(1, 2)),
        is_clipped=np.any(is_clipped, axis=(1, 2)),
        motor_force=record.slider_force,
        is_motor_saturated=np.any(force > limit - 1e-6, axis=1),
        axial_force=axial,
        stretch_error=stretch,
        strain=strain_of_sines(STUDY, record),
        controller=loop.controller,
    )


def test_converters_of_a_run_are_those_of_its_study(limited):
    one = limited[1].controller
    np.testing.assert_allclose(one.adc_step, 2.0 / 4096, rtol=1e-14)
    assert (one.adc_top, one.adc_gain, one.adc_bias, one.adc_noise) == (4095, 0.3, 1.1, 0)
    assert one.voltage_limit == 40


def test_metrics_of_a_run_are_those_of_its_trajectories(limited):
    result, run = limited
    wanted = by_definition(run)
    assert_same(result.metrics, wanted, rtol=1e-6)
    # everything happened, and nothing always
    for name in ("saturated_fraction", "clipped_fraction", "motor_saturated_fraction"):
        assert 0.1 < wanted[name] < 0.9, name
    assert np.all((wanted["settling_time"] > 0) & (wanted["settling_time"] < 0.02))
    assert len(np.unique(wanted["ringing_time"])) == len(np.unique(wanted["settling_time"])) == 3


def test_signals_of_a_run_are_what_their_names_say(limited):
    """Deflections of half-sine modes, rates of coordinates, a filter that sees its own modes."""
    _, run = limited
    x = np.array(STUDY.metrics.stations)
    bent = np.einsum("tir,rs->tis", run.q, np.sin(np.pi * np.outer([1, 2], x)))
    assert np.abs(bent - run.deflection).max() < 0.02 * np.abs(bent).max()  # and modes left out
    np.testing.assert_allclose(run.modal, run.q, atol=1e-9 * np.abs(run.q).max())
    slope = np.gradient(run.q, run.time, axis=0)[1:-1]
    assert np.abs(slope - run.q_rate[1:-1])[..., 0].max() < 0.02 * np.abs(slope).max()
    first = 114.39  # of a pinned-pinned link [Hz]
    np.testing.assert_allclose(run.omega, 2 * np.pi * first * np.array([[1, 4]] * 3), rtol=1e-4)
    span = np.linspace(0.9, 1.1, run.frequency.shape[2])
    wanted = run.modal_omega[:, :, None] * span / (2 * np.pi)
    np.testing.assert_allclose(run.frequency, wanted, rtol=1e-9)
