"""Building blocks of modal laws: modal filter, synthesizer, pole placement (22)-(23), EMC (24).

Matrices act per link. A controller is data: channel signals y = `filter` V_s, rates of them from
the estimator, channel forces, and V_a = `synthesizer` f. IMSC has one channel per controlled mode,
strain rate feedback one per patch.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num


class PoleGains(NamedTuple):
    """Feedback gains per unit modal mass."""

    position: Num[Array, "..."]  # k_p [1/s2]
    velocity: Num[Array, "..."]  # k_d [1/s]


def pole_placement(
    decay: Num[Array, "..."], damped_frequency: Num[Array, "..."], omega: Num[Array, "..."]
) -> PoleGains:
    """Gains that put a mode's poles at -alpha +- j beta, (22)-(23).

    k_d = 2 alpha, k_p = alpha^2 + beta^2 - omega^2.

    Args:
        decay: alpha-bar [1/s].
        damped_frequency: beta-bar [rad/s].
        omega: natural frequency of the mode [rad/s].

    Returns:
        PoleGains per unit modal mass; times m_j they are in N/m and N s/m.

    Example:
        >>> gains = pole_placement(20.0, 700.0, 700.0)
        >>> gains.velocity, gains.position
        (40.0, 400.0)
    """
    return PoleGains(decay**2 + damped_frequency**2 - omega**2, 2 * decay)


def efficient_modal_control(
    energy: Num[Array, "... C"], omega: Num[Array, "... C"]
) -> Num[Array, "... C"]:
    """EMC ratios k_dj : k_d1 = (E_j/E_1) (omega_1/omega_j), (24).

    Args:
        energy: time mean of the open-loop modal energy [m2/s2].
        omega: modal frequencies [rad/s].

    Returns:
        The first ratio is 1. All ones where mode 1 has no energy.

    Example:
        >>> energy, omega = jnp.array([4.0, 1.0]), jnp.array([700.0, 2800.0])
        >>> efficient_modal_control(energy, omega).tolist()
        [1.0, 0.0625]
    """
    first = energy[..., :1]
    is_quiet = first <= 0
    ratio = energy / jnp.where(is_quiet, 1.0, first) * omega[..., :1] / omega
    return jnp.where(is_quiet, 1.0, ratio)


def active_modes(n_active: Array, n_controlled: int, n_patches: int) -> Array:
    """Mask of the first `n_active` modes, never more than there are patches, (C,)."""
    order = jnp.arange(n_controlled)
    return ((order < n_active) & (order < n_patches)).astype(jnp.result_type(float))


def left_inverse(matrix: Array, mask: Array) -> Array:
    """pinv of the columns of `matrix` (K, C) whose mask is 1; rows of the others are zero, (C, K).

    Modal filter: left_inverse(lambda_s Phi_s^t); synthesizer: left_inverse(lambda_a Phi_a^t)^t.
    Uses normal equations with unit columns: accurate to 1e-9 at usable condition numbers (below
    1e3), and easy to differentiate.
    """
    masked = matrix * mask
    norm = jnp.sqrt(jnp.sum(masked * masked, axis=-2, keepdims=True) + (1 - mask))
    unit = masked / norm
    gram = jnp.swapaxes(unit, -1, -2) @ unit + jnp.eye(mask.size) * (1 - mask)
    return jnp.linalg.solve(gram, jnp.swapaxes(unit, -1, -2)) / jnp.swapaxes(norm, -1, -2)


def condition_number(matrix: Array, mask: Array) -> Array:
    """2-norm condition number of the active columns of `matrix` (..., K, C), (...)."""
    masked = jax.lax.stop_gradient(matrix * mask)
    gram = jnp.swapaxes(masked, -1, -2) @ masked
    # inactive columns get the mean eigenvalue, which is never the largest nor the smallest
    mean = jnp.trace(gram, axis1=-2, axis2=-1) / jnp.maximum(jnp.sum(mask), 1)
    gram = gram + jnp.eye(mask.size) * (1 - mask) * mean[..., None, None]
    value = jnp.linalg.eigvalsh(gram)
    # at this floor, squaring has lost all digits
    floor = value[..., -1] * 10 * jnp.finfo(gram.dtype).eps
    return jnp.sqrt(value[..., -1] / jnp.maximum(value[..., 0], floor))


def force_gains(first_gain: Array, ratio: Array, modal_mass: Array, is_per_mass: Array) -> Array:
    """Modal force gains [N s/m] (or [N/m]) from the first mode's gain and the ratios (24).

    Args:
        first_gain: gain of mode 1 per link, in N s/m, or in 1/s where `is_per_mass`, (3,).
        ratio: k_dj : k_d1 [1], (3, C).
        modal_mass: of the controller's basis [kg], (3, C).
        is_per_mass: 1 where the gain multiplies modal acceleration as in (20)-(21), else 0.

    Returns:
        (3, C).
    """
    unit = 1 + is_per_mass * (modal_mass - 1)
    return first_gain[:, None] * ratio * unit
