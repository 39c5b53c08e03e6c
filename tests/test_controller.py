"""Pieces of the sampled controller by themselves."""

import jax
import numpy as np

from jaxmodel.controller import CORNER, soft_limit


def test_smooth_limit_is_the_sharp_one_with_round_corners():
    bound = 100.0
    x = np.linspace(-250, 250, 5001)
    smooth, sharp = (np.asarray(soft_limit(x, bound, kind)) for kind in (True, False))
    far = np.abs(np.abs(x) / bound - 1) >= CORNER
    np.testing.assert_allclose(smooth[far], sharp[far], rtol=1e-14)
    assert np.max(np.abs(smooth - sharp)) <= bound * CORNER / 4 * (1 + 1e-9)
    np.testing.assert_allclose(smooth, -smooth[::-1], atol=1e-12)


def test_slope_of_the_smooth_limit_has_no_jump():
    x = np.linspace(-200, 200, 40001)
    slope = np.asarray(jax.vmap(jax.grad(lambda v: soft_limit(v, 100.0, True)))(x))
    assert slope.min() == 0 and slope.max() == 1
    assert np.max(np.abs(np.diff(slope))) < 1.1 * (x[1] - x[0]) / (2 * CORNER * 100)


def test_what_is_no_number_passes_the_limit():
    assert np.isnan(soft_limit(np.nan, 1.0, True)) and np.isnan(soft_limit(np.nan, 1.0, False))
