"""Modes from records of free decays and of ambient vibration."""

import numpy as np
import pytest

from studies.errors import StudyError
from studies.fitting.decays import DecaySettings, decay_modes
from studies.fitting.plots import drawings
from tests.fits import (
    ASKEW,
    DECAY,
    FREE_OF_UNEQUAL,
    SENSORS,
    UNEQUAL,
    fit_of,
    made,
    spec_of,
    write,
    write_decays,
)

HERTZ, DAMPING = np.array([112.0, 115.0, 118.0, 455.0]), np.array([0.01, 0.012, 0.008, 0.006])
SHAPES = np.array([[1.0, 0.5, 0.2], [-0.4, 1.0, 0.3], [0.2, -0.5, 1.0], [0.6, 0.3, -0.8]])
FREE = DecaySettings(segment=1.0, is_ambient=False, band=(60.0, 600.0))
AMBIENT = DecaySettings(segment=0.0, is_ambient=True, band=(60.0, 600.0))


def decays(seed, noise, rate=5000.0, count=4):
    """Time and three signals of free decays of 1 s, one after another."""
    rng, time = np.random.default_rng(seed), np.arange(int(rate)) / rate
    omega = 2 * np.pi * HERTZ
    course = np.exp(np.outer(time, omega * (1j * np.sqrt(1 - DAMPING**2) - DAMPING)))
    parts = [
        (course * (rng.normal(size=4) * np.exp(1j * rng.uniform(0, 6, 4)))).real @ SHAPES
        for _ in range(count)
    ]
    signals = np.concatenate(parts)
    return np.arange(len(signals)) / rate, signals + noise * rng.normal(size=signals.shape)


def ambient(seed, noise, rate=2000.0, duration=120.0):
    """Time and three signals of modes that white noise shakes."""
    rng, count = np.random.default_rng(seed), int(rate * duration)
    s = 2j * np.pi * np.fft.rfftfreq(count, 1 / rate)
    signals = np.zeros((count, 3))
    for hertz, damping, shape in zip(HERTZ, DAMPING, SHAPES, strict=True):
        omega = 2 * np.pi * hertz
        law = omega**1.5 / (s**2 + 2 * damping * omega * s + omega**2)
        signals += np.fft.irfft(np.fft.rfft(rng.normal(size=count)) * law)[:, None] * shape
    signals /= signals.std(axis=0)
    return np.arange(count) / rate, signals + noise * rng.normal(size=signals.shape)


@pytest.mark.parametrize(
    "record, noise, settings",
    [
        (decays, 0.01, FREE),
        pytest.param(decays, 0.1, FREE, marks=pytest.mark.long),
        pytest.param(ambient, 0.1, AMBIENT, marks=pytest.mark.long),
    ],
)
def test_modes_are_within_their_standard_deviations(record, noise, settings):
    """No bias, and scatter as said, to a quarter over 20 records; three modes within 6 Hz."""
    found = [decay_modes(*record(seed, noise), settings, "data") for seed in range(20)]
    away = np.concatenate([off_by(x) for x in found])
    assert sum(len(x.frequency) == 4 for x in found) >= 13 and len(away) >= 140
    assert np.std(away) == pytest.approx(1, abs=0.25) and abs(np.mean(away)) < 0.25


def off_by(found):
    """Of each true mode, by the nearest one: in standard deviations, (2 modes found,)."""
    away = []
    for hertz, damping in zip(HERTZ, DAMPING, strict=True):
        k = int(np.argmin(np.abs(found.frequency - hertz)))
        if abs(found.frequency[k] - hertz) < 1.5:
            away.append((found.frequency[k] - hertz) / found.sigma[k])
            away.append((found.damping[k] - damping) / found.damping_sigma[k])
    return np.array(away)


def before(record, seconds, noise=0.02):
    """A record that began before its release."""
    time, signals = record
    quiet = noise * np.random.default_rng(9).normal(size=(int(seconds * 5000), 3))
    signals = np.concatenate([quiet, signals])
    return np.arange(len(signals)) / 5000, signals


def shifted(record, offset):
    time, signals = record
    return time, signals + offset


def cut(record, length):
    """Decays whose releases follow one another sooner than after 1 s."""
    pieces = record[1].reshape(-1, 5000, 3)[:, : int(5000 * length)].reshape(-1, 3)
    return np.arange(len(pieces)) / 5000, pieces


WHOLE = FREE._replace(segment=0.0)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "spoil",
    [
        lambda x: before(x, 0.01),
        lambda x: before(x, 0.1),
        lambda x: shifted(x, 0.05),
        lambda x: shifted(x, 0.5),
        lambda x: x,
    ],
)
def test_modes_of_one_imperfect_record_are_within_their_deviations(seed, spoil):
    away = off_by(decay_modes(*spoil(decays(seed, 0.02, count=1)), WHOLE, "data"))
    assert len(away) >= 6 and np.abs(away).max() < 4.5


def test_releases_within_a_decay_are_refused_or_do_no_harm():
    with pytest.raises(StudyError, match="segment_s"):
        decay_modes(*cut(decays(0, 0.02), 0.9), FREE, "data")
    away = off_by(decay_modes(*cut(decays(0, 0.02), 0.95), FREE._replace(segment=0.93), "data"))
    assert np.abs(away).max() < 4.5


def test_without_noise_modes_are_exact():
    found = decay_modes(*decays(0, 0.0, count=1), WHOLE, "data")
    np.testing.assert_allclose(found.frequency, HERTZ, rtol=1e-6)
    np.testing.assert_allclose(found.damping, DAMPING, rtol=1e-4)


def test_a_band_of_few_lines_is_refused():
    for band in ((111.0, 113.0), (111.9, 112.1)):
        with pytest.raises(StudyError, match="spectral lines from 111"):
            decay_modes(*decays(0, 0.02, count=1), WHOLE._replace(band=band), "data")


def test_noise_has_no_modes():
    rng, time = np.random.default_rng(0), np.arange(5000) / 5000.0
    for _ in range(10):
        with pytest.raises(StudyError, match="stands out of the noise|loudest|spectral lines"):
            decay_modes(time, rng.normal(size=(5000, 3)), WHOLE, "data")


def test_shapes_are_those_of_the_modes():
    found = decay_modes(*decays(0, 0.01), FREE, "data")
    for shape, true in zip(found.shapes, SHAPES, strict=True):
        mac = abs(shape.conj() @ true) ** 2 / np.linalg.norm(shape) ** 2 / np.linalg.norm(true) ** 2
        assert mac > 0.995


def test_two_minutes_of_ambient_vibration_give_four_modes():
    found = decay_modes(*ambient(1, 0.1), AMBIENT, "data")
    np.testing.assert_allclose(found.frequency, HERTZ, rtol=0.004)
    assert np.all(np.abs(found.damping - DAMPING) < 4 * found.damping_sigma)


def test_the_diagram_has_stable_columns_at_the_modes():
    diagram = decay_modes(*decays(0, 0.02), FREE, "data").diagram
    for hertz in HERTZ:
        near = diagram.is_stable & (np.abs(diagram.frequency - hertz) < 1)
        assert len(set(diagram.order[near])) >= 15
    assert diagram.is_stable.sum() < diagram.is_stable.size


@pytest.fixture(scope="module")
def shaken(tmp_path_factory):
    """A file with decays of the machine."""
    folder = tmp_path_factory.mktemp("decays")
    modes = {"kind": "modes", "pose": ASKEW, "frequency_hz": [100.0], "sigma_hz": 1.0}
    bench, _, values = made(spec_of(folder, modes, free=FREE_OF_UNEQUAL, study=UNEQUAL))
    write_decays(folder, bench, values)
    return folder


def test_a_fit_to_decays_finds_the_machine(shaken):
    """Stiffness and damping, from a guess that is 4 % and 40 % off; three modes within 7 Hz."""
    start = {"link": UNEQUAL["link"] | {"damping_ratio": 0.017, "stiffness_factor": 0.96}}
    entry = DECAY | {"segment_s": 0.5, "to_hz": 700.0}
    options = {"starts": 4, "refine": 1, "profile": False}
    fitted = fit_of(spec_of(shaken, entry, free=FREE_OF_UNEQUAL, study=start, **options))
    for k, true in enumerate((1.0, 0.012)):
        assert abs(fitted.answer.values[k] - true) < 3 * fitted.answer.sigma[k]
        assert fitted.answer.sigma[k] < (0.001, 0.001)[k]
    part = fitted.comparisons[0].part
    assert fitted.answer.is_explained and len(part.labels) == 12
    assert all("shape" in note for note in part.notes)
    assert "stabilisation" in drawings(fitted)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"outputs": []}, "outputs"),
        ({"outputs": ["sensor 1.1", "sensor 1.1"]}, "each output once"),
        ({"outputs": ["motor 1"]}, "sensor LINK.PATCH"),
        ({"values": ["sensor 1.1"]}, "3 columns"),
        ({"values": ["time", "sensor 1.1", "sensor 2.1"]}, "each column once"),
        ({"segment_s": 0.01}, "0.12 to 1.5"),
        ({"segment_s": 5.0}, "1.5, the length of the record"),
        ({"to_hz": 6000.0}, "half the sample rate"),
        ({"from_hz": 250.0, "segment_s": 0.5}, "no mode from 250 to 300 Hz"),
        ({"excitation": "ambient"}, "3.84 s or more"),
        ({"excitation": "chance"}, "'none' or 'ambient'"),
        ({"damping": True}, "damping"),
    ],
)
def test_bad_entries_are_refused(shaken, change, said):
    with pytest.raises(StudyError, match=said):
        made(spec_of(shaken, DECAY | change))


def test_a_dead_channel_is_named(shaken, tmp_path):
    time = np.arange(2000) / 2000.0
    columns = dict(zip(SENSORS, (np.sin(700 * time), 0 * time, np.cos(700 * time)), strict=True))
    write(tmp_path, "decay.csv", time=time, **columns)
    with pytest.raises(StudyError, match="signal 2 does not change"):
        made(spec_of(tmp_path, DECAY))
