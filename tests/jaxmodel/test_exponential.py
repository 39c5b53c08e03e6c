"""The exponential of matrices whose entries differ by many orders of magnitude."""

import jax
import numpy as np
import pytest
import scipy.linalg

from jaxmodel.exponential import exponential

_exponential = jax.jit(exponential)


@pytest.mark.parametrize("units", [0, 3, 6])
@pytest.mark.parametrize("seed", range(3))
def test_units_of_the_states_do_not_matter(seed, units):
    """With units apart by 1e12, JAX's own exponential is NaN."""
    rng = np.random.default_rng(seed)
    matrix = np.pad(rng.normal(size=(8, 10)), ((0, 2), (0, 0)))  # eight states, two inputs
    scale = np.exp2(np.round(rng.uniform(-units, units, 10) * np.log2(10)))
    whole = np.asarray(_exponential(matrix / scale[:, None] * scale, 0.5))
    wanted = scipy.linalg.expm(0.5 * matrix)
    np.testing.assert_allclose(whole * scale[:, None] / scale, wanted, rtol=1e-11, atol=1e-13)


def test_a_very_fast_oscillator_keeps_its_phase():
    omega = 1e7
    matrix = np.array([[0.0, 1.0], [-(omega**2), 0.0]])
    whole = np.asarray(_exponential(matrix, 1e-6))
    wanted = [[np.cos(10), np.sin(10) / omega], [-omega * np.sin(10), np.cos(10)]]
    np.testing.assert_allclose(whole, wanted, rtol=1e-12)


def test_derivatives_do_not_see_the_scaling():
    def entry(x):
        return exponential(jax.numpy.array([[0.0, 1.0], [-x, 0.0]]), 1e-3)[0, 0]

    slope = jax.jit(jax.grad(entry))(1e8)
    assert slope == pytest.approx(-np.sin(10) * 1e-3 / (2e4), rel=1e-10)  # of cos(sqrt(x) t)
