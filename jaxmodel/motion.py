"""Reference motion of the platform: point-to-point moves (25) and their shaped form."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.shaper import Taps
from jaxmodel.table import Table


class Path(NamedTuple):
    """Straight moves between waypoints, each from rest to rest, with a pause after each.

    Without moves, n = 0, the platform rests; what depends on its command alone is then computed
    once for all cases of a batch.
    """

    waypoints: Num[Array, "n+1 pose"]  # (x, y, phi) [m, m, rad]
    move_time: Num[Array, "n"]  # duration of each move, positive [s]
    dwell: Num[Array, "n"]  # pause after each move, the last one included [s]
    profile: Num[Array, ""]  # position of the time law in `PROFILES` [1]


class PathSample(NamedTuple):
    """Pose of the platform with its rates."""

    position: Num[Array, "... pose"]  # [m, m, rad]
    velocity: Num[Array, "... pose"]  # [m/s, m/s, rad/s]
    acceleration: Num[Array, "... pose"]  # [m/s2, m/s2, rad/s2]


def move_starts(path: Path) -> Array:
    """Return the start of each move, t_k = sum_{l<k} (tf_l + dwell_l) [s], shape (n,)."""
    ends = jnp.cumsum(path.move_time + path.dwell)
    return jnp.pad(ends[:-1], (1, 0))


def end_of_path(path: Path) -> Array:
    """Return the end of the last move [s], shape (); the last dwell does not count."""
    if not len(path.move_time):
        return jnp.zeros_like(path.waypoints[0, 0])
    return move_starts(path)[-1] + path.move_time[-1]


def cycloid(u: Array) -> tuple[Array, Array, Array]:
    """Return (25), s = u - sin(2 pi u)/(2 pi), with s' and s'' for u in [0, 1] [1]."""
    # Subtracting the whole turn makes the end exact: no acceleration is left at u = 1.
    angle = 2 * np.pi * (u - jnp.round(u))
    sine = jnp.sin(angle)
    return u - sine / (2 * np.pi), 1 - jnp.cos(angle), 2 * np.pi * sine


def quintic(u: Array) -> tuple[Array, Array, Array]:
    """Return s = 10 u^3 - 15 u^4 + 6 u^5 with s' and s'' for u in [0, 1] [1]."""
    rest = 1 - u
    return (
        u**3 * (10 - 15 * u + 6 * u**2),
        30 * (u * rest) ** 2,
        60 * u * rest * (1 - 2 * u),
    )


class Profile(NamedTuple):
    """A time law of moves from rest to rest."""

    name: str
    time_law: Callable[[Array], tuple[Array, Array, Array]]  # s, s', s'' of u in [0, 1] [1]


#: To add one: its function above, and an entry here.
PROFILES = Table("motion profile", (Profile("cycloid", cycloid), Profile("quintic", quintic)))


def sample_path(path: Path, time: Array) -> PathSample:
    """Return the pose and its rates at the given times.

    X(t) = w_0 + sum_k (w_{k+1} - w_k) s(clip((t - t_k)/tf_k, 0, 1)): at rest at the first waypoint
    before 0 and at the last one after the end. s: the path's profile, usually (25).

    Args:
        path: the moves.
        time: instants [s], shape (...,).

    Returns:
        PathSample with arrays of shape (..., 3).
    """
    path = jax.tree.map(jnp.asarray, path)
    if not len(path.move_time):
        return _resting(path, jnp.shape(time))
    starts = move_starts(path)
    steps = jnp.diff(path.waypoints, axis=0)
    last = len(path.move_time) - 1

    def at(instant: Array) -> PathSample:
        # Only one move at a time differs from rest, so the sum is its starting point plus one term.
        k = jnp.clip(jnp.sum(instant >= starts) - 1, 0, last)
        duration = path.move_time[k]
        u = jnp.clip((instant - starts[k]) / duration, 0, 1)
        laws = [profile.time_law(u) for profile in PROFILES.values()]
        which = path.profile.astype(jnp.int32)
        s, rate, bend = (jax.lax.select_n(which, *values) for values in zip(*laws, strict=True))
        return PathSample(
            path.waypoints[k] + s * steps[k],
            rate / duration * steps[k],
            bend / duration**2 * steps[k],
        )

    return PathSample(*jnp.vectorize(at, signature="()->(d),(d),(d)")(time))


def _resting(path: Path, shape: tuple[int, ...]) -> PathSample:
    pose = jnp.broadcast_to(path.waypoints[0], (*shape, path.waypoints.shape[-1]))
    return PathSample(pose, jnp.zeros_like(pose), jnp.zeros_like(pose))


def shape_path(
    path: Path, taps: Taps, n_times: int, per_sample: int, step: Array, within: Array | None = None
) -> PathSample:
    """Return the path convolved with a sampled input shaper, on the grid t_j = j h.

    X_ref(t) = sum_i W_i X(t - n_i T) with T = per_sample h. The path is evaluated once on the grid
    and shifted by whole grid steps for each tap.

    Args:
        path: the moves.
        taps: weights W_i [1] and delays n_i [samples], not negative, shape (m,).
        n_times: number of grid points, positive, static [1].
        per_sample: grid steps in one sample period, static [1].
        step: h, grid step [s], shape ().
        within: when the points of a sample are, from its start [s], shape (per_sample,); None: a
            grid step apart.

    Returns:
        PathSample with arrays of shape (n_times, 3).
    """
    if not len(path.move_time):
        return _resting(path, (n_times,))
    time = step * jnp.arange(n_times)
    if within is not None:
        sample, point = np.divmod(np.arange(n_times), per_sample)
        time = step * per_sample * sample + within[point]
    # time last, where neighbours in memory are added together
    rows = jnp.concatenate([x.T for x in sample_path(path, time)])
    # The path is at rest at t = 0, so its first value also holds before that.
    padded = jnp.pad(rows, ((0, 0), (n_times, 0)), mode="edge")
    shifts = jnp.clip(taps.sample * per_sample, 0, n_times)

    def add(total: Array, tap: tuple[Array, Array]) -> tuple[Array, None]:
        weight, shift = tap
        late = jax.lax.dynamic_slice_in_dim(padded, n_times - shift, n_times, 1)
        return total + weight * late, None

    total = jax.lax.scan(add, jnp.zeros_like(rows), (taps.weight, shifts), unroll=2)[0]
    return PathSample(*(x.T for x in jnp.split(total, 3)))
