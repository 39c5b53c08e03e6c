"""Complex numbers as pairs of real arrays, which every executor of a step can carry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pair:
    """re + j im; arithmetic is elementwise, indices and sums act on both parts."""

    re: Array
    im: Array

    def __add__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return Pair(self.re + other.re, self.im + other.im)
        return Pair(self.re + other, self.im)

    def __sub__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return Pair(self.re - other.re, self.im - other.im)
        return Pair(self.re - other, self.im)

    def __mul__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return Pair(
                self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re
            )
        return Pair(self.re * other, self.im * other)

    def __neg__(self) -> Pair:
        return Pair(-self.re, -self.im)

    def __getitem__(self, place: Any) -> Pair:
        return Pair(self.re[place], self.im[place])

    def inverse(self) -> Pair:
        """1/x, and 0 for x = 0."""
        least = float(jnp.finfo(self.re.dtype).tiny)
        size = 1 / (self.re * self.re + self.im * self.im + least)
        return Pair(self.re * size, -self.im * size)

    def sum(self, axis: int) -> Pair:
        return Pair(jnp.sum(self.re, axis=axis), jnp.sum(self.im, axis=axis))


def stacked(parts: list[Pair], axis: int = 0) -> Pair:
    """Pairs side by side on a new axis."""
    return Pair(
        jnp.stack([x.re for x in parts], axis=axis), jnp.stack([x.im for x in parts], axis=axis)
    )


def product(a: Pair, b: Pair) -> Pair:
    """Matrix products (n, I, J, ...) by (n, J, K, ...), structure first and lanes last."""
    return (a[:, :, :, None] * b[:, None]).sum(2)


def determinant(matrix: Pair) -> Pair:
    """Determinant of a small matrix (n, n, ...) by elimination without pivoting."""
    value = matrix[0, 0]
    while matrix.re.shape[0] > 1:
        factor = matrix[1:, :1] * matrix[0, 0].inverse()
        matrix = matrix[1:, 1:] - factor * matrix[:1, 1:]
        value = value * matrix[0, 0]
    return value
