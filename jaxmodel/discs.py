"""Arithmetic of discs in the complex plane: bounds that hold for a whole range of numbers.

A disc (centre, radius) contains the values of an expression for every parameter of a cell; sums,
products and inverses of discs contain those of their members (Henrici 1974, circular arithmetic).
NumPy on the host; rounding of the centres is neglected against radii far above it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.parameters import Array


class Disc(NamedTuple):
    """All z with |z - mid| <= rad, entry by entry; both arrays of one shape or broadcast."""

    mid: Array
    rad: Array

    def __add__(self, other: Disc) -> Disc:  # type: ignore[override]
        return Disc(self.mid + other.mid, self.rad + other.rad)

    def __mul__(self, other: Disc) -> Disc:  # type: ignore[override]
        rad = np.abs(self.mid) * other.rad + self.rad * (np.abs(other.mid) + other.rad)
        return Disc(self.mid * other.mid, rad)

    def __matmul__(self, other: Disc) -> Disc:
        rad = np.abs(self.mid) @ other.rad + self.rad @ (np.abs(other.mid) + other.rad)
        return Disc(self.mid @ other.mid, rad)

    def scaled(self, factor: Array) -> Disc:
        """Times exact numbers."""
        return Disc(self.mid * factor, self.rad * np.abs(factor))

    def inverse(self, least: Array | None = None) -> Disc:
        """Of the members, 1/z.

        Args:
            least: lower bound of |z| from elsewhere, for discs that contain 0; None: those get an
                infinite radius.
        """
        size = np.abs(self.mid)
        is_clear = size > 1.5 * self.rad
        safe = np.where(is_clear, self.mid, 1.0)
        slack = np.where(is_clear, size - self.rad, 1.0)
        rad = np.where(is_clear, self.rad / (np.abs(safe) * slack), np.inf)
        mid = np.where(is_clear, 1 / safe, 0.0)
        if least is None:
            return Disc(mid, rad)
        is_far = rad + np.abs(mid) > 3 / least  # the bound from elsewhere is the tighter one
        return Disc(np.where(is_far, 0.0, mid), np.where(is_far, 1 / least, rad))


def interval(low: Array, high: Array) -> Disc:
    """The disc over a real interval."""
    return Disc((low + high) / 2, (high - low) / 2)


def phase(angle: Disc) -> Disc:
    """exp(-i angle) of real intervals."""
    return Disc(np.exp(-1j * angle.mid), np.minimum(angle.rad, 2.0))


def excludes_zero(matrix: Disc, inverse: Array | None = None) -> Array:
    """A number below 1 if no member of a disc of matrices is singular, (...).

    Members are F0 (1 + F0^-1 E) with |E| <= R entry by entry: nonsingular where the spectral radius
    of |F0^-1| R is below 1 (Rump 1994), bounded from above by max((A v)/v) of a positive vector v
    (Collatz and Wielandt), which is found by a few steps of the power method.

    Args:
        matrix: (..., n, n).
        inverse: of its centre, if known.
    """
    inverse = np.linalg.inv(matrix.mid) if inverse is None else inverse
    size = np.abs(inverse)
    vector = np.ones((*size.shape[:-1], 1))
    least: Array = np.inf
    for _ in range(5):
        after = size @ (matrix.rad @ vector)
        ratio = np.max(after / vector, axis=(-2, -1))
        least = np.minimum(least, np.where(np.isfinite(ratio), ratio, np.inf))
        largest = np.max(after, axis=(-2, -1), keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            vector = after / largest + 1e-9
        vector = np.where(np.isfinite(vector), vector, 1.0)
    return least


def inverse_of(matrix: Disc) -> Disc:
    """Inverses of a disc of matrices, (..., n, n); infinite radii where one may be singular.

    With B = |F0^-1| R of norm below 1, |F^-1 - F0^-1| <= B |F0^-1|/(1 - ||B||) in every row's sum
    norm; entry by entry (1 - B)^-1 B |F0^-1|.
    """
    mid = np.linalg.inv(matrix.mid)
    step = np.abs(mid) @ matrix.rad
    norm = np.max(np.sum(step, axis=-1), axis=-1)[..., None, None]
    is_clear = norm < 0.9
    first = step @ np.abs(mid)
    # first + B first + B^2 first + ... <= first + B first + the rest by norms
    second = step @ first
    slack = np.where(is_clear, 1 - norm, 1.0)
    tail = norm / slack * np.max(second, axis=-2, keepdims=True)
    rad = np.where(is_clear, first + second + tail, np.inf)
    return Disc(mid, rad)


def largest_over(tables: list[Array], omega: Disc, period: float) -> Array:
    """Largest entries of a table by slices of [0, pi/T] over intervals of omega, (cells, ...).

    Args:
        tables: from `maxima_over_slices`.
        omega: intervals [rad/s], (cells,).
        period: T [s].
    """
    count = len(tables[0])
    scale = count * period / np.pi
    first = np.clip(((omega.mid - omega.rad) * scale).astype(int), 0, count - 1)
    last = np.clip(((omega.mid + omega.rad) * scale).astype(int), 0, count - 1)
    level = np.floor(np.log2(last - first + 1)).astype(int)
    together = np.stack(tables)
    return np.maximum(together[level, first], together[level, last + 1 - 2**level])


def maxima_over_slices(table: Array) -> list[Array]:
    """Maxima of a table over 1, 2, 4, ... slices from each one on, for `largest_over`."""
    levels, width = [table], 1
    while 2 * width <= len(table):
        last, after = levels[-1], levels[-1].copy()
        after[:-width] = np.maximum(last[:-width], last[width:])
        levels.append(after)
        width *= 2
    return levels
