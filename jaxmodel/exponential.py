"""The exponential of a matrix whose states have any units: exact transitions over a time."""

from __future__ import annotations

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array

#: Rounds of balancing; 12 bring units that differ by 1e12 to a common size.
ROUNDS = 12


def exponential(matrix: Array, time: Array) -> Array:
    """e^(A t), balanced first.

    Entries of a plant range from 1 to omega^2. Squared as they are, they cost digits, and beyond
    2^16 JAX's scaling and squaring gives NaN, whatever the eigenvalues are. The states are scaled
    by powers of two, which rounds nothing, so that rows and columns have equal sums (E. E. Osborne,
    On pre-conditioning of matrices, J. ACM 7, 1960; all states at once, with half the step).

    Args:
        matrix: A [1/s], (n, n); rows of zeros are inputs, held meanwhile.
        time: t [s], ().

    Returns:
        (n, n).

    Example:
        >>> exponential(jnp.array([[0.0, 1.0], [-1e12, 0.0]]), 1e-6)[0, 0]  # cos(1)
        Array(0.54030231, dtype=float64)
    """
    scale = _scale(jax.lax.stop_gradient(matrix))
    exact = jax.scipy.linalg.expm(matrix / scale[:, None] * scale * time)
    return exact * scale[:, None] / scale


def _scale(matrix: Array) -> Array:
    """Powers of two by which states are larger than balanced ones, (n,)."""
    size = jnp.abs(matrix) * (1 - jnp.eye(len(matrix), dtype=matrix.dtype))

    def evened(_: int, power: Array) -> Array:
        now = size * jnp.exp2(power - power[:, None])
        row, column = now.sum(axis=1), now.sum(axis=0)
        is_input = (row == 0) & (column > 0)
        row = jnp.where(is_input, now.max(), row)  # as large as it may be without a squaring more
        has_both = (row > 0) & (column > 0)
        ratio = jnp.where(has_both, row, 1.0) / jnp.where(has_both, column, 1.0)
        return power + jnp.log2(ratio) / jnp.where(is_input, 1, 4)

    power = jax.lax.fori_loop(0, ROUNDS, evened, jnp.zeros(len(matrix), matrix.dtype))
    return jnp.exp2(jnp.round(power))
