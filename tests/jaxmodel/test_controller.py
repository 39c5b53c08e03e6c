"""Pieces of the sampled controller by themselves."""

from types import SimpleNamespace

import jax
import numpy as np

from jaxmodel.channels import strongest
from jaxmodel.controller import CORNER, adc_code, read_back, soft_limit


def test_smooth_limit_is_the_sharp_one_with_round_corners():
    bound = 100.0
    x = np.linspace(-250, 250, 5001)
    limit = jax.jit(soft_limit, static_argnums=2)
    smooth, sharp = (np.asarray(limit(x, bound, kind)) for kind in (True, False))
    far = np.abs(np.abs(x) / bound - 1) >= CORNER
    np.testing.assert_allclose(smooth[far], sharp[far], rtol=1e-14)
    assert np.max(np.abs(smooth - sharp)) <= bound * CORNER / 4 * (1 + 1e-9)
    np.testing.assert_allclose(smooth, -smooth[::-1], atol=1e-12)


def test_slope_of_the_smooth_limit_has_no_jump():
    x = np.linspace(-200, 200, 40001)
    slope = np.asarray(jax.jit(jax.vmap(jax.grad(lambda v: soft_limit(v, 100.0, True))))(x))
    assert slope.min() == 0 and slope.max() == 1
    assert np.max(np.abs(np.diff(slope))) < 1.1 * (x[1] - x[0]) / (2 * CORNER * 100)


def test_what_is_no_number_passes_the_limit():
    assert np.isnan(soft_limit(np.nan, 1.0, True)) and np.isnan(soft_limit(np.nan, 1.0, False))


def test_a_code_reads_back_within_half_a_step():
    """Of a 12-bit converter that a conditioner's bias puts in the middle of its range."""
    adc = SimpleNamespace(adc_gain=0.4, adc_bias=1.6, adc_step=3.3 / 4096, adc_top=4095.0)
    voltage = np.linspace(-3.9, 3.9, 1001)
    code, is_clipped = adc_code(adc, voltage, None)
    assert not is_clipped.any()
    half = adc.adc_step / adc.adc_gain / 2
    np.testing.assert_allclose(read_back(adc, code), voltage, atol=half * (1 + 1e-9))


def test_of_rivals_the_one_of_highest_energy_acts():
    omega = np.array([[100.0, 200.0, 0.0], [100.0, 200.0, 300.0]])
    value = np.array([[1.0, 0.1, 0.0], [1.0, 0.1, 0.0]])
    rate = np.array([[0.0, 90.0, 1e9], [0.0, 99.0, 0.0]])
    # energies: 1e4 against 400 + 8100, and 1e4 against 400 + 9801 and 0
    assert strongest(omega, value, rate).tolist() == [[1, 0, 1], [0, 1, 0]]
