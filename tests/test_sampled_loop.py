"""Damping, margins and leakage of the closed loop: the table of designs, and the run itself."""

import jax
import numpy as np
import pytest

from jaxmodel.linear import linearise, natural_modes
from jaxmodel.parameters import HOME
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import gain_margin, loop_report
from jaxmodel.simulate import simulate
from studies.cases import as_arrays, build_case, build_structure
from studies.spec import paper_study

PER_MODE = {
    "control__gain_factor": 1.0,
    "control__velocity_gain": (1.0, 1.0, 1.0),
    "control__ratios": ((1.55, 2.0, 3.0),) * 3,
    "electronics__lowpass_ratio": (3.0, 1.5, 1.5),
    "electronics__lowpass_zeta": (0.7, 0.3, 0.15),
}
FAST = {
    "control__gain_factor": 1.0,
    "electronics__sample_rate_hz": 20e3,
    "electronics__antialias_hz": 4e3,
}
#: Changes to the default design; gain margin [dB] with 8 and 12 plant modes; damping with 8.
DESIGNS = {
    "default": ({}, (12.9, 8.6), (0.248, 0.028, 0.011)),
    "paper": ({"control__gain_factor": 1.0}, (6.9, 2.6), (0.177, 0.047, 0.012)),
    "20 kHz": (FAST, (10.5, 6.6), (0.189, 0.047, 0.012)),
    "per mode": (PER_MODE, (14.0, 9.6), (0.248, 0.088, 0.058)),
}


def report(**changes):
    study = paper_study().change(**changes)
    return loop_report(build_structure(study), as_arrays(build_case(study)), np.array(HOME))


@pytest.mark.parametrize("name", DESIGNS)
def test_table_of_designs(name):
    changes, margins, damping = DESIGNS[name]
    eight, twelve = (report(link__modes=r, **changes) for r in (8, 12))
    found = [20 * np.log10(r.gain_margin) for r in (eight, twelve)]
    np.testing.assert_allclose(found, margins, atol=0.2)  # two units of the last digit
    np.testing.assert_allclose(eight.damping_ratio.min(axis=1), damping, atol=0.002)
    assert eight.is_stable


def test_difference_is_unstable_with_eight_modes_and_not_with_six():
    changes = {
        "control__gain_factor": 1.0,
        "electronics__estimator": "difference",
        "electronics__antialias_hz": 1e3,
    }
    six, eight = (report(link__modes=r, **changes) for r in (6, 8))
    assert six.is_stable and six.gain_margin > 4
    assert not eight.is_stable and eight.gain_margin < 0.3 and eight.spectral_radius > 1.1


def test_margin_stops_at_the_first_instability():
    """Unstable in a band of factors and stable again beyond: the band decides."""

    def poles(factor):
        return np.array([1.5 if 2.0 < factor < 3.0 else 0.5])

    assert gain_margin(poles) == pytest.approx(2.0, rel=2e-4)
    assert gain_margin(lambda f: np.array([0.9])) == 64.0
    assert gain_margin(lambda f: np.array([1.1])) == 0.0


def ideal_modes(**changes):
    """Damping ratios of the oscillating modes above 80 Hz with ideal feedback."""
    study = paper_study().change(control__feedback="ideal", **changes)
    structure, case = build_structure(study), as_arrays(build_case(study))

    @jax.jit
    def linear(case):
        loop = prepare(structure, case).loop
        return linearise(structure, loop, np.array(HOME), case.electronics.antialias)

    modes = natural_modes(linear(case))
    is_link = (modes.frequency > 80) & (modes.damping_ratio < 1)
    return modes.damping_ratio[is_link].reshape(-1, 3)


def test_gain_unit_decides():
    """3.1 N s/m gives the first assembled mode 0.32 of damping, 3.1 1/s adds 0.001."""
    common = {
        "link__modes": 3,
        "drive__locked": True,
        "control__basis": "pinned_free",
        "control__gain_factor": 1.0,
    }
    force = ideal_modes(**common)
    assert force[0, 0] == pytest.approx(0.320, abs=0.001)
    bare = ideal_modes(**common, link__damping_ratio=0.0)
    assert force[0, 0] - bare[0, 0] == pytest.approx(0.01, abs=0.0005)
    acceleration = ideal_modes(**common, control__gain_unit="1/s")
    assert acceleration[0, 0] - 0.01 == pytest.approx(0.001, abs=0.0003)


def test_ideal_feedback_with_the_decoupled_basis():
    full = ideal_modes(control__gain_factor=1.0)
    assert np.all((full[0] > 0.325) & (full[0] < 0.345))
    np.testing.assert_allclose(full[1:3].mean(axis=1), (0.044, 0.012), atol=0.001)
    # ten times the gain: aliased modes stiffen mode 1 and take its damping away
    assert ideal_modes(control__gain_factor=10.0)[0].min() == pytest.approx(0.046, abs=0.001)


@pytest.mark.parametrize(
    ("basis", "modes", "leak"),
    [
        ("pinned_free", (1, 2, 3, 4, 5, 6), (1, 0, 0, 0.21, 1.29, 10.4)),
        ("pinned_pinned", (4, 5, 6, 7, 8), (0, -1.1, 6.5, 41, 0)),
    ],
)
def test_modes_beyond_the_controlled_ones_leak_into_the_filter(basis, modes, leak):
    study = paper_study().change(link__basis=basis, control__basis="pinned_free")
    structure, case = build_structure(study), as_arrays(build_case(study))
    prepared = jax.jit(prepare, static_argnums=0)(structure, case)
    first = np.asarray(prepared.loop.observer)[0, 0, np.array(modes) - 1]
    digits = np.array([0.5 if abs(x) > 20 else 0.05 if abs(x) > 1.05 else 0.005 for x in leak])
    assert np.all(np.abs(first - leak) <= digits * 1.3), first
    np.testing.assert_allclose(prepared.sensor_condition, 7.0, atol=0.5)
    np.testing.assert_allclose(prepared.actuator_condition, 7.0, atol=0.5)


def decay_pole(signal, step, near):
    """Pole [1/s] of a sum of decaying oscillations that is nearest to a frequency [rad/s]."""
    order = 8
    rows = np.lib.stride_tricks.sliding_window_view(signal, order + 1)
    weights = np.linalg.lstsq(rows[:, :order], -rows[:, order], rcond=1e-10)[0]
    poles = np.log(np.roots(np.r_[1.0, weights[::-1]])) / step
    return poles[np.argmin(np.abs(np.abs(poles) - near) + (poles.imag <= 0) * 1e9)]


def test_damping_of_the_run_is_that_of_the_linear_loop():
    """Sliders locked, small bending released: each link decays as its linearised loop says."""
    study = paper_study().change(
        run__duration=0.1, run__smooth=True, electronics__adc_bits=32, drive__locked=True,
        motion__waypoints=(HOME,), shaper__kind="none", metrics__residual_length=0.05,
        initial__modal=((1e-6,), (1e-6,), (1e-6,)),
    )  # fmt: skip
    structure, case = build_structure(study), as_arrays(build_case(study))
    linear = loop_report(structure, case, np.array(HOME))
    result = jax.jit(simulate, static_argnums=(0, 2))(structure, case, True)
    q = np.asarray(result.record.modal_coordinate)[20:400:8, :, 0]
    near = 2 * np.pi * linear.frequency_hz[0].mean()
    poles = np.array([decay_pole(q[:, i], 8e-4, near) for i in range(3)])
    measured = np.sort(-poles.real / np.abs(poles))
    np.testing.assert_allclose(measured, np.sort(linear.damping_ratio[0]), rtol=0.05)
