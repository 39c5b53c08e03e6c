"""Reference motion: time laws, paths and their shaped form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxmodel.motion import (
    PROFILES,
    Path,
    end_of_path,
    move_starts,
    sample_path,
    shape_path,
)
from jaxmodel.shaper import SHAPERS, Taps, design_shaper, split_exact

sample = jax.jit(sample_path)
design, split = jax.jit(design_shaper), jax.jit(split_exact)


def uneven_path(profile="cycloid"):
    return Path(
        np.array([[0.01, -0.02, 0.5], [0.02, 0.01, 0.4], [-0.01, 0.0, 0.6], [0.0, 0.02, 0.6]]),
        np.array([0.05, 0.1, 0.08]),
        np.array([0.02, 0.0, 0.03]),
        np.asarray(PROFILES.position(profile)),
    )


def square_path(side=0.01, move_time=0.1, dwell=0.0, phi=np.pi / 6):
    """(0,0), (0,s), (s,s), (s,0), (0,0) with the cycloid (25)."""
    x, y = np.array([0, 0, 1, 1, 0]), np.array([0, 1, 1, 0, 0])
    return Path(
        waypoints=jnp.stack([x * side, y * side, np.full(5, phi)], axis=1),
        move_time=jnp.broadcast_to(move_time, (4,)),
        dwell=np.full(4, dwell),
        profile=np.asarray(PROFILES.position("cycloid")),
    )


def test_first_move_of_the_square_is_equation_25():
    t = np.linspace(0, 0.1, 101)
    y = 0.01 * t / 0.1 - 0.01 / (2 * np.pi) * np.sin(2 * np.pi * t / 0.1)
    pose = sample(square_path(), t).position
    expected = np.stack([0 * t, y, np.full_like(t, np.pi / 6)], axis=1)
    np.testing.assert_allclose(pose, expected, rtol=0, atol=1e-17)


def test_quintic_is_its_polynomial():
    path = square_path()._replace(profile=jnp.asarray(PROFILES.position("quintic")))
    t = np.linspace(0, 0.1, 101)
    s = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    got = sample(path, t)
    for order, values in enumerate(got):
        expected = 0.01 / 0.1**order * s.deriv(order)(t / 0.1)
        np.testing.assert_allclose(values[:, 1], expected, rtol=0, atol=1e-13 * 0.1**-order)


@pytest.mark.parametrize("profile", PROFILES)
def test_rates_are_derivatives_of_the_position(profile):
    path, t = uneven_path(profile), jnp.linspace(-0.01, 0.31, 400)

    def slope(field):
        return jax.jit(jax.vmap(jax.jacfwd(lambda t: sample_path(path, t)[field])))(t)

    got = sample(path, t)
    np.testing.assert_allclose(got.velocity, slope(0), rtol=0, atol=1e-13)
    np.testing.assert_allclose(got.acceleration, slope(1), rtol=0, atol=1e-11)


@pytest.mark.parametrize("profile", PROFILES)
def test_formula_with_all_moves_summed(profile):
    path, t = uneven_path(profile), np.linspace(-0.05, 0.4, 451)
    position = np.tile(np.asarray(path.waypoints[0]), (len(t), 1))
    for k, start in enumerate([0, 0.07, 0.17]):
        u = np.clip((t - start) / float(path.move_time[k]), 0, 1)
        laws = (u - np.sin(2 * np.pi * u) / (2 * np.pi), 10 * u**3 - 15 * u**4 + 6 * u**5)
        delta = np.asarray(path.waypoints[k + 1] - path.waypoints[k])
        position += laws[PROFILES.position(profile)][:, None] * delta
    np.testing.assert_allclose(sample(path, t).position, position, rtol=0, atol=1e-15)


def test_starts_and_end_leave_out_the_last_dwell():
    path = uneven_path()
    np.testing.assert_allclose(move_starts(path), [0, 0.07, 0.17], rtol=1e-15)
    np.testing.assert_allclose(end_of_path(path), 0.25, rtol=1e-15)
    np.testing.assert_allclose(end_of_path(square_path(dwell=0.02)), 0.46, rtol=1e-15)


@pytest.mark.parametrize("profile", PROFILES)
def test_path_rests_in_its_ends_and_in_its_dwells(profile):
    path = uneven_path(profile)
    got = jax.tree.map(np.asarray, sample(path, np.array([-1.0, 0.0, 0.05, 0.06, 0.25, 0.27, 9.0])))
    rest = np.asarray(path.waypoints)[[0, 0, 1, 1, 3, 3, 3]]
    np.testing.assert_allclose(got.position, rest, rtol=0, atol=1e-17)
    np.testing.assert_allclose(got.velocity, 0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(got.acceleration, 0, rtol=0, atol=1e-12)
    for rates in got[1:]:
        assert not np.any(rates[[0, 1, 3, 5, 6]]), "exactly at rest inside a pause"


def test_square_has_its_corners_and_its_extent():
    path = square_path(side=0.02, move_time=0.05, dwell=0.01, phi=0.4)
    corners = sample(path, move_starts(path)).position
    np.testing.assert_allclose(
        corners, [[0, 0, 0.4], [0, 0.02, 0.4], [0.02, 0.02, 0.4], [0.02, 0, 0.4]], atol=1e-17
    )
    pose = sample(path, jnp.linspace(0, 0.24, 2401)).position
    np.testing.assert_allclose(jnp.min(pose, axis=0), [0, 0, 0.4], rtol=0, atol=1e-17)
    np.testing.assert_allclose(jnp.max(pose, axis=0), [0.02, 0.02, 0.4], rtol=0, atol=1e-17)
    np.testing.assert_allclose(pose[-1], [0, 0, 0.4], rtol=0, atol=1e-17)


def test_any_shape_of_time():
    t = jnp.linspace(0, 0.3, 12)
    flat, block = sample(uneven_path(), t), sample(uneven_path(), t.reshape(3, 4))
    for a, b in zip(flat, block, strict=True):
        np.testing.assert_array_equal(b, a.reshape(3, 4, 3))
    assert sample(uneven_path(), 0.1).position.shape == (3,)


def test_profiles_and_durations_mix_in_one_batch():
    profile, move_time = jnp.array([0, 1, 0]), jnp.array([0.1, 0.05, 0.03])
    t = jnp.linspace(0, 0.5, 50)

    @jax.jit
    def case(profile, move_time):
        return sample_path(square_path(move_time=move_time)._replace(profile=profile), t)

    together = jax.jit(jax.vmap(case))(profile, move_time)
    for i in range(3):
        alone = case(profile[i], move_time[i])
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("profile", PROFILES)
def test_gradients_of_the_path(profile):
    path, t = uneven_path(profile), jnp.array([0.013, 0.06, 0.11, 0.2, 0.3])

    @jax.jit
    def position_and_velocity(waypoints, move_time, dwell, t):
        return sample_path(Path(waypoints, move_time, dwell, path.profile), t)[:2]

    check_grads(position_and_velocity, (*path[:3], t), order=1, modes=["fwd", "rev"], eps=1e-6)


@pytest.mark.parametrize("profile", PROFILES)
def test_gradients_stay_finite_at_the_joints_of_the_path(profile):
    path = uneven_path(profile)
    t = jnp.array([-1.0, 0.0, 0.05, 0.07, 0.17, 0.25, 5.0])

    @jax.jit
    def derivatives(*inputs):
        def all_values(waypoints, move_time, dwell, t):
            parts = sample_path(Path(waypoints, move_time, dwell, path.profile), t)
            return jnp.concatenate(parts)

        every = tuple(range(4))
        return jax.jacfwd(all_values, every)(*inputs), jax.jacrev(all_values, every)(*inputs)

    forward, reverse = derivatives(*path[:3], t)
    for a, b in zip(forward, reverse, strict=True):
        assert np.all(np.isfinite(a))
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-9)


N_TIMES, PER_SAMPLE, STEP = 1201, 3, 5e-5
shape = jax.jit(shape_path, static_argnums=(2, 3))


def direct(path, taps):
    """Sum the path at the delayed times, tap by tap."""
    t = STEP * np.arange(N_TIMES)
    total = [np.zeros((N_TIMES, 3))] * 3
    for weight, delay in zip(taps.weight, taps.sample, strict=True):
        delayed = sample(path, t - int(delay) * PER_SAMPLE * STEP)
        total = [a + float(weight) * np.asarray(b) for a, b in zip(total, delayed, strict=True)]
    return total


def assert_same_motion(got, expected):
    # Rounding of the values, and of times near 0.06 s (3e-17 s) times the next rate of the path.
    peaks, largest_step, shortest_move = (2, 2 * np.pi, 60), 0.2, 0.01
    for order, (a, b) in enumerate(zip(got, expected, strict=True)):
        slope = peaks[order] * largest_step / shortest_move ** (order + 1)
        np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15 + 3e-17 * slope)


def quick_path(profile="cycloid"):
    return uneven_path(profile)._replace(move_time=np.array([0.01, 0.02, 0.01]))


@pytest.mark.parametrize("profile", PROFILES)
def test_shaped_path_is_the_sum_of_delayed_paths(profile):
    path = quick_path(profile)
    omega = 2 * np.pi * 114.4
    impulses = design(SHAPERS.position("ei_damped"), omega, 0.02, 0.05)
    taps = jax.tree.map(np.asarray, split(impulses, PER_SAMPLE * STEP, omega, 0.02))
    got = shape(path, taps, N_TIMES, PER_SAMPLE, STEP)
    assert_same_motion(got, direct(path, taps))


def test_delays_up_to_the_whole_grid_and_beyond():
    path = quick_path()
    taps = Taps(jnp.array([0.5, 0.25, 0.125, 0.125]), jnp.array([0, 1, 400, 100_000]))
    got = shape(path, taps, N_TIMES, PER_SAMPLE, STEP)
    assert_same_motion(got, direct(path, taps))
    late = Taps(jnp.ones(1), jnp.array([100_000]))
    rest = shape(path, late, N_TIMES, PER_SAMPLE, STEP)
    np.testing.assert_array_equal(rest.position, jnp.tile(path.waypoints[0], (N_TIMES, 1)))
    assert not np.any(rest.velocity) and not np.any(rest.acceleration)


def test_single_tap_leaves_the_path_alone():
    got = shape(quick_path(), Taps(jnp.ones(1), jnp.zeros(1, int)), N_TIMES, PER_SAMPLE, STEP)
    assert_same_motion(got, sample(quick_path(), STEP * jnp.arange(N_TIMES)))


def test_shaped_paths_in_a_batch_and_their_gradients():
    path = square_path(move_time=0.01)

    @jax.jit
    def velocity(omega):
        impulses = design_shaper(SHAPERS.position("zvd"), omega, 0.01, 0.05)
        taps = split_exact(impulses, 1e-3, omega, 0.01)
        return shape_path(path, taps, 60, 5, 2e-4).velocity[37, 1]

    omegas = jnp.array([650.0, 700.0, 800.0])
    together = jax.jit(jax.vmap(velocity))(omegas)
    for omega, value in zip(omegas, together, strict=True):
        np.testing.assert_allclose(value, velocity(omega), rtol=1e-12, atol=1e-16)
    check_grads(velocity, (700.0,), order=1, modes=["fwd", "rev"], eps=1e-3, rtol=1e-6)


def test_a_path_without_moves_rests_at_its_pose():
    """As one whose only move leads to its own pose."""
    pose = np.array([[0.01, -0.02, 0.5]])
    profile = np.asarray(PROFILES.position("cycloid"))
    still = Path(pose, np.zeros(0), np.zeros(0), profile)
    moving = Path(np.repeat(pose, 2, axis=0), np.array([1e-12]), np.zeros(1), profile)
    taps = Taps(np.array([0.3, 0.7]), np.array([0, 2]))
    times = np.linspace(-0.1, 0.2, 4)
    for found, wanted in (
        (sample(still, times), sample(moving, times)),
        (shape(still, taps, 7, 2, 1e-4), shape(moving, taps, 7, 2, 1e-4)),
    ):
        for a, b in zip(found, wanted, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-15)
    assert float(end_of_path(still)) == 0


def test_points_within_samples_may_be_anywhere():
    """Those before and after a command changes, the same in every sample."""
    path, period = quick_path(), 4 * STEP
    within = np.array([0.0, 0.1, 0.2, 0.6]) * period
    late = Taps(jnp.array([0.25, 0.75]), jnp.array([0, 2]))
    found = shape(path, late, 41, 4, STEP, jnp.asarray(within)).position
    time = (np.arange(11)[:, None] * period + within).ravel()[:41]
    now, before = (sample(path, np.maximum(time - n * period, 0)).position for n in (0, 2))
    wanted = 0.25 * np.asarray(now) + 0.75 * np.asarray(before)
    np.testing.assert_allclose(found, wanted, atol=1e-14)
