"""Modal bases of a link (4). A basis is data: the dynamics reads only `ModalBasis`.

- `pinned_pinned`: Y_j = sin(j pi x/L), the frame turns with the chord B-C, Y_j(L) = 0.
- `pinned_free`: tan kL = tanh kL, Y_j(L) = 1, the frame is tangent-like as in the paper.
- `loaded`: the real link, with the patches' mass and stiffness and rotary inertia at its joints,
  by Rayleigh-Ritz; Y_j(L) = 0. The term sum m_j q_j^2 in the kinetic energy is then approximate.

A gain in N s/m assumes a mode-shape scale: unit tip for `pinned_free` (m_j = m_b/4), unit
amplitude for `pinned_pinned` (m_j = m_b/2), modal mass half the link's for `loaded`.

To add one: a function of a link's data that returns `ModalBasis`, and its entry in `BASES`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Beam, Patches
from jaxmodel.piezo import bare_stiffness, one_sided_section, patch_ends, two_sided_section
from jaxmodel.table import Table

_Parts = TypeVar("_Parts", Beam, Patches)


class ModalBasis(NamedTuple):
    """What the dynamics needs to know about three links with R modes each."""

    # m_j = int rhoA Y_j^2 [kg], (3, R); shapes are scaled so that it is the same for every mode
    mass: Array
    stiffness: Array  # k_j [N/m], (3, R)
    tip: Array | None  # Y_j(L) [1], (3, R); None where it is zero for every mode
    # S_jk = int Y_j' Y_k' dx: a bent link's chord is shorter than the link by 1/2 sum S_jk q_j q_k
    shortening: Array | None  # S_jj [1/m], (3, R); None where the ends are not on the chord
    mixed_shortening: Array | None  # S_jk, zero for j = k [1/m], (3, R, R); None where all zero
    b: Array  # int rhoA Y_j [kg], (3, R)
    c: Array  # int rhoA x Y_j (and joint inertia) [kg m], (3, R)
    link_mass: Array  # m_b [kg], (3,)
    first_moment: Array  # e = int rhoA x [kg m], (3,)
    inertia: Array  # J0 = int rhoA x^2 + J_B + J_C [kg m2], (3,)
    deflection_at: Array  # Y_j at `stations` minus the chord's (x/L) Y_j(L) [1], (3, S, R)
    sensor_slope: Array  # Phi_s: Y_j' at right minus left sensor end [1/m], (3, R, n_patches)
    actuator_slope: Array  # Phi_a: the same for the actuators [1/m], (3, R, n_patches)


class Basis(NamedTuple):
    """A family of mode shapes: its properties, and how to compute it for one link."""

    name: str
    modes: Callable[[Beam, Patches, int, Array], ModalBasis]  # of R modes, deflection at stations
    is_on_chord: bool  # both ends lie on the frame's axis: Y_j(L) = 0
    has_joints: bool = False  # includes rotary inertia at the joints


def build_basis(
    kind: str, beam: Beam, patches: Patches, n_modes: int, stations: Array, mode_mask: Array = 1.0
) -> ModalBasis:
    """Modal basis of all links, usually three.

    Args:
        kind: name of one of `BASES` (static).
        beam: link data, () or (3,) fields.
        patches: patch data, () or (3,) fields; one row of centres per link.
        n_modes: R, modes per link (static).
        stations: where to take the chord deflection [m], (S,), or (3, S) for links with
            positions of their own.
        mode_mask: 1 for modes that exist, 0 for modes switched off, () or (R,). A mode that is off
            keeps its oscillator but couples to nothing, so it stays at rest.

    Returns:
        ModalBasis with the true bending stiffness (with `stiffness_factor`).

    Raises:
        ValueError: unknown kind, or no modes.
    """
    if kind not in BASES:
        raise ValueError(f"basis = {kind!r}; allowed: {', '.join(BASES)}")
    if n_modes < 1:
        raise ValueError(f"n_modes = {n_modes}; allowed: 1 or more [1]")
    centers = jnp.asarray(patches.center)
    n_links = len(centers)
    stations = jnp.asarray(stations)
    stations = jnp.broadcast_to(stations, (n_links, stations.shape[-1]))
    own = _each_link(patches._replace(center=0.0), n_links)._replace(center=centers)

    def one_link(beam_i: Beam, patches_i: Patches, stations_i: Array) -> ModalBasis:
        return BASES[kind].modes(beam_i, patches_i, n_modes, stations_i)

    return mask_modes(jax.vmap(one_link)(_each_link(beam, n_links), own, stations), mode_mask)


def _each_link(parts: _Parts, n_links: int) -> _Parts:
    """Link data, broadcast to one value per link."""
    return type(parts)(*(jnp.broadcast_to(jnp.asarray(field), (n_links,)) for field in parts))


def mask_modes(basis: ModalBasis, mode_mask: Array) -> ModalBasis:
    """Switch modes off, see `build_basis`."""
    mask = jnp.broadcast_to(jnp.asarray(mode_mask, basis.mass.dtype), basis.mass.shape[1:])

    def kept(x: Array | None, mask: Array) -> Array | None:
        return None if x is None else x * mask

    return basis._replace(
        tip=kept(basis.tip, mask),
        shortening=kept(basis.shortening, mask),
        mixed_shortening=kept(basis.mixed_shortening, mask * mask[:, None]),
        b=basis.b * mask,
        c=basis.c * mask,
        deflection_at=basis.deflection_at * mask,
        sensor_slope=basis.sensor_slope * mask[:, None],
        actuator_slope=basis.actuator_slope * mask[:, None],
    )


def held_frequency(kind: str, beam: Beam, basis: ModalBasis) -> Array:
    """Frequencies of links with held ends [rad/s], (3, R).

    This is how links vibrate in the assembled machine (docs/theory.md). A basis whose ends lie on
    the chord has these frequencies itself; any other describes links that no platform holds, so
    the bare link's (j pi)^2 sqrt(E I/(rhoA L^4)) replace its own.

    Args:
        kind: modal basis (static).
        beam: link data, () or (3,) fields.
        basis: of that kind and beam.
    """
    if BASES[kind].is_on_chord:
        return jnp.sqrt(basis.stiffness / basis.mass)
    beam = _each_link(beam, basis.mass.shape[0])
    order = jnp.arange(1, basis.mass.shape[1] + 1)
    line_mass = beam.density * beam.width * beam.thickness
    root = jnp.sqrt(bare_stiffness(beam) * beam.stiffness_factor / line_mass) / beam.length**2
    return (order * np.pi) ** 2 * root[:, None]


def pinned_free_roots(n_modes: int) -> np.ndarray:
    """The first roots kL of tan kL = tanh kL (3.9266, 7.0686, ...), by fixed-point iteration."""
    order = np.arange(1, n_modes + 1)
    root = (order + 0.25) * np.pi
    for _ in range(4):
        root = order * np.pi + np.arctan(np.tanh(root))
    return root


def _rigid(beam: Beam) -> tuple[Array, Array, Array, Array]:
    line_mass = beam.density * beam.width * beam.thickness
    mass = line_mass * beam.length
    return line_mass, mass, mass * beam.length / 2, mass * beam.length**2 / 3


def _slope_difference(slope: Callable[[Array], Array], patches: Patches, length: Array) -> Array:
    left, right = patch_ends(patches.center, length)
    return slope(right) - slope(left)


def _pinned_pinned(beam: Beam, patches: Patches, n_modes: int, stations: Array) -> ModalBasis:
    order = jnp.arange(1, n_modes + 1)
    wave = order * np.pi / beam.length
    line_mass, mass, moment, inertia = _rigid(beam)
    sign = jnp.where(order % 2 == 1, 1.0, -1.0)  # -cos(j pi)
    stiffness = bare_stiffness(beam) * beam.stiffness_factor * wave**4 * beam.length / 2

    def slope(x: Array) -> Array:
        return wave[:, None] * jnp.cos(wave[:, None] * x)

    return ModalBasis(
        mass=jnp.full((n_modes,), 0.5) * mass,
        stiffness=stiffness,
        tip=None,
        shortening=wave**2 * beam.length / 2,
        mixed_shortening=None,
        b=line_mass * (1 + sign) / wave,
        c=line_mass * beam.length * sign / wave,
        link_mass=mass,
        first_moment=moment,
        inertia=inertia,
        deflection_at=jnp.sin(wave * stations[:, None]),
        sensor_slope=_slope_difference(slope, patches, patches.sensor_length),
        actuator_slope=_slope_difference(slope, patches, patches.actuator_length),
    )


def _pinned_free(beam: Beam, patches: Patches, n_modes: int, stations: Array) -> ModalBasis:
    # Y = (sin kx/sin kL + sinh kx/sinh kL)/2, the hyperbolic ratio in a form that cannot overflow
    root = jnp.asarray(pinned_free_roots(n_modes))
    wave = root / beam.length
    line_mass, mass, moment, inertia = _rigid(beam)
    sine, scale = jnp.sin(root), 1 - jnp.exp(-2 * root)

    def shape(x: Array) -> Array:
        up, down = jnp.exp(wave * (x - beam.length)), jnp.exp(-wave * (x + beam.length))
        return (jnp.sin(wave * x) / sine + (up - down) / scale) / 2

    def slope(x: Array) -> Array:
        k, x = wave[:, None], x[None, :]
        up, down = jnp.exp(k * (x - beam.length)), jnp.exp(-k * (x + beam.length))
        return k * (jnp.cos(k * x) / sine[:, None] + (up + down) / scale[:, None]) / 2

    return ModalBasis(
        mass=jnp.full((n_modes,), 0.25) * mass,
        stiffness=bare_stiffness(beam) * beam.stiffness_factor * wave**4 * beam.length / 4,
        tip=jnp.ones((n_modes,)),
        shortening=None,
        mixed_shortening=None,
        b=line_mass * (jnp.tan(root / 2) + jnp.tanh(root / 2)) / (2 * wave),
        c=jnp.zeros((n_modes,)) * mass,
        link_mass=mass,
        first_moment=moment,
        inertia=inertia,
        deflection_at=jax.vmap(shape)(stations) - (stations / beam.length)[:, None],
        sensor_slope=_slope_difference(slope, patches, patches.sensor_length),
        actuator_slope=_slope_difference(slope, patches, patches.actuator_length),
    )


def _ritz(xi: Array, n_sines: int) -> tuple[Array, Array, Array]:
    """Ritz functions of xi = x/L, their first and second derivatives, (len(xi), n_sines + 2) each.

    Sines alone cannot represent an end moment, so two cubics complete them.
    """
    xi = jnp.asarray(xi)[:, None]
    k = jnp.arange(1, n_sines + 1) * np.pi
    sine, cosine = jnp.sin(k * xi), jnp.cos(k * xi)
    value = [sine, xi * (1 - xi) ** 2, xi**2 * (1 - xi)]
    slope = [k * cosine, 1 - 4 * xi + 3 * xi**2, 2 * xi - 3 * xi**2]
    curvature = [-(k**2) * sine, 6 * xi - 4, 2 - 6 * xi]
    return tuple(jnp.concatenate(part, axis=1) for part in (value, slope, curvature))  # type: ignore[return-value]


def _loaded(beam: Beam, patches: Patches, n_modes: int, stations: Array) -> ModalBasis:
    n_sines = max(12, n_modes + 6)
    length = beam.length
    line_mass, bare_mass, bare_moment, bare_inertia = _rigid(beam)
    single = one_sided_section(beam, patches).stiffness
    double = two_sided_section(beam, patches).stiffness
    patch_mass = patches.density * patches.width * patches.thickness

    # Intervals with extra line mass and stiffness: sensors, actuators, and where both overlap.
    sensor = patch_ends(patches.center, patches.sensor_length)
    actuator = patch_ends(patches.center, patches.actuator_length)
    both = patch_ends(patches.center, jnp.minimum(patches.sensor_length, patches.actuator_length))
    left = jnp.concatenate([sensor[0], actuator[0], both[0]]) / length
    right = jnp.concatenate([sensor[1], actuator[1], both[1]]) / length
    each = jnp.ones_like(patches.center)
    extra_mass = jnp.concatenate([patch_mass * each, patch_mass * each, 0 * each])
    extra_stiffness = jnp.concatenate([single * each, single * each, (double - 2 * single) * each])

    # Gauss-Legendre is exact to rounding here: 2 n_sines half-waves over the link need about
    # pi n_sines + 20 points, over a patch far fewer.
    whole_x, whole_w = _gauss(4 * n_sines + 24)
    patch_x, patch_w = _gauss(2 * n_sines + 8)
    span = (right - left)[:, None]
    xi = jnp.concatenate([whole_x, (left[:, None] + span * patch_x).ravel()])
    weight = length * jnp.concatenate([whole_w, (span * patch_w).ravel()])
    n_points = patch_x.size
    mass_w = weight * jnp.concatenate(
        [line_mass * jnp.ones_like(whole_x), jnp.repeat(extra_mass, n_points)]
    )
    bending = bare_stiffness(beam) * jnp.ones_like(whole_x)
    bending_w = (
        weight
        * beam.stiffness_factor
        * jnp.concatenate([bending, jnp.repeat(extra_stiffness, n_points)])
    )

    value, _, curvature = _ritz(xi, n_sines)
    ends = _ritz(jnp.array([0.0, 1.0]), n_sines)[1] / length
    joint = jnp.stack([beam.joint_inertia_b, beam.joint_inertia_c])
    mass_matrix = (value.T * mass_w) @ value + (ends.T * joint) @ ends
    stiffness_matrix = (curvature.T * bending_w) @ curvature / length**4

    total_mass = bare_mass + jnp.sum(extra_mass * (right - left)) * length
    lower = jnp.linalg.cholesky(mass_matrix)
    half = jax.scipy.linalg.solve_triangular(lower, stiffness_matrix, lower=True)
    reduced = jax.scipy.linalg.solve_triangular(lower, half.T, lower=True)
    squared, vector = jnp.linalg.eigh((reduced + reduced.T) / 2)
    coefficient = jax.scipy.linalg.solve_triangular(lower.T, vector, lower=False)[:, :n_modes]
    coefficient = coefficient * jnp.where(ends[0] @ coefficient < 0, -1.0, 1.0)
    coefficient = coefficient * jnp.sqrt(total_mass / 2)

    def slope(x: Array) -> Array:
        return (_ritz(x / length, n_sines)[1] @ coefficient).T / length

    steepness = _ritz(whole_x, n_sines)[1] @ coefficient
    shortening = (steepness.T * whole_w) @ steepness / length
    x_patches = length * xi[whole_x.size :]
    patch_w = mass_w[whole_x.size :]
    return ModalBasis(
        mass=jnp.full((n_modes,), 0.5) * total_mass,
        stiffness=squared[:n_modes] * total_mass / 2,
        tip=None,
        shortening=jnp.diagonal(shortening),
        mixed_shortening=shortening * (1 - jnp.eye(n_modes)),
        b=mass_w @ value @ coefficient,
        c=(mass_w * xi * length) @ value @ coefficient + joint @ ends @ coefficient,
        link_mass=total_mass,
        first_moment=bare_moment + patch_w @ x_patches,
        inertia=bare_inertia + patch_w @ x_patches**2 + jnp.sum(joint),
        deflection_at=_ritz(stations / length, n_sines)[0] @ coefficient,
        sensor_slope=_slope_difference(slope, patches, patches.sensor_length),
        actuator_slope=_slope_difference(slope, patches, patches.actuator_length),
    )


def _gauss(n_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of Gauss-Legendre quadrature on [0, 1]."""
    node, weight = np.polynomial.legendre.leggauss(n_points)
    return (node + 1) / 2, weight / 2


BASES = Table(
    "modal basis",
    (
        Basis("pinned_pinned", _pinned_pinned, is_on_chord=True),
        Basis("pinned_free", _pinned_free, is_on_chord=False),
        Basis("loaded", _loaded, is_on_chord=True, has_joints=True),
    ),
)
