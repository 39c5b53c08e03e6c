"""Raw time records of a shaken machine, as frequency responses with their noise."""

import re

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from studies.errors import StudyError
from studies.fitting.measurements import make_bench
from studies.fitting.records import RecordSettings, recorded_response
from tests.fits import ASKEW, RESPONSE, answered, blank, made, posed, spec_of, write

RATE, LENGTH = 2000.0, 2**17
HANN = RecordSettings(segment=4.0, has_window=True, is_h2=False, band=(60.0, 500.0))
RECORD = {
    "kind": "record",
    "pose": ASKEW,
    "input": "actuator 1.1",
    "output": "sensor 1.1",
    "file": "record.csv",
    "segment_s": 4.0,
    "from_hz": 60.0,
    "to_hz": 500.0,
}


def two_modes(frequency):
    """Responses of a machine with two lightly damped modes [1]."""
    s = 2j * np.pi * np.asarray(frequency)
    return sum(
        a * w**2 / (s**2 + 2 * z * w * s + w**2)
        for a, w, z in ((1.0, 2 * np.pi * 114.0, 0.01), (-0.3, 2 * np.pi * 457.0, 0.005))
    )


def recorded(law, seed, noise=0.02, on_input=0.0, length=LENGTH):
    """Time, white input and the response to it, with noise of a share of its rms."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=length)
    spectrum = np.fft.rfft(source) * law(np.fft.rfftfreq(length, 1 / RATE))
    output = np.fft.irfft(spectrum, length)
    output = output + noise * output.std() * rng.normal(size=length)
    source = source + on_input * rng.normal(size=length)
    return np.arange(length) / RATE, source, output


def test_the_response_is_within_its_noise():
    """Standard deviations are right to a tenth, at the modes to a fifth, over 10 records."""
    away, at_modes = [], []
    for seed in range(10):
        found = recorded_response(*recorded(two_modes, seed), HANN, "data")
        off = ((found.value - two_modes(found.frequency)) / found.sigma).real
        is_near = np.abs(found.frequency - 114.0) < 3
        away, at_modes = [*away, *off], [*at_modes, *off[is_near]]
    assert np.std(away) == pytest.approx(1, abs=0.1) and abs(np.mean(away)) < 0.05
    assert np.std(at_modes) == pytest.approx(1, abs=0.2) and abs(np.mean(at_modes)) < 0.3
    assert found.averages == pytest.approx(0.95 * 31, abs=2) and found.coherence.max() <= 1


def test_neighbours_are_independent():
    found = recorded_response(*recorded(two_modes, 0, noise=0.5), HANN, "data")
    off = ((found.value - two_modes(found.frequency)) / found.sigma).real
    assert abs(np.corrcoef(off[1:], off[:-1])[0, 1]) < 0.2


def test_noise_on_the_input_is_left_to_h2():
    """H1 is too small by the share of noise in the input's power, H2 is not."""
    data = recorded(two_modes, 0, noise=0.0, on_input=0.5)
    ratios = []
    for is_h2 in (False, True):
        found = recorded_response(*data, HANN._replace(is_h2=is_h2), "data")
        ratios.append(np.median(np.abs(found.value / two_modes(found.frequency))))
    assert ratios[0] == pytest.approx(1 / 1.25, rel=0.03)
    assert ratios[1] == pytest.approx(1.0, rel=0.03)


def test_impacts_stand_alone():
    """Each segment has one that has decayed: no window, and nothing of it leaks."""
    size, hits = int(2.0 * RATE), 8
    rng, source = np.random.default_rng(0), np.zeros(hits * size)
    for k in range(hits):
        source[k * size + 10 : k * size + 14] = rng.uniform(0.5, 1.5) * np.array([1, 3, 2, 0.5])
    output = np.fft.irfft(
        np.fft.rfft(source) * two_modes(np.fft.rfftfreq(len(source), 1 / RATE)), len(source)
    )
    output = output + 1e-4 * np.abs(output).max() * rng.normal(size=len(source))
    settings = HANN._replace(segment=2.0, has_window=False)
    found = recorded_response(np.arange(len(source)) / RATE, source, output, settings, "data")
    assert found.averages == hits
    error = np.abs(found.value - two_modes(found.frequency))
    assert np.median(error / np.abs(two_modes(found.frequency))) < 2e-3


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The folder of a record of 8 s, with columns that are none."""
    folder = tmp_path_factory.mktemp("records")
    time, source, output = recorded(two_modes, 0, length=2**14)
    columns = {"input": source, "output": output, "still": 0 * time, "value": time**2}
    write(folder, "record.csv", time=time, **columns)
    return folder


SHORT = RECORD | {"segment_s": 0.5}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"segment_s": 40.0}, r"segment_s = 40.0; allowed: 0.008 to 3.28: 4 segments or more"),
        ({"segment_s": 1e-4}, "segment_s = 0.0001; allowed"),
        ({"to_hz": 60.1}, "allowed: 3 or more, 4 Hz apart"),
        ({"to_hz": 5000.0}, "to_hz = 5000.0; allowed: up to 1000, half the sample rate"),
        ({"from_hz": 600.0}, "from_hz = 600.0; allowed: below 500"),
        ({"value": "still"}, "the recorded output does not change"),
        ({"value": "still", "estimator": "H2"}, "the recorded output does not change"),
        ({"source": "force"}, "no column 'force'"),
        ({"source": "still"}, "the recorded input does not change"),
        ({"time": "value"}, "time must ascend evenly"),
        ({"window": "flat"}, "window = 'flat'"),
    ],
)
def test_what_is_no_record_is_refused(change, message, short):
    with pytest.raises(StudyError, match=message):
        made(spec_of(short, SHORT | change))


@pytest.mark.parametrize(
    "settings, least",
    [
        (HANN, "0.02 s or more, 4 segments of 16 samples"),
        (HANN._replace(has_window=False), "0.032"),
    ],
)
def test_a_record_in_which_no_segment_fits_is_too_short(settings, least):
    """Not "segment_s; allowed: 0.008 to 0.004"."""
    time, source, output = (x[:20] for x in recorded(two_modes, 0, length=2**14))
    with pytest.raises(StudyError, match=rf"data: a record of 0.00\d+ s; allowed: {least}"):
        recorded_response(time, source, output, settings, "data")


@pytest.mark.parametrize("drift", [-1e-4, 5e-4])
def test_two_clocks_of_different_rate_are_named(drift):
    """The fit of such a record took the average for a gain that is too small."""
    time, source, output = recorded(two_modes, 4)
    late = CubicSpline(time, output)(time * (1 - drift))
    with pytest.raises(StudyError, match="as if recorded with another clock") as refused:
        recorded_response(time, source, late, HANN, "data")
    told = float(re.search("by (\\S+) us more each second", str(refused.value))[1])
    assert told == pytest.approx(1e6 * drift, rel=0.01)
    factor = float(re.search("the output's time by (\\S+)$", str(refused.value))[1])
    mended = CubicSpline(time * factor, late)(time)[100:-200]
    found = recorded_response(time[100:-200], source[100:-200], mended, HANN, "data")
    off = np.abs(found.value / two_modes(found.frequency) - 1)
    assert off[np.abs(found.frequency - 114) < 20].max() < 0.1


def test_units_do_not_matter():
    """Also where squares of the numbers are none."""
    time, source, output = recorded(two_modes, 0)
    for settings in (HANN, HANN._replace(is_h2=True)):
        known = recorded_response(time, source, output, settings, "data")
        found = recorded_response(time, 1e-140 * source, 1e-141 * output, settings, "data")
        np.testing.assert_allclose(10 * found.value, known.value, rtol=1e-9)
        np.testing.assert_allclose(10 * found.sigma, known.sigma, rtol=1e-6)


def test_a_record_of_too_many_frequencies_is_refused(monkeypatch, short):
    spec = spec_of(short, SHORT)
    bench = make_bench(spec)
    monkeypatch.setattr("studies.fitting.kinds.entry.MOST_ROWS", 50)
    with pytest.raises(StudyError, match="segment_s = 0.5; allowed: up to 0.225 for this band"):
        made(spec, bench)


def test_a_machine_is_fitted_to_its_record(tmp_path):
    """A record of 33 s made with the model's response gives the numbers back."""
    blank(tmp_path)
    known = RESPONSE | {"output": RECORD["output"]}
    bench, (model,), truth = made(spec_of(tmp_path, known))
    length = LENGTH // 2
    model.frequency = np.fft.rfftfreq(length, 1 / RATE)[1:-1]
    curve, _ = model.predict(truth, False)
    time, source, output = recorded(lambda f: np.r_[0, curve, 0], 3, length=length)
    write(tmp_path, "record.csv", time=time, input=source, output=output)
    answer = answered(posed(spec_of(tmp_path, RECORD), bench))
    assert answer.is_explained
    away = np.abs(answer.values - truth) / answer.sigma
    assert np.all(away < 4) and np.all(answer.sigma[:2] < 0.01 * truth[:2])
