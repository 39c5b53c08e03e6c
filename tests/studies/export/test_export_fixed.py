"""Arithmetic of exported controllers: formats, error bounds, rest, what does not fit."""

from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from rich.console import Console

from jaxmodel.loop import step
from jaxmodel.shaper import Taps
from studies.engine.channels import fold, unfold
from studies.engine.controller import _frequencies, fixed_controller
from studies.errors import StudyError
from studies.export import fixed as fixed_point
from studies.export import in_the_loop, targets
from studies.export.c_fixed import fixed_source
from studies.export.c_floating import floating_source
from studies.export.compiler import compiled
from studies.export.cost import Cost
from studies.export.fixed import (
    check_error,
    design_fixed,
    peak_gains,
    rail_samples,
    rounded,
    shaper_row,
)
from studies.export.fixed_blocks import design_integers
from studies.export.floating import respond as respond_floating
from studies.export.in_the_loop import LoopRun, replay
from studies.export.integers import respond
from studies.export.request import Export, check_loop
from studies.export.verify import (
    Check,
    Verification,
    _shape_reference,
    reference_run,
    vibration,
)
from studies.study.cases import build_structure
from studies.study.spec import Study
from tests.bare import parse_study
from tests.exports import KINDS, PAPER, SINGLE, TUNED, changed, found_and_codes, needs_compiler

RAIL = 100


def checked_design(found, seen, dac_bits, word=32):
    """As it is exported: refused if rounding can be seen at the actuators."""
    fixed = design_fixed(found, seen, dac_bits, word)
    check_error(found, fixed.error, fixed.wires.dac_step)
    return fixed


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    found, codes = found_and_codes(KINDS[request.param])
    seen = respond_floating(found.channels, found.controller, codes)
    return found, codes, seen, design_fixed(found, seen, 12)


def test_floating_arithmetic_is_the_jax_controller(kind):
    found, codes, seen, _ = kind
    wanted = np.asarray(replay(found.controller, codes))
    assert np.abs(wanted).max() > 0
    np.testing.assert_allclose(seen.command, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())


def test_fixed_point_stays_within_its_bound(kind):
    found, codes, seen, fixed = kind
    inside, total = fixed.error.inside, fixed.error.total
    used = np.isin(np.arange(3), found.channels.link)
    assert np.all((inside > 0) == used[:, None]) and inside.max() < 0.5 * fixed.wires.dac_step
    assert np.all(total >= 0.5 * fixed.wires.dac_step + inside) and np.all(np.isfinite(total))
    volts = (respond(fixed, codes, RAIL).codes - fixed.wires.dac_rest) * fixed.wires.dac_step
    difference = np.abs(volts - seen.command).max(axis=0)
    assert np.all(difference <= total * (1 + 1e-9))


def test_no_sequence_of_codes_overflows(kind):
    found, codes, _, fixed = kind
    worst = worst_codes(found, fixed)
    for sequence in (codes, worst):
        response = respond(fixed, sequence, len(sequence) + 1)
        assert response.limited.sum() == 0 and not response.is_faulty.any()
    # the bound is not idle either: these codes nearly reach it
    signals = respond_floating(found.channels, found.controller, worst)
    if np.any(found.controller.feedthrough):
        return
    for part, form in ((signals.signal, fixed.signal), (signals.force, fixed.force)):
        reached = np.abs(part).max(axis=0) / form.bound
        assert reached.max() > 0.8 and reached.max() <= 1 + 1e-9


def worst_codes(found, fixed):
    """Codes that drive the force of the first channel as far as codes can."""
    channels, n = found.channels, 400
    response = fixed_point._responses(channels, 0, n)[2]
    sign = np.sign(response[::-1])[:, None] * np.sign(channels.filter[0])
    codes = np.full(
        (n, 3, found.n_patches), round(fixed.wires.bias / 2**fixed.wires.adc_bits), float
    )
    codes[:, channels.link[0]] = np.where(sign > 0, fixed.wires.adc_top, 0)
    return codes


def test_comes_to_rest_after_any_input(kind):
    found, _, _, fixed = kind
    top, middle = fixed.wires.adc_top, round(fixed.wires.bias / 2**fixed.wires.adc_bits)
    loud = np.where(np.arange(300)[:, None, None] // 17 % 2, top, 0) * np.ones((1, 3, 3))
    codes = np.concatenate([loud, np.full((3000, 3, 3), middle)])
    out = respond(fixed, codes, RAIL).codes
    assert np.any(out[:300] != fixed.wires.dac_rest)
    floating = respond_floating(found.channels, found.controller, codes).command[-1]
    # no limit cycle; what is left is what the bias between two codes leaves in floating point
    assert np.all(out[-500:] == out[-1])
    assert (
        np.abs((out[-1] - fixed.wires.dac_rest) * fixed.wires.dac_step - floating).max()
        < fixed.wires.dac_step
    )


def test_formats_leave_the_stated_margin(kind):
    _, _, _, fixed = kind
    for form in (fixed.signal, fixed.high, fixed.inner, fixed.force):
        assert np.all(form.margin >= fixed_point.MARGIN)
        assert np.all(form.step * 2.0**31 > form.bound)


def test_unfolded_channels_are_the_controller(kind):
    found, codes, seen, fixed = kind
    law = unfold(found.channels, found.controller)
    again = respond_floating(fold(law.feedback, found.study.control.law), law, codes)
    np.testing.assert_allclose(again.force, seen.force, rtol=1e-12)
    near = rounded(fixed, found.channels)
    error = np.abs(near.force - found.channels.force).max(axis=1)
    # rounded with the factor between two formats, which has some bits less than a word
    assert np.all(error < 1e-7 * np.abs(found.channels.force).max(axis=1))
    assert np.any(near.force != found.channels.force)


def test_a_coefficient_off_by_little_breaks_the_bound():
    found, codes = found_and_codes(PAPER)
    seen = respond_floating(found.channels, found.controller, codes)
    fixed = design_fixed(found, seen, 16)
    integers = fixed.numerator.integers * (1 + 1e-4)
    wrong = fixed._replace(numerator=fixed.numerator._replace(integers=integers.astype(np.int64)))
    volts = (respond(wrong, codes, RAIL).codes - fixed.wires.dac_rest) * fixed.wires.dac_step
    assert np.abs(volts - seen.command).max() > fixed.error.total.max()


def test_faulty_sensors_are_noticed_where_they_are_used():
    found, codes = found_and_codes(SINGLE)
    seen = respond_floating(found.channels, found.controller, codes)
    fixed = design_fixed(found, seen, 12)
    for link in range(3):
        bad = codes.copy()
        bad[100:, link, 1] = fixed.wires.adc_top
        response = respond(fixed, bad, RAIL)
        assert response.is_faulty.any() == (link == 1)
        if link == 1:
            assert np.flatnonzero(response.is_faulty)[0] == 100 + RAIL - 1
            assert np.all(response.codes[100 + RAIL - 1 :] == fixed.wires.dac_rest)
    # from end to end is no sensor that is stuck
    bad = codes.copy()
    bad[100:, 1, 1] = np.where(
        np.arange(len(codes) - 100) // (RAIL - 1) % 2, fixed.wires.adc_top, 0
    )
    assert not respond(fixed, bad, RAIL).is_faulty.any()


@pytest.mark.parametrize("shaper", [{"kind": "ei3"}, {"frequencies_hz": [60.0, 114.0]}, {}])
def test_fixed_shaper_leaves_a_pose_at_rest_where_it_is(shaper):
    found = fixed_controller(parse_study(changed(TUNED, shaper=shaper, run={"duration": 0.2})))
    row = shaper_row(found.taps)
    assert row.integers.sum() == 2 ** int(row.shift[0])
    np.testing.assert_allclose(row.values[0], found.taps.weight, rtol=0, atol=1e-8)


def test_a_shaped_path_is_the_weighted_sum_of_its_past():
    taps = Taps(np.array([0.75, 0.25]), np.array([0, 2]))
    path = np.array([[0.0], [4.0], [8.0], [8.0]])
    assert _shape_reference(taps, path).tolist() == [[0.0], [3.0], [6.0], [7.0]]


def test_peak_gains_are_those_of_the_filters():
    channels = found_and_codes(PAPER)[0].channels
    gains = peak_gains(channels, 3000)
    b0, _, a1 = channels.first.T
    # |b0| + |b0 (1 + a1)| sum |a1|^k for b1 = -b0, a1 in (-1, 0)
    assert np.all((a1 > -1) & (a1 < 0))
    np.testing.assert_allclose(gains.high, 2 * b0, rtol=1e-9)


def test_the_loop_with_the_controller_outside_is_the_loop():
    found = fixed_controller(parse_study(PAPER))
    outside = reference_run(found)
    inside = whole_run(found)
    np.testing.assert_allclose(outside.pose, inside.pose, rtol=0, atol=1e-12)
    # a command is held in the next sample
    np.testing.assert_allclose(outside.voltage[:-1], inside.actuator_voltage[1:], rtol=0, atol=1e-9)
    assert np.abs(outside.voltage).max() > 1


def whole_run(found):
    """Trajectories of the compiled loop with its own controller."""
    structure = found.structure
    start = in_the_loop._begin(structure, found.case)

    @jax.jit
    def scan(loop, state, inputs):
        return jax.lax.scan(partial(step, structure, loop), state, inputs)[1]

    return jax.tree.map(np.asarray, scan(start.loop, start.state, start.inputs))


def run_of(codes, rms):
    """A run with codes of one sensor and residual vibration by link and station."""
    codes, count = np.array(codes)[:, None, None], len(codes)
    result = SimpleNamespace(metrics=SimpleNamespace(residual_rms=np.array(rms)))
    return LoopRun(codes, np.zeros((count, 1, 1)), np.zeros((count, 3)), result)


def test_channels_have_the_frequencies_that_the_controller_believes():
    hertz = np.array([[100.0, 400.0], [110.0, 440.0], [120.0, 480.0]])
    structure = build_structure(Study().change(control__modes=2))
    np.testing.assert_allclose(_frequencies(structure, 2 * np.pi * hertz), hertz, rtol=1e-15)


def test_code_that_cannot_keep_up_is_said_with_the_rate_that_can():
    quick = Cost(products=90, roundings=30, cycles=5000, load=1.0, words=9)
    assert quick.text.endswith("100 % of a sample at 150 MHz (estimate)")
    assert (
        "CAUTION: it cannot keep up; at this clock up to 30000 Hz" in quick._replace(load=1.01).text
    )


def test_deviation_of_a_run():
    """By hand: worst stations (4, 3) and (8, 6), rms 5 and 10 over the root of 2."""
    runs = {
        "JAX": run_of([1, 2, 3, 4], [[4.0, 1.0], [2.0, 3.0]]),
        "C": run_of([1, 5, 3, 5], [[8.0, 2.0], [4.0, 6.0]]),
        "same": run_of([1, 2, 3, 4], [[4.0, 0.0], [0.0, 3.0]]),
    }
    found = Verification(checks=[], notes=[], runs=runs, exchanges={}, counts={})
    assert vibration(runs["JAX"]) == pytest.approx(5 / 2**0.5)
    assert found.deviation("C").first_code == 1
    assert found.deviation("C").loss == pytest.approx(1.0)
    assert found.deviation("same")[2:] == (-1, 0.0)


def test_one_comparison_that_fails_fails_the_verification():
    good, bad = (Check("some codes", "1", "0", is_met) for is_met in (True, False))
    found = Verification(checks=[good], notes=[], runs={}, exchanges={}, counts={})
    assert found.is_passed and not found._replace(checks=[good, bad]).is_passed


REFUSED = {
    "no sampled controller": (changed(PAPER, control={"feedback": "ideal"}), "control.feedback"),
    "no link": (changed(PAPER, control={"links": [False] * 3}), "control.links"),
    "no gain": (changed(PAPER, control={"gain_factor": 0.0}), "control.gain_factor"),
    "sensors at rest at the end": (
        changed(PAPER, electronics={"conditioner_bias": 3.0}),
        "conditioner_bias = 3.0; allowed",
    ),
    "masked": (changed(PAPER, control={"mode_mask": [[False] * 3] * 3}), "mode_mask"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_controller_is_refused(name):
    data, message = REFUSED[name]
    with pytest.raises(StudyError, match=message):
        fixed_controller(parse_study(data))


UNFIT = {
    "codes too long": (changed(PAPER, electronics={"adc_bits": 20}), "adc_bits = 20; allowed: up"),
    "filter too slow": (
        changed(PAPER, electronics={"highpass_hz": 1e-3}),
        r"highpass_hz = 0.001; allowed: from 0.0\d+ .*--target c",
    ),
    "rounding too loud": (
        changed(PAPER, electronics={"voltage_limit": 1e-7}),
        r"can add up to .* V at actuator \d of link \d; allowed: .*--target c",
    ),
    "too high a rate": (
        changed(
            PAPER,
            electronics={"sample_rate_hz": 1e6, "antialias_hz": 2e5, "highpass_hz": 5.0},
        ),
        "electronics.sample_rate_hz = 1e",
    ),
}


@pytest.mark.parametrize("name", UNFIT)
def test_what_does_not_fit_words_is_refused(name):
    data, message = UNFIT[name]
    found, codes = found_and_codes(data, 50)
    seen = respond_floating(found.channels, found.controller, codes)
    with pytest.raises(StudyError, match=message):
        checked_design(found, seen, 12)


def test_factors_beyond_a_word_are_refused():
    with pytest.raises(StudyError, match=r"gains: factors add up to 3e\+09 .* allowed: below"):
        fixed_point.find_row(np.array([[1e9, 2e9, 0.0]]), "gains", 32)
    with pytest.raises(StudyError, match="nan"):
        fixed_point.find_row(np.array([[np.nan, 1.0]]), "gains", 32)


def test_unstable_loops_are_refused_with_their_margin(monkeypatch):
    found = fixed_controller(parse_study(changed(PAPER, control={"gain_factor": 4.0})))
    job = Export(found, "name", [], "", [], False, 16, Console(quiet=True), None)
    message = r"gain_factor = 4.0; .* is stable: its spectral radius is 1\.\d+.*margin"
    monkeypatch.setattr(targets, "reference_motion", None)  # refused before any motion
    with pytest.raises(StudyError, match=message):
        targets.TARGETS["c-fixed"].make(job)
    # a design that is stable, until its filters are rounded to a few bits
    found = fixed_controller(parse_study(PAPER))
    assert check_loop(found, found.channels, "").is_stable
    coarse = found.channels._replace(denominator=np.round(found.channels.denominator * 4) / 4)
    with pytest.raises(StudyError, match="coefficients rounded"):
        check_loop(found, coarse, ", coefficients rounded")


@pytest.mark.parametrize("law", ["imsc", "srf", "lqg"])
def test_words_of_16_bits_are_those_of_their_model(law):
    """Coarse, but the C code does what its model does, and stays within its bound."""
    found, codes = found_and_codes(changed(PAPER, control={"law": law}))
    seen = respond_floating(found.channels, found.controller, codes)
    fixed, _ = design_integers(found, seen, 12, 16)
    with pytest.raises(StudyError, match="rounding can add up to"):
        check_error(found, fixed.error, fixed.wires.dac_step)
    source = fixed_source(found, fixed, "flexlink", ["16 bits"], "")
    assert "int16_t" in source.code and "static int64_t pose_shifted" in source.code
    sizes = (9, len(found.channels.names), int(found.taps.sample.max()) + 1)
    compiler, model = needs_compiler(), respond(fixed, codes, 100)
    with compiled(source, "flexlink", compiler, np.uint16, np.int32, sizes) as code:
        np.testing.assert_array_equal(code.respond(codes)[0], model.codes)
    assert model.limited.sum() == 0
    volts = (model.codes - fixed.wires.dac_rest) * fixed.wires.dac_step
    off = np.abs(volts - seen.command).max(axis=0)
    assert np.all(off <= fixed.error.total) and off.max() > fixed.wires.dac_step


def random_design(rng):
    """A design far from the usual ones; many of them are refused."""

    def log(low, high, size=None):
        return np.exp(rng.uniform(np.log(low), np.log(high), size))

    links = rng.random(3) < 0.7
    rate = float(rng.choice([2e3, 5e3, 1e4, 2e4, 5e4]))
    return changed(
        PAPER,
        shaper={"kind": str(rng.choice(["none", "zv", "ei", "ei3"]))},
        run={"duration": 0.1},
        control={
            "gain_factor": float(log(1e-3, 10)),
            "links": links.tolist() if links.any() else [True, False, True],
            "velocity_gain": (rng.choice([-1, 1, 1], 3) * log(0.1, 10, 3)).tolist(),
            "position_gain": (rng.choice([-1, 0, 1], 3) * log(1, 1e4, 3)).tolist(),
            "mode_mask": (rng.random((3, 3)) < 0.8).tolist(),
            "feedthrough_factor": float(rng.choice([0.0, 0.0, 0.3, 1.0])),
        },
        electronics={
            "sample_rate_hz": rate,
            "antialias_hz": rate * float(rng.uniform(0.05, 0.45)),
            "estimator": str(rng.choice(["modal_phase", "modal_phase", "difference"])),
            "highpass_hz": float(log(1, 300)),
            "lowpass_ratio": log(0.3, 3, 3).tolist(),
            "lowpass_zeta": log(0.02, 2, 3).tolist(),
            "adc_bits": int(rng.integers(4, 19)),
            "conditioner_gain": float(log(1e-2, 10)),
            "conditioner_bias": float(rng.uniform(0, 3)),
            "voltage_limit": float(log(0.1, 1e3)),
        },
    )


def check_random_designs(count, seed):
    """Each one is refused in words, or its C code is what its models are; returns how many ran."""
    compiler, n_run = needs_compiler(), 0
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        try:
            found, codes = found_and_codes(random_design(rng), 300)
            seen = respond_floating(found.channels, found.controller, codes)
            bits, word = int(rng.integers(4, 17)), int(rng.choice([16, 32]))
            fixed = checked_design(found, seen, bits, word)
        except StudyError as error:
            assert "allowed" in str(error), (k, error)
            continue
        n_run += 1
        wild = rng.integers(0, fixed.wires.adc_top + 1, (400, 3, 3)).astype(float)
        rail = rail_samples(found.study.electronics.sample_rate_hz)
        sizes = (9, len(found.channels.link), int(found.taps.sample.max()) + 1)
        source = fixed_source(found, fixed, "flexlink", ["random"], "")
        with compiled(source, "flexlink", compiler, np.uint16, np.int32, sizes) as code:
            for sequence in (codes, wild):
                response = respond(fixed, sequence, rail)
                np.testing.assert_array_equal(code.respond(sequence)[0], response.codes, str(k))
                assert response.limited.sum() == 0, k
        volts = (respond(fixed, codes, rail).codes - fixed.wires.dac_rest) * fixed.wires.dac_step
        off = np.abs(volts - seen.command).max(axis=0)
        assert np.all(off <= fixed.error.total * (1 + 1e-9) + 1e-12), k
        source = floating_source(found, "flexlink", ["random"])
        with compiled(source, "flexlink", compiler, np.float64, np.float64, sizes) as code:
            out = code.respond(codes * float(found.controller.adc_step))[0]
        assert np.abs(out - seen.command).max() <= 1e-12 * np.abs(seen.command).max(), k
    return n_run


def test_random_designs():
    assert check_random_designs(8, 0) >= 1


@pytest.mark.long
def test_many_random_designs():
    assert check_random_designs(150, 1) >= 30
