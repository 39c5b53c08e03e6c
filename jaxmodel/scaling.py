"""Upper bound of the structured singular value for one complex uncertainty per channel.

mu(M) <= min over diagonal D > 0 of the largest singular value of D M D^-1 (Doyle 1982). With
D = exp(x) that is convex in x. For gamma above sigma^2 so are -log det(gamma - A'A), A = D M D^-1,
whose minima lead to the best D as gamma falls: a method of centres (Boyd and El Ghaoui 1993) with
Newton's steps in closed form, at most `STEPS` of them, also where singular values coincide.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Complex, Num

#: Sweeps that balance rows against columns, and steps of the method of centres.
SWEEPS, STEPS = 6, 64
#: Distance of gamma from sigma^2, as a share of it: first, last, and its factor in a step.
FIRST, LAST, SHRINK = 0.3, 1e-9, 0.45
#: Such a distance, and Newton's steps to its centre, for the slope.
NEAR, CENTRING = 1e-6, 12
#: Newton decrement below which gamma may fall, and the largest |x| [1].
CENTRED, WIDEST = 0.5, 25.0


class BestScaling(NamedTuple):
    """Of a matrix M."""

    bound: Num[Array, ""]  # smallest largest singular value of D M D^-1
    log_scale: Num[Array, "n"]  # ln of D's diagonal
    slope: Complex[Array, "n n"]  # G: the bound changes by Re sum(conj(G) dM)


def _balance(matrix: Array, sweeps: int = SWEEPS) -> Array:
    """ln of the diagonal of D that minimises the sum of squares (Osborne 1960), (n,)."""
    n = matrix.shape[0]
    square = jnp.abs(matrix) ** 2 * (1 - np.eye(n))

    def balance(number: Array, x: Array) -> Array:
        k, factor = number % n, jnp.exp(2 * x)
        row = factor[k] * jnp.sum(square[k] / factor)
        column = jnp.sum(factor * square[:, k]) / factor[k]
        is_there = (row > 0) & (column > 0)
        ratio = jnp.where(is_there, column, 1.0) / jnp.where(is_there, row, 1.0)
        return x.at[k].add(jnp.log(ratio) / 4)

    x = jax.lax.fori_loop(0, sweeps * n, balance, jnp.zeros(n, square.dtype))
    return jnp.clip(x - jnp.mean(x), -WIDEST, WIDEST)


def _apply(matrix: Array, x: Array) -> Array:
    return matrix * jnp.exp(x[:, None] - x)


def best_scaling(matrix: Array) -> BestScaling:
    """The best diagonal scaling of M, to 1e-8; not to be differentiated, see `slope`.

    Args:
        matrix: M, complex, (n, n).

    Returns:
        BestScaling.

    Example:
        >>> best_scaling(jnp.array([[0.0, 4.0], [1.0, 0.0]])).bound  # doctest: +SKIP
        Array(2., dtype=float64)
    """
    matrix = matrix + 0j

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        number, x, distance, least, best = state
        square = _square_norm(matrix, x)
        best = jnp.where(square < least, x, best)
        x, decrement = _newton(matrix, x, square * (1 + distance))
        distance = jnp.where(decrement < CENTRED, distance * SHRINK, distance)
        return number + 1, x, distance, jnp.minimum(square, least), best

    x = _balance(matrix)
    start = 0, x, jnp.array(FIRST, x.dtype), jnp.array(jnp.inf, x.dtype), x
    *_, x = jax.lax.while_loop(lambda state: (state[0] < STEPS) & (state[2] > LAST), step, start)
    square = jnp.maximum(_square_norm(matrix, x), 0.0)
    return BestScaling(jnp.sqrt(square), x, _slope(matrix, x, square * (1 + NEAR)))


def _square_norm(matrix: Array, x: Array) -> Array:
    a = _apply(matrix, x)
    return jnp.linalg.eigvalsh(jnp.conj(a.T) @ a)[-1]


def _newton(matrix: Array, x: Array, gamma: Array) -> tuple[Array, Array]:
    """A damped step towards the centre of gamma, (n,), and Newton's decrement before it."""
    gradient, curvature = _barrier(_apply(matrix, x), gamma)
    move = -jnp.linalg.solve(curvature, gradient)
    decrement = jnp.sqrt(jnp.maximum(-jnp.sum(move * gradient), 0.0))
    return jnp.clip(x + move / (1 + decrement), -WIDEST, WIDEST), decrement


def _slope(matrix: Array, x: Array, gamma: Array) -> Array:
    """Slope of the bound at the centre of gamma.

    There (gamma - A'A)^-1 weighs singular vectors as the minimum does, several where some coincide.
    At the best D itself it would not: no derivative is zero there.
    """
    x = jax.lax.fori_loop(0, CENTRING, lambda _, x: _newton(matrix, x, gamma)[0], x)
    a = _apply(matrix, x)
    weight = jnp.linalg.inv(gamma * np.eye(a.shape[0]) - jnp.conj(a.T) @ a)
    size = jnp.real(jnp.trace(weight)) * jnp.sqrt(gamma)
    return a @ weight / size * jnp.exp(x[:, None] - x)


def _barrier(a: Array, gamma: Array) -> tuple[Array, Array]:
    """Derivatives of -log det(gamma - A'A) by x where A = exp(x) A exp(-x), (n,) and (n, n).

    With B = A'A, W = (gamma - B)^-1 and dB = A'XA + (A'XA)' - XB - BX they are tr(W dB) and
    tr(W dB W dB) + tr(W d^2 B).
    """
    n = a.shape[0]
    b = jnp.conj(a.T) @ a
    w = jnp.linalg.inv(gamma * np.eye(n) - b)
    p, v = a @ w, w @ b
    c, q, u = p @ jnp.conj(a.T), a @ v, v @ b
    diagonal = jnp.real(jnp.diagonal(c)), jnp.real(jnp.diagonal(v))
    cross = jnp.real(a * jnp.conj(p)) + jnp.real(p * jnp.conj(q))
    curvature = (
        4 * jnp.abs(c) ** 2
        + 2 * jnp.abs(v) ** 2
        + 2 * jnp.real(jnp.conj(w) * (u + b))
        - 4 * (cross + cross.T)
        + jnp.diag(4 * diagonal[0] + 2 * diagonal[1])
    )
    # x is free up to a constant, and where a channel does nothing
    size = jnp.mean(jnp.diagonal(curvature)) + jnp.finfo(curvature.dtype).tiny
    curvature = curvature + size * (np.ones((n, n)) / n + 1e-10 * np.eye(n))
    return 2 * (diagonal[0] - diagonal[1]), curvature
