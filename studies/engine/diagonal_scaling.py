"""Norms of D M D^-1 over diagonal D for many matrices M at once: balanced, and least."""

from __future__ import annotations

import jax
import numpy as np

from jaxmodel import scaling
from jaxmodel.parameters import Array
from studies.engine.plan import in_parts
from studies.engine.programs import kept_jit

#: Sweeps that balance rows against columns.
SWEEPS = 3
#: Matrices of a call of the program that finds the least norm.
AT_ONCE = 8


def largest_singular(matrix: np.ndarray) -> np.ndarray:
    """Of (N, m, m), (N,)."""
    power = np.conj(np.swapaxes(matrix, 1, 2)) @ matrix
    return np.sqrt(np.maximum(np.linalg.eigvalsh(power)[:, -1], 0.0))


def balanced(matrix: np.ndarray) -> np.ndarray:
    """D M D^-1 with rows and columns of nearly equal length (Osborne 1960), (N, m, m)."""
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
    log = np.clip(log - log.mean(axis=1, keepdims=True), -scaling.WIDEST, scaling.WIDEST)
    return matrix * np.exp(log[:, :, None] - log[:, None])


def best_scaling(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least norms of D M D^-1 and ln D, see `jaxmodel.scaling`.

    Args:
        matrix: M, (N, m, m).

    Returns:
        (N,), (N, m).
    """
    found = in_parts(lambda rows: _best(matrix[rows]), len(matrix), AT_ONCE, 1)
    return found[0], found[1]


@kept_jit(is_quick=True)
def _best(matrix: Array) -> tuple[Array, Array]:
    best = jax.vmap(scaling.best_scaling)(matrix)
    return best.bound, best.log_scale
