"""Input shapers: amplitudes, robustness, sample grids and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxmodel.shaper import (
    MAX_IMPULSES,
    SHAPERS,
    Impulses,
    damped_frequency,
    design_shaper,
    ei,
    ei2,
    ei3,
    ei_damped,
    in_series,
    insensitivity,
    none,
    residual_vibration,
    sensitivity_curve,
    shaper_duration,
    split_exact,
    split_linear,
    zv,
    zvd,
    zvdd,
)

OMEGA = 2 * np.pi * 114.4  # first mode of the machine [rad/s]
PERIOD = 1e-4  # controller sample [s]

design = jax.jit(design_shaper)
residual = jax.jit(residual_vibration)
curve = jax.jit(sensitivity_curve)
band = jax.jit(insensitivity)
exactly = jax.jit(split_exact)
linearly = jax.jit(split_linear)

modes = {"omega": st.floats(1.0, 1e4), "zeta": st.floats(0, 0.3)}


def index(kind):
    return SHAPERS.position(kind)


def sampled(taps, period=PERIOD):
    """The taps as impulses on the grid."""
    return Impulses(taps.weight, taps.sample * period)


@pytest.mark.parametrize("kind", SHAPERS)
@settings(max_examples=50, deadline=None)
@given(**modes, tolerance=st.floats(0, 0.3))
def test_amplitudes_sum_to_one(kind, omega, zeta, tolerance):
    impulses = design(index(kind), omega, zeta, tolerance)
    assert impulses.amplitude.shape == impulses.time.shape == (MAX_IMPULSES,)
    np.testing.assert_allclose(np.sum(impulses.amplitude), 1, rtol=2e-15)
    assert np.all(np.isfinite(impulses.time)) and np.all(impulses.time >= 0)


@pytest.mark.parametrize("kind", ["zv", "zvd", "zvdd"])
@settings(max_examples=50, deadline=None)
@given(**modes)
def test_zero_vibration_at_the_nominal_mode(kind, omega, zeta):
    assert residual(design(index(kind), omega, zeta, 0.05), omega, zeta) < 2e-15


def test_zero_vibration_shapers_in_closed_form():
    k = np.exp(-0.1 * np.pi / np.sqrt(1 - 0.1**2))
    half = np.pi / (OMEGA * np.sqrt(1 - 0.1**2))
    rows = {zv: [1, k], zvd: [1, 2 * k, k**2], zvdd: [1, 3 * k, 3 * k**2, k**3]}
    for shaper, row in rows.items():
        amplitude, time = shaper(OMEGA, 0.1)
        np.testing.assert_allclose(amplitude, np.array(row) / sum(row), rtol=1e-14)
        np.testing.assert_allclose(time, half * np.arange(len(row)), rtol=1e-14)


def test_orders_of_zero_at_the_nominal_frequency():
    """V of ZV, ZVD, ZVDD grows with the power 1, 2, 3 of the frequency error."""
    for order, kind in enumerate(["zv", "zvd", "zvdd"], start=1):
        impulses = design(index(kind), OMEGA, 0.02, 0.05)
        far, near = curve(impulses, jnp.array([1.02, 1.01]), OMEGA, 0.02)
        np.testing.assert_allclose(np.log2(far / near), order, atol=0.05)


def test_ei_of_the_paper_is_equation_13():
    amplitude, time = ei(OMEGA, 0.1, 0.05)
    np.testing.assert_allclose(amplitude, [1.05 / 4, 0.95 / 2, 1.05 / 4], rtol=1e-15)
    half = np.pi / (OMEGA * np.sqrt(1 - 0.1**2))
    np.testing.assert_allclose(time, [0, half, 2 * half], rtol=1e-14)


def test_ei_without_tolerance_is_the_undamped_zero_vibration_shaper():
    pairs = {ei: zvd, ei2: zvdd}
    for insensitive, exact in pairs.items():
        got, expected = insensitive(OMEGA, 0.0, 0.0), exact(OMEGA, 0.0)
        np.testing.assert_allclose(got.amplitude, expected.amplitude, rtol=1e-14)
    np.testing.assert_allclose(ei3(OMEGA, 0.0, 0.0).amplitude * 16, [1, 4, 6, 4, 1], rtol=1e-14)


@pytest.mark.parametrize("v", [0.01, 0.05, 0.1])
@pytest.mark.parametrize("kind", ["ei", "ei2", "ei3"])
def test_humps_of_an_undamped_shaper_just_reach_the_tolerance(kind, v):
    impulses = design(index(kind), OMEGA, 0.0, v)
    width = float(band(impulses, OMEGA, 0.0, v))
    inside = jnp.linspace(1 - 0.49 * width, 1 + 0.49 * width, 2001)
    # The peaks lie between points of this fine grid, so they are seen a little low at most.
    np.testing.assert_allclose(jnp.max(curve(impulses, inside, OMEGA, 0.0)), v, rtol=1e-4)


def test_insensitivities_at_five_per_cent():
    """Closed forms: V = cos^n(pi r/2) of the ZV family, and of (13) (1+V)/2 cos(pi r) + (1-V)/2."""
    v = 0.05
    expected = {
        "none": 0.0,
        "zv": 4 / np.pi * np.arcsin(v),
        "zvd": 4 / np.pi * np.arcsin(v ** (1 / 2)),
        "zvdd": 4 / np.pi * np.arcsin(v ** (1 / 3)),
        "ei": 2 / np.pi * np.arccos((1 - 3 * v) / (1 + v)),
    }
    for kind, width in expected.items():
        np.testing.assert_allclose(
            band(design(index(kind), OMEGA, 0.0, v), OMEGA, 0.0), width, rtol=0, atol=3e-6
        )


@pytest.mark.parametrize(
    "kind, width",
    [("zv", 0.0637), ("zvd", 0.2871), ("ei", 0.3994), ("zvdd", 0.4804), ("ei2", 0.7245)]
    + [("ei3", 0.9639)],
)
def test_insensitivities_in_figures(kind, width):
    got = band(design(index(kind), OMEGA, 0.0, 0.05), OMEGA, 0.0)
    np.testing.assert_allclose(got, width, rtol=0, atol=6e-5)


def test_ei_of_the_paper_fails_on_a_well_damped_mode():
    ratio = jnp.linspace(0.86, 1.14, 281)
    paper = curve(design(index("ei"), OMEGA, 0.2, 0.05), ratio, OMEGA, 0.2)
    assert abs(float(paper[140]) - 0.085) < 5e-4
    assert abs(float(jnp.max(paper)) - 0.107) < 5e-4
    damped = curve(design(index("ei_damped"), OMEGA, 0.2, 0.05), ratio, OMEGA, 0.2)
    assert float(jnp.max(damped)) < 0.0505
    light = curve(design(index("ei"), OMEGA, 0.05, 0.05), ratio, OMEGA, 0.05)
    assert float(jnp.max(light)) < 0.05


@pytest.mark.parametrize(
    "v, zeta, first, third, middle",
    [
        (0.1, 0.3, 0.62486627, 0.09821858, 0.575785737),
        (0.05, 0.1, 0.3548861, 0.19211919, 0.50469656),
    ],
)
def test_damped_ei_is_its_polynomial(v, zeta, first, third, middle):
    """Values worked out apart from the code, from the published coefficients."""
    amplitude, time = ei_damped(OMEGA, zeta, v)
    np.testing.assert_allclose(amplitude, [first, 1 - first - third, third], rtol=1e-7)
    period = 2 * np.pi / damped_frequency(OMEGA, zeta)
    np.testing.assert_allclose(time / period, [0, middle, 1], rtol=1e-7)


def test_damped_ei_is_near_the_exact_solution():
    """Zeros on both sides (11), V and slope zero at omega (12): solved numerically, V = 5 %."""
    exact = {0.05: (0.3068, 0.2256, 0.5011), 0.1: (0.3547, 0.1919, 0.5026)}
    for zeta, (first, third, middle) in exact.items():
        amplitude, time = ei_damped(OMEGA, zeta, 0.05)
        np.testing.assert_allclose(amplitude[::2], [first, third], rtol=0, atol=4e-4)
        np.testing.assert_allclose(time[1] / time[2], middle, rtol=0, atol=4e-3)


@settings(max_examples=50, deadline=None)
@given(zeta=st.floats(0, 0.3), v=st.floats(0.05, 0.15))
def test_damped_ei_leaves_the_tolerance_at_the_nominal_mode(zeta, v):
    got = residual(design(index("ei_damped"), OMEGA, zeta, v), OMEGA, zeta)
    np.testing.assert_allclose(got, v, rtol=0.06)


def test_residual_vibration_is_that_of_the_simulated_mode():
    """Amplitude of a damped oscillator after the impulses, over that of one impulse."""
    zeta = 0.07
    impulses = design(index("ei2"), OMEGA * 1.1, zeta, 0.05)
    state, pole = 0.0, OMEGA * (-zeta + 1j * np.sqrt(1 - zeta**2))
    end = float(shaper_duration(impulses))
    for amplitude, time in zip(*impulses, strict=True):
        state += float(amplitude) * np.exp(pole * (end - float(time)))
    np.testing.assert_allclose(residual(impulses, OMEGA, zeta), abs(state), rtol=1e-12)


def test_residual_vibration_broadcasts():
    impulses = design(index("zvd"), OMEGA, 0.05, 0.05)
    omega, zeta = OMEGA * jnp.array([[0.8], [1.2]]), jnp.array([0.0, 0.05, 0.1])
    got = residual(impulses, omega, zeta)
    assert got.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            alone = residual(impulses, omega[i, 0], zeta[j])
            np.testing.assert_allclose(got[i, j], alone, rtol=1e-13)
    ratio = jnp.array([[0.8], [1.2]])
    np.testing.assert_array_equal(curve(impulses, ratio, OMEGA, zeta[1]), got[:, 1:2])


def test_duration_ignores_padding():
    durations = {"none": 0, "zv": 0.5, "zvd": 1, "zvdd": 1.5, "ei": 1, "ei_damped": 1}
    durations |= {"ei2": 1.5, "ei3": 2}
    period = 2 * np.pi / damped_frequency(OMEGA, 0.03)
    for kind, periods in durations.items():
        got = shaper_duration(design(index(kind), OMEGA, 0.03, 0.05))
        np.testing.assert_allclose(got, periods * period, rtol=1e-14)
    late_padding = Impulses(jnp.array([1.0, 0.0]), jnp.array([0.0, 5.0]))
    assert shaper_duration(late_padding) == 0


def test_exact_split_keeps_the_zero_where_the_linear_split_loses_it():
    zeta, period = 0.03, 5e-4
    impulses = design(index("zv"), OMEGA, zeta, 0.05)
    exact = residual(sampled(exactly(impulses, period, OMEGA, zeta), period), OMEGA, zeta)
    linear = residual(sampled(linearly(impulses, period), period), OMEGA, zeta)
    assert exact < 1e-15
    assert linear > 1e-3


@pytest.mark.parametrize("kind", SHAPERS)
@settings(max_examples=50, deadline=None)
@given(omega=st.floats(500.0, 5000.0), zeta=st.floats(0, 0.2))
def test_splits_are_harmless(kind, omega, zeta):
    """Weights sum to one, lie next to their impulse; the exact one only scales the mode's V."""
    impulses = design(index(kind), omega, zeta, 0.05)
    found = exactly(impulses, PERIOD, omega, zeta), linearly(impulses, PERIOD)
    impulses, exact, linear = jax.tree.map(np.asarray, (impulses, *found))
    for taps in (exact, linear):
        assert taps.weight.shape == taps.sample.shape == (2 * MAX_IMPULSES,)
        assert np.issubdtype(taps.sample.dtype, np.integer)
        np.testing.assert_allclose(np.sum(taps.weight), 1, rtol=3e-15)
        assert np.all(taps.weight >= -1e-10) and np.all(taps.sample >= 0)
        away = np.abs(taps.sample * PERIOD - np.tile(impulses.time, 2))
        assert np.all(away <= PERIOD * (1 + 1e-9))
        assert not np.any(taps.weight[np.tile(impulses.amplitude == 0, 2)])

    def vector(amplitude, time):
        pole = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
        return np.sum(amplitude * np.exp(-pole * time))

    # Before renormalisation the exact split is the same vector; afterwards its real multiple.
    ratio = vector(*sampled(exact)) * np.conj(vector(*impulses))
    assert abs(ratio.imag) < 1e-11 * (1 + abs(ratio.real))
    mean_delay = np.sum(linear.weight * linear.sample) * PERIOD
    np.testing.assert_allclose(mean_delay, np.sum(np.prod(np.stack(impulses), 0)), atol=1e-15)


def test_impulse_on_the_grid_stays_one_impulse():
    impulses = Impulses(jnp.array([0.25, 0.75]), jnp.array([0.0, 3 * 2.0**-13]))
    for taps in (linearly(impulses, 2.0**-13), exactly(impulses, 2.0**-13, OMEGA, 0.1)):
        np.testing.assert_array_equal(taps.sample, [0, 3, 1, 4])
        np.testing.assert_allclose(taps.weight, [0.25, 0.75, 0, 0], rtol=1e-14, atol=1e-17)


def test_traced_kinds_in_one_batch():
    kinds = np.arange(len(SHAPERS))
    omega, zeta = OMEGA * np.linspace(0.8, 1.2, len(SHAPERS)), np.linspace(0, 0.2, len(SHAPERS))
    v = np.linspace(0.03, 0.1, len(SHAPERS))
    found = jax.jit(jax.vmap(design_shaper))(kinds, omega, zeta, v)
    amplitude, time = map(np.asarray, found)
    for k, kind in enumerate(SHAPERS):
        mode = (omega[k], zeta[k])
        alone = {
            "none": lambda mode, v: none(),
            "zv": lambda mode, v: zv(*mode),
            "zvd": lambda mode, v: zvd(*mode),
            "zvdd": lambda mode, v: zvdd(*mode),
            "ei": lambda mode, v: ei(*mode, v),
            "ei_damped": lambda mode, v: ei_damped(*mode, v),
            "ei2": lambda mode, v: ei2(*mode, v),
            "ei3": lambda mode, v: ei3(*mode, v),
        }[kind](mode, v[k])
        n = len(alone.time)
        np.testing.assert_allclose(amplitude[k, :n], alone.amplitude, rtol=1e-14)
        np.testing.assert_allclose(time[k, :n], alone.time, rtol=1e-14)
        assert not np.any(amplitude[k, n:]) and not np.any(time[k, n:])


@jax.jit
def everything(kind, omega, zeta, tolerance):
    """All differentiable results at once, times in units of the sample period."""
    impulses = design_shaper(kind, omega * OMEGA, zeta, tolerance)
    return (
        impulses.amplitude,
        impulses.time / PERIOD,
        split_linear(impulses, PERIOD).weight,
        split_exact(impulses, PERIOD, omega * OMEGA, zeta).weight,
        residual_vibration(impulses, 1.07 * OMEGA, 0.03),
    )


@pytest.mark.parametrize("kind", SHAPERS)
def test_gradients(kind):
    check_grads(
        lambda *inputs: everything(index(kind), *inputs),
        (1.01, 0.02, 0.05),
        order=1,
        modes=["fwd", "rev"],
        eps=1e-6,
        rtol=1e-5,
        atol=1e-6,
    )


@pytest.mark.parametrize("kind", SHAPERS)
def test_gradients_are_finite_at_the_limits(kind):
    """No damping and no tolerance; no residual vibration of the ZV family."""

    def results(*inputs):
        return everything(index(kind), *inputs)

    for inputs in [(1.0, 0.0, 0.0), (1.07, 0.03, 0.05)]:
        value, transpose = jax.vjp(results, *inputs)
        reverse = np.array(transpose(jax.tree.map(jnp.ones_like, value)))
        assert np.all(np.isfinite(reverse))
        for k, direction in enumerate(np.eye(3)):
            forward = jnp.hstack(jax.jvp(results, inputs, tuple(direction))[1])
            assert np.all(np.isfinite(forward))
            np.testing.assert_allclose(jnp.sum(forward), reverse[k], rtol=1e-9, atol=1e-9)


def test_gradient_of_no_vibration_is_zero():
    silent = Impulses(jnp.zeros(2), jnp.array([0.0, 0.01]))
    assert jax.jit(jax.grad(residual_vibration, 1))(silent, OMEGA, 0.1) == 0


def test_exact_splits_in_series_cancel_both_modes():
    """Split for its own mode and only then put in series, each ZV still cancels its mode."""
    period, modes = 1e-4, ((2 * np.pi * 114.39, 0.01), (2 * np.pi * 457.55, 0.02))
    series = jax.jit(in_series)
    first, second = (exactly(zv(*mode), period, *mode) for mode in modes)
    taps = series(first, second)
    on_grid = Impulses(taps.weight, taps.sample * period)
    for omega, zeta in modes:
        assert residual(on_grid, omega, zeta) < 1e-12
    linear = series(*(linearly(zv(*mode), period) for mode in modes))
    assert residual(Impulses(linear.weight, linear.sample * period), *modes[1]) > 1e-4
