"""Discrete Riccati equations by structured doubling: a fixed number of steps, differentiable.

X = A' X A - A' X B (R + B' X B)^-1 B' X A + Q (Chu, Fan, Lin and Wang 2004). Each step squares the
closed loop, so that 24 of them are as good as 16 million samples.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array

#: Doublings.
STEPS = 24


def solve_riccati(a: Array, b: Array, q: Array, r: Array) -> Array:
    """The stabilising solution X.

    Its differential solves a Stein equation, dX = Z' dX Z + dF, Z the closed loop and dF what the
    changes of A, B, Q and R do to the right-hand side at fixed X.

    Args:
        a: A, (n, n), with what B cannot reach, or Q does not see, stable.
        b: B, (n, m).
        q: Q, symmetric and not negative, (n, n).
        r: R, symmetric and positive, (m, m).

    Returns:
        (n, n).
    """
    return _solution()(a, b, q, r)


@cache
def _solution() -> Callable[..., Array]:
    """`_by_doubling` with its differential; made late, since JAX is imported late."""
    solve = jax.custom_jvp(_by_doubling)

    @solve.defjvp
    def rule(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
        a, b, _, r = primals
        x = solve(*primals)
        _, change = jax.jvp(lambda *p: _right_hand_side(x, *p), primals, tangents)
        loop = a - b @ _gain(x, a, b, r)
        return x, solve_stein(loop, change)

    return solve


def _right_hand_side(x: Array, a: Array, b: Array, q: Array, r: Array) -> Array:
    return a.T @ x @ (a - b @ _gain(x, a, b, r)) + q


def _gain(x: Array, a: Array, b: Array, r: Array) -> Array:
    """K of u = -K x, (m, n)."""
    return jnp.linalg.solve(r + b.T @ x @ b, b.T @ x @ a)


def _by_doubling(a: Array, b: Array, q: Array, r: Array) -> Array:
    eye = jnp.eye(a.shape[0], dtype=a.dtype)

    def double(carried: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, ...], None]:
        a, g, h = carried
        between = jnp.linalg.solve(eye + g @ h, jnp.concatenate([a, g], axis=1))
        n = a.shape[0]
        after, across = between[:, :n], between[:, n:]
        g = g + a @ across @ a.T
        h = h + a.T @ h @ after
        return (a @ after, (g + g.T) / 2, (h + h.T) / 2), None

    start = a, b @ jnp.linalg.solve(r, b.T), q
    (_, _, solution), _ = jax.lax.scan(double, start, None, length=STEPS)
    return solution


def solve_stein(z: Array, w: Array) -> Array:
    """X = Z' X Z + W of a stable Z, both (n, n): the sum of Z'^k W Z^k, doubled `STEPS` times."""

    def double(carried: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        z, x = carried
        return (z @ z, x + z.T @ x @ z), None

    (_, x), _ = jax.lax.scan(double, (z, w), None, length=STEPS)
    return x


def regulator_gain(a: Array, b: Array, q: Array, r: Array) -> Array:
    """K of u = -K x that minimises the sum of x'Qx + u'Ru, (m, n); arguments: `solve_riccati`."""
    x = solve_riccati(a, b, q, r)
    return _gain(x, a, b, r)


def filter_gain(a: Array, c: Array, q: Array, r: Array) -> Array:
    """M of the Kalman filter's correction x + M (y - C x), (n, k).

    Args:
        a: A, (n, n).
        c: C of y = C x + noise, (k, n).
        q: covariance of what drives the state, (n, n).
        r: of the noise, (k, k).
    """
    x = solve_riccati(a.T, c.T, q, r)
    return jnp.linalg.solve(r + c @ x @ c.T, c @ x).T
