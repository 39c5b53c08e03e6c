"""What a fit says about its numbers, on linear problems whose answer is known in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from studies.fitting.kinds.contract import Residual
from studies.fitting.problem import Problem
from studies.fitting.profiles import Likelihood, describe_confirmed, profile
from studies.fitting.say import _misfit, _others, value_rows
from studies.fitting.solve import Solution
from studies.fitting.statistics import UNKNOWN, describe_fit, misfit, spread
from studies.space.axes import Range
from studies.space.free import Free as FreeNumber
from studies.space.free import FreeNumbers

LOW, SPAN = np.array([10.0, -2.0]), np.array([20.0, 8.0])


class Free:
    """Numbers on linear scales between bounds."""

    def values(self, u):
        return LOW[: np.shape(u)[-1]] + np.asarray(u) * SPAN[: np.shape(u)[-1]]

    def slopes(self, u):
        return SPAN[: len(u)]


class Line:
    """A measurement whose residuals are A (x - x0) + e over their standard deviation."""

    name, mean_square, n_hidden, is_ordered = "line", 1.0, 0, True

    def __init__(self, matrix, best, noise):
        self.matrix, self.best, self.noise = matrix, best, noise

    def residual(self, values, has_slopes):
        found = self.matrix @ (values - self.best) + self.noise
        return Residual(found, self.matrix if has_slopes else None)


def problem(size=1, n=200, seed=0):
    """A problem with its optimum, and the covariance of its numbers."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(n, size)) * np.array([1.5, 4.0])[:size]
    noise = rng.normal(size=n)
    noise -= matrix @ np.linalg.lstsq(matrix, noise, rcond=None)[0]  # so the optimum is `best`
    best = (LOW + 0.4 * SPAN)[:size]
    found = Problem(Free(), (), (Line(matrix, best, noise),), None)
    return found, np.full(size, 0.4), np.linalg.inv(matrix.T @ matrix), noise


@pytest.mark.parametrize("size", [1, 2])
def test_an_interval_is_1_96_standard_deviations(size):
    one, u, covariance, noise = problem(size)
    found = describe_fit(one, u)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.sigma, sigma, rtol=1e-4)
    np.testing.assert_allclose(found.values, (LOW + 0.4 * SPAN)[:size], rtol=1e-12)
    wide = norm.ppf(0.975)
    ends = found.values[:, None] + wide * sigma[:, None] * [-1, 1]
    np.testing.assert_allclose(found.interval, ends, atol=1e-3 * sigma.min())
    correlation = covariance / np.outer(sigma, sigma)
    np.testing.assert_allclose(found.correlation, correlation, atol=1e-4)
    scaled = covariance / np.outer(SPAN[:size], SPAN[:size])
    np.testing.assert_allclose(found.covariance, scaled, rtol=1e-3, atol=1e-12)
    square = np.sum(noise**2)
    assert found.chi_square == pytest.approx(square) and found.freedom == 200 - size
    assert found.probability == pytest.approx(chi2.sf(square, 200 - size))
    assert found.is_explained and not found.undetermined and not found.is_too_close
    np.testing.assert_allclose(found.gradient, 0, atol=1e-9)


def test_an_interval_ends_at_the_bounds():
    matrix = np.full((2, 1), 0.05)
    best = (LOW + 0.4 * SPAN)[:1]
    found = describe_fit(
        Problem(Free(), (), (Line(matrix, best, np.array([1.0, -1.0])),), None), np.array([0.4])
    )
    np.testing.assert_allclose(found.interval, [[10.0, 30.0]])
    np.testing.assert_allclose(found.sigma, SPAN[:1] / np.sqrt(12))
    assert len(found.undetermined) == 1 and pytest.approx(12**-0.5) == UNKNOWN


def test_a_number_of_which_only_the_bounds_are_known_is_not_identifiable():
    """Whatever the distance between them."""
    spans = {"wide": Range(0.0, 2e10, 0, False), "narrow": Range(0.0, 0.04, 0, False)}
    free = FreeNumbers(
        tuple(FreeNumber(name, span, np.nan, name) for name, span in spans.items()), lambda *_: None
    )
    width = np.array([2e10, 0.04])
    for share, said in ((UNKNOWN, "not identifiable"), (0.9 * UNKNOWN, "")):
        answer = SimpleNamespace(
            values=0.4321 * width, sigma=share * width, interval=np.outer(width, [0.1, 0.9])
        )
        rows = value_rows(
            SimpleNamespace(
                solution=SimpleNamespace(best=SimpleNamespace(u=np.full(2, 0.5))),
                names=["link.youngs_modulus", "link.damping_ratio"],
                spec=SimpleNamespace(free=free),
                answer=answer,
            )
        ).rows
        assert [row[-1] for row in rows] == [said] * 2
        assert [row[1] for row in rows] == ["8.64", "0.0173"]  # digits by the deviation
        assert [row[3] for row in rows] == ["GPa", ""]


@pytest.mark.parametrize(("size", "number"), [(1, 0), (2, 0), (2, 1)])
def test_a_profile_rises_by_3_84_at_the_ends_of_its_interval(size, number):
    one, u, covariance, _ = problem(size, seed=2)
    sigma = np.sqrt(np.diag(covariance))[number]
    value = one.free.values(u)[number]
    found = profile(one, u, number, sigma / SPAN[number])
    assert found.number == number and found.rise.min() == 0
    # of a linear problem the rise is that of a parabola, the others following
    np.testing.assert_allclose(found.rise, ((found.values - value) / sigma) ** 2, atol=1e-3)
    ends = np.array(found.interval())
    np.testing.assert_allclose(ends, value + norm.ppf(0.975) * sigma * np.array([-1, 1]), rtol=1e-4)
    level = ((ends - value) / sigma) ** 2
    np.testing.assert_allclose(level, chi2.ppf(0.95, 1), rtol=1e-3)
    assert chi2.ppf(0.95, 1) == pytest.approx(3.84, abs=2e-3)


@pytest.mark.parametrize("place", [0.4, 0.0])
def test_profiles_of_a_linear_problem_confirm_its_derivatives(place):
    """Also of a number at its bound, where the data end the profile on the other side only."""
    one, u, *_ = problem(2)
    u[0] = place
    one.measurements[0].best = one.free.values(u)
    wanted = describe_fit(one, u)
    found, profiles = describe_confirmed(one, u, has_all=True)
    assert [x.ends for x in profiles] == [2 if place else 1, 2]
    np.testing.assert_allclose(found.sigma, wanted.sigma, rtol=1e-3)
    np.testing.assert_allclose(found.interval, wanted.interval, rtol=1e-3)


def test_a_profile_that_does_not_rise_enough_ends_where_it_was_tried():
    values = np.array([0.0, 1.0, 2.0, 3.0])
    found = Likelihood(0, values, np.array([3.8, 0.0, 1.0, 9.0]))
    low, high = found.interval()
    assert low == 0.0 and high == pytest.approx(2 + 0.959964 / 2)
    low, _ = Likelihood(0, values, np.array([3.9, 0.0, 1.0, 9.0])).interval()
    assert 0 < low < 0.05
    many = Likelihood(0, np.arange(5.0), np.array([2.4**2, 1.8**2, 1.7**2, 0.0, 9.0]))
    assert many.interval()[0] == pytest.approx(1 - 0.159964 / 0.6)
    x, rise = found.smooth()
    assert (x[0], x[-1], len(x)) == (0, 3, 201)
    np.testing.assert_allclose(np.interp(values, x, rise), found.rise, atol=0.01)


def autoregressive(correlation, n, seed=1):
    """Noise of unit variance whose neighbours correlate."""
    rng = np.random.default_rng(seed)
    r = rng.normal(size=n)
    for k in range(1, n):
        r[k] = correlation * r[k - 1] + np.sqrt(1 - correlation**2) * r[k]
    return r * np.sqrt(n / np.sum(r**2))


def measured(value, **changes):
    about = {"name": "a|b", "mean_square": 1.0, "is_ordered": True} | changes
    return misfit(SimpleNamespace(**about), Residual(value, None))


@pytest.mark.parametrize("n", [100, 400, 3000])
def test_neighbours_that_correlate_are_no_noise(n):
    """Of the right variance, so that chi square has nothing against them."""
    for correlation, is_noise in ((0.0, True), (0.5, False), (-0.5, False), (0.9, False)):
        r = autoregressive(correlation, n)
        found = measured(r)
        own = np.sum(r[1:] * r[:-1]) / np.sum(r**2)
        assert found.autocorrelation == pytest.approx(own) and found.square == pytest.approx(n)
        assert (abs(own) < 4 / np.sqrt(n)) == is_noise == found.is_noise
    # in another order they are
    assert measured(autoregressive(0.5, n), is_ordered=False).is_noise


def test_the_limit_of_correlation_falls_as_the_root_of_the_number():
    n = 400
    for correlation, is_noise in ((0.13, True), (0.28, False)):
        found = measured(autoregressive(correlation, n, seed=4))
        assert found.is_noise == is_noise, found.autocorrelation


def test_residuals_that_are_too_large_are_no_noise():
    r = autoregressive(0.0, 400)
    limit = np.sqrt(chi2.isf(1e-4, 400) / 400)
    assert measured(0.99 * limit * r).is_noise and not measured(1.01 * limit * r).is_noise
    # of measurements that were softened, by what noise would have there
    scaled = measured(1.3 * r, mean_square=1.69)
    assert scaled.is_noise and scaled.square == pytest.approx(400)
    assert _misfit(scaled) == ["a|b", "400", "1", f"{scaled.autocorrelation:.2f}", "yes"]
    assert _misfit(measured(2 * r))[2:] == ["4", f"{scaled.autocorrelation:.2f}", "no"]


def test_one_free_number_in_two_is_no_information():
    """Only the sum is measured."""
    covariance, directions = spread(np.array([[50.0, 50.0]] * 3))
    assert directions[0].sigma > 1e3 and directions[1].sigma == pytest.approx(1 / np.sqrt(15_000))
    np.testing.assert_allclose(np.abs(directions[0].parts), np.sqrt(0.5) * np.ones(2))
    assert np.prod(np.sign(directions[0].parts)) == -1 and np.prod(directions[1].parts) > 0
    assert covariance[0, 1] < 0 and directions[0].named() in ([0, 1], [1, 0])


def test_other_optima_have_the_rise_of_chi_square():
    """Twice that of the cost, which is half the sum of squares."""
    other = [SimpleNamespace(u=np.array([u]), cost=cost) for u, cost in ((0.1, 13.5), (0.9, 12.25))]
    best = SimpleNamespace(u=np.array([0.4]), cost=12.0)
    found = SimpleNamespace(
        names=["link.damping_ratio"],
        solution=Solution((best, *other), 3, best.u),
        spec=SimpleNamespace(free=Free()),
    )
    assert _others(found) == [["3", "12"], ["0.5", "28"]]
    one, u, *_ = problem(1)
    costs = one.free.values(u) + np.array([0.0, 0.25])
    squares = [np.sum(one.residual((x - LOW[:1]) / SPAN[:1]) ** 2) for x in costs[:, None]]
    rise = float(squares[1] - squares[0])
    best.cost, other[0].cost = squares[0] / 2, squares[1] / 2
    assert _others(found)[0][0] == f"{rise:.3g}"
