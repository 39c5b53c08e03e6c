"""Least norms of D M D^-1 over diagonal D for many matrices M at once, in NumPy.

The method of `jaxmodel.scaling`, to the accuracy that a search needs.
"""

from __future__ import annotations

import numpy as np

#: Sweeps that balance rows against columns.
SWEEPS = 3
#: Distance of gamma from sigma^2, as a share of it: first, last, its factor.
FIRST, LAST, SHRINK = 0.1, 1e-5, 0.3
#: Newton decrement below which gamma may fall, steps at most, and the largest |ln D|.
CENTRED, STEPS, WIDEST = 0.7, 40, 25.0


def largest_singular(matrix: np.ndarray) -> np.ndarray:
    """Of (N, m, m), (N,)."""
    power = np.conj(np.swapaxes(matrix, 1, 2)) @ matrix
    return np.sqrt(np.maximum(np.linalg.eigvalsh(power)[:, -1], 0.0))


def balanced(matrix: np.ndarray) -> np.ndarray:
    """D M D^-1 with rows and columns of nearly equal length, (N, m, m)."""
    log = _balance(matrix)
    return matrix * np.exp(log[:, :, None] - log[:, None])


def _balance(matrix: np.ndarray) -> np.ndarray:
    """ln D that nearly minimises the sum of squares, (N, m)."""
    m = matrix.shape[1]
    square = np.ascontiguousarray(np.moveaxis(matrix.real**2 + matrix.imag**2, 0, -1))
    square[np.arange(m), np.arange(m)] = 0.0
    square += 1e-30 * square.max(axis=(0, 1)) + 1e-300  # where a channel acts on nothing
    scale = np.ones((m, matrix.shape[0]))
    for _ in range(SWEEPS):
        for k in range(m):
            factor = np.sqrt(square[:, k].sum(axis=0) / square[k].sum(axis=0))
            square[k] *= factor
            square[:, k] /= factor
            scale[k] *= factor
    log = np.log(scale).T / 2
    return np.clip(log - log.mean(axis=1, keepdims=True), -WIDEST, WIDEST)


def best_scaling(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least norms of D M D^-1 to 1e-4, from above, and ln D; see `jaxmodel.scaling`.

    Args:
        matrix: M, (N, m, m).

    Returns:
        (N,), (N, m).
    """
    x = _balance(matrix)
    distance = np.full(len(x), FIRST)
    least, best = np.full(len(x), np.inf), x
    for _ in range(STEPS):
        a = matrix * np.exp(x[:, :, None] - x[:, None])
        power = np.conj(np.swapaxes(a, 1, 2)) @ a
        square = np.linalg.eigvalsh(power)[:, -1]
        is_less = square < least
        best, least = np.where(is_less[:, None], x, best), np.minimum(least, square)
        if np.all(distance < LAST):
            break
        gradient, curvature = _barrier(a, power, square * (1 + np.maximum(distance, LAST)))
        move = -np.linalg.solve(curvature, gradient[..., None])[..., 0]
        decrement = np.sqrt(np.maximum(-np.sum(move * gradient, axis=1), 0.0))
        x = np.clip(x + move / (1 + decrement)[:, None], -WIDEST, WIDEST)
        distance = np.where(decrement < CENTRED, distance * SHRINK, distance)
    return np.sqrt(least), best


def _barrier(a: np.ndarray, b: np.ndarray, gamma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of -log det(gamma - A'A) by ln D, B = A'A, (N, m) and (N, m, m)."""
    m = a.shape[1]
    eye = np.eye(m)
    w = np.linalg.inv(gamma[:, None, None] * eye - b)
    p, v = a @ w, w @ b
    c, q, u = p @ np.conj(np.swapaxes(a, 1, 2)), a @ v, v @ b
    of_c, of_v = (np.real(np.diagonal(x, axis1=1, axis2=2)) for x in (c, v))
    cross = np.real(a * np.conj(p)) + np.real(p * np.conj(q))
    curvature = (
        4 * (c.real**2 + c.imag**2)
        + 2 * (v.real**2 + v.imag**2)
        + 2 * np.real(np.conj(w) * (u + b))
        - 4 * (cross + np.swapaxes(cross, 1, 2))
        + (4 * of_c + 2 * of_v)[:, :, None] * eye
    )
    size = np.mean(np.diagonal(curvature, axis1=1, axis2=2), axis=1)[:, None, None] + 1e-300
    curvature = curvature + size * (np.ones((m, m)) / m + 1e-10 * eye)
    return 2 * (of_c - of_v), curvature
