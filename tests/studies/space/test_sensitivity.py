"""Sobol and Morris indices against closed forms; what failed cases do to them."""

import numpy as np
import pytest
from scipy.stats import qmc

from studies.errors import StudyError
from studies.space.indices import elementary_effects, sobol_indices
from studies.space.methods import morris_points, saltelli_points

A, B = 7.0, 0.1


def ishigami(x):
    """sin x1 + a sin^2 x2 + b x3^4 sin x1 on (-pi, pi)^3."""
    x = np.pi * (2 * x - 1)
    return np.sin(x[:, 0]) + A * np.sin(x[:, 1]) ** 2 + B * x[:, 2] ** 4 * np.sin(x[:, 0])


def ishigami_indices():
    """Closed form: Ishigami and Homma 1990."""
    first = np.array([(1 + B * np.pi**4 / 5) ** 2 / 2, A**2 / 8, 0.0])
    both = B**2 * np.pi**8 * (1 / 18 - 1 / 50)
    variance = first.sum() + both
    return first / variance, (first + np.array([both, 0.0, both])) / variance


def design(n, d):
    return saltelli_points(qmc.Sobol(2 * d, rng=np.random.default_rng(3)).random_base2(n))


def test_sobol_indices_of_the_ishigami_function():
    found = sobol_indices(ishigami(design(12, 3)), 3)
    first, total = ishigami_indices()
    np.testing.assert_allclose(found.first, first, atol=0.01)
    np.testing.assert_allclose(found.total, total, atol=0.01)
    assert found.n_used == 4096 and found.n_left_out == 0
    for value, interval in ((first, found.first_interval), (total, found.total_interval)):
        assert np.all((interval[:, 0] < value + 0.01) & (value - 0.01 < interval[:, 1]))
        assert np.all(interval[:, 1] - interval[:, 0] < 0.2)
    assert abs(found.first[0] - total[0]) > 0.2  # first and total are not the same thing


def test_sobol_indices_of_a_linear_function():
    weight = np.array([3.0, 2.0, 1.0, 0.0])
    found = sobol_indices(design(12, 4) @ weight, 4)
    share = weight**2 / np.sum(weight**2)
    np.testing.assert_allclose(found.first, share, atol=0.005)
    np.testing.assert_allclose(found.total, share, atol=0.005)


def test_failed_cases_are_left_out_and_counted():
    points = design(12, 3)
    value = ishigami(points)
    broken = value.reshape(-1, 5).copy()
    broken[np.random.default_rng(0).choice(4096, 400, replace=False), 2] = np.nan
    found = sobol_indices(broken.ravel(), 3)
    assert found.n_left_out == 400 and found.n_used == 3696
    np.testing.assert_allclose(found.first, ishigami_indices()[0], atol=0.04)
    broken[:2500, 0] = np.nan
    with pytest.raises(StudyError, match="only .* of 4096 base points have no failed case"):
        sobol_indices(broken.ravel(), 3)
    with pytest.raises(StudyError, match="the same in every case"):
        sobol_indices(0 * value, 3)


def test_elementary_effects_of_a_linear_function_are_its_slopes():
    points = morris_points(20, 4, 4, 1)
    slope = np.array([3.0, -2.0, 0.5, 0.0])
    found = elementary_effects(points, points @ slope)
    np.testing.assert_allclose(found.mean, slope, atol=1e-12)
    np.testing.assert_allclose(found.mean_size, np.abs(slope), atol=1e-12)
    np.testing.assert_allclose(found.deviation, 0, atol=1e-12)
    assert found.n_left_out == 0


def test_elementary_effects_see_interaction_and_survive_failures():
    points = morris_points(2000, 3, 6, 2)
    value = points[:, 0] * points[:, 1] + points[:, 2]
    found = elementary_effects(points, value)
    # effect of x1 is x2: mean 1/2, spread that of the grid's levels
    np.testing.assert_allclose(found.mean, [0.5, 0.5, 1.0], atol=0.03)
    np.testing.assert_allclose(found.deviation, [0.34, 0.34, 0.0], atol=0.02)
    # from -1/2 to 1/2 in steps of 1/5: they cancel in the mean, their sizes do not
    both = elementary_effects(points, (points[:, 0] - 0.5) * points[:, 1])
    np.testing.assert_allclose([both.mean[1], both.mean_size[1]], [0.0, 0.3], atol=0.02)
    value[::9] = np.nan
    broken = elementary_effects(points, value)
    assert broken.n_left_out > 500 and np.all(broken.n_used < 2000)
    np.testing.assert_allclose(broken.mean, found.mean, atol=0.03)
    value[::2] = np.nan
    with pytest.raises(StudyError, match="effects of factor . are left"):
        elementary_effects(points, value)
