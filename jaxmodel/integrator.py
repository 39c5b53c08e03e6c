"""ETDRK4 for the modes of a link, with their analogue anti-alias filter.

In (q, q') a mode is a damped oscillator with constant coefficients; everything else is slow or
small. ETDRK4 (Cox and Matthews 2002) therefore solves the oscillator exactly and treats the rest
as forcing, one step per controller sample for any number of modes. The filter is linear and equal
on every sensor channel, so each modal coordinate q is filtered (to z) instead of each voltage:
z'' = omega_f^2 (q - z) - sqrt(2) omega_f z' (Butterworth). One 4x4 block (q, q', z, z') per mode;
where amplifiers drain the patches, a fifth entry, s' = omega_h (q - s), is subtracted from q
before the filter.
"""

from __future__ import annotations

from math import factorial
from typing import NamedTuple

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num

_DOUBLINGS = 8  # |omega h| up to 20 becomes below 0.1, where the series below is exact
_TERMS = 10


class Exponential(NamedTuple):
    """Coefficients of one step of length h; n rows and columns (q, q', z, z'; s if drained)."""

    half: Num[Array, "2 2 links Q"]  # exp(A h/2), upper left block
    half_force: Num[Array, "2 links Q"]  # h/2 phi_1(A h/2) times the force direction
    full: Num[Array, "n n links Q"]  # exp(A h)
    full_force: Num[Array, "3 n links Q"]  # ETDRK4 weights of N(u), N(a) + N(b), N(c)


def exponential_step(
    omega: Array, zeta: Array, step: Array, filter_omega: Array, highpass: Array | None = None
) -> Exponential:
    """Coefficients of ETDRK4 for q'' = -omega^2 q - 2 zeta omega q' + N and its filter.

    phi_k are computed by their series at h/2^8 and doubled: phi_k(2x) from phi_0..phi_k(x), which
    needs no division by omega h (Kassam and Trefethen 2005 avoid it with a contour mean).

    Args:
        omega: natural frequency of each mode [rad/s], (3, R).
        zeta: damping ratio [1], (3, R).
        step: h [s], ().
        filter_omega: corner of the anti-alias filter [rad/s], ().
        highpass: corner of the patches into their amplifiers [rad/s], (); None: not drained.

    Returns:
        Exponential.
    """
    zero, corner = jnp.zeros_like(omega), jnp.full_like(omega, 1.0) * filter_omega
    drain = zero if highpass is None else zero + highpass
    # balanced variables (q, q'/omega, z, z'/omega_f, s) keep every entry of the order omega
    rows = (
        (zero, omega, zero, zero, zero),
        (-omega, -2 * zeta * omega, zero, zero, zero),
        (zero, zero, zero, corner, zero),
        (corner, zero, -corner, -np.sqrt(2.0) * corner, -corner),
        (drain, zero, zero, zero, -drain),
    )
    n, one = (4 if highpass is None else 5), jnp.ones_like(omega)
    balanced = jnp.stack([jnp.stack(row[:n], axis=-1) for row in rows[:n]], axis=-2)
    scale = jnp.stack((one, omega, one, corner, one)[:n], axis=-1)

    phi = _series(balanced * (step / 2**_DOUBLINGS))
    for _ in range(_DOUBLINGS - 1):
        phi = _double(phi)
    half, full = phi, _double(phi)

    def matrix(x: Array) -> Array:
        return jnp.moveaxis(x * scale[..., :, None] / scale[..., None, :], (-2, -1), (0, 1))

    def column(x: Array) -> Array:
        return jnp.moveaxis(x[..., :, 1] * scale / scale[..., 1:2], -1, 0)

    weights = (
        full[1] - 3 * full[2] + 4 * full[3],
        2 * (full[2] - 2 * full[3]),
        4 * full[3] - full[2],
    )
    return Exponential(
        half=matrix(half[0])[:2, :2],
        half_force=step / 2 * column(half[1])[:2],
        full=matrix(full[0]),
        full_force=step * jnp.stack([column(w) for w in weights]),
    )


def _series(x: Array) -> list[Array]:
    """phi_0..phi_3 of a small matrix, phi_k = sum x^n/(n + k)!, by Horner."""
    identity = jnp.eye(x.shape[-1], dtype=x.dtype) + 0 * x
    result = []
    for k in range(4):
        total = identity / float(factorial(_TERMS + k))
        for n in reversed(range(_TERMS)):
            total = x @ total + identity / float(factorial(n + k))
        result.append(total)
    return result


def _double(phi: list[Array]) -> list[Array]:
    """phi_0..phi_3 at 2x from those at x."""
    p0, p1, p2, p3 = phi
    return [
        p0 @ p0,
        (p0 @ p1 + p1) / 2,
        (p0 @ p2 + p1 + p2) / 4,
        (p0 @ p3 + p1 / 2 + p2 + p3) / 8,
    ]
