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
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Beam, Num, Patches
from jaxmodel.piezo import bare_stiffness, opposite_gain, patch_ends
from jaxmodel.static import (
    Pieces,
    bent_at,
    link_pieces,
    section_mass,
    section_stiffness,
    static_bending,
    static_loads,
)
from jaxmodel.table import Table

_Parts = TypeVar("_Parts", Beam, Patches)


class ModalBasis(NamedTuple):
    """What the dynamics needs to know about links with R modes each."""

    # m_j = int rhoA Y_j^2 [kg]; shapes are scaled so that it is the same for every mode
    mass: Num[Array, "links R"]
    stiffness: Num[Array, "links R"]  # k_j [N/m]
    tip: Num[Array, "links R"] | None  # Y_j(L) [1]; None where it is zero for every mode
    # S_jk = int Y_j' Y_k' dx: a bent link's chord is shorter than the link by 1/2 sum S_jk q_j q_k
    shortening: Num[Array, "links R"] | None  # S_jj [1/m]; None where the ends are not on the chord
    # S_jk, zero for j = k [1/m]; None where all zero
    mixed_shortening: Num[Array, "links R R"] | None
    # a point at x moves inwards by 1/2 int_0^x w'^2; with the mass and first moment beyond x,
    # m_>(x) = int_x^L rhoA and J_>(x) = int_x^L rhoA x:
    # P_jk = int Y_j' Y_k' m_> dx [kg/m]; None as `shortening`
    inward: Num[Array, "links R R"] | None
    # Q_jk = int Y_j' Y_k' J_> dx [kg]; None as `shortening`
    centrifugal: Num[Array, "links R R"] | None
    b: Num[Array, "links R"]  # int rhoA Y_j [kg]
    c: Num[Array, "links R"]  # int rhoA x Y_j (and joint inertia) [kg m]
    link_mass: Num[Array, "links"]  # m_b [kg]
    first_moment: Num[Array, "links"]  # e = int rhoA x [kg m]
    inertia: Num[Array, "links"]  # J0 = int rhoA x^2 + J_B + J_C [kg m2]
    deflection_at: Num[Array, "links S R"]  # Y_j at `stations` minus the chord's (x/L) Y_j(L) [1]
    sensor_slope: Num[Array, "links R K"]  # Phi_s: Y_j' at right minus left sensor end [1/m]
    actuator_slope: Num[Array, "links R K"]  # Phi_a: the same for the actuators [1/m]
    end_slope: Num[Array, "links R 2"]  # Y_j' at both ends [1/m]
    # exact static response to moments of the actuators, whatever the modes (`jaxmodel.static`)
    static_slope: Num[Array, "links K K"]  # slope differences over the sensors [rad/(N m)]
    static_deflection: Num[Array, "links S K"]  # from the chord at `stations` [m/(N m)]
    # elongation of a link per last coordinate, if that is no mode [1]; None: all are modes
    stretch: Num[Array, "links"] | None = None


class Basis(NamedTuple):
    """A family of mode shapes: its properties, and how to compute it for one link."""

    name: str
    modes: Callable[[Beam, Patches, int, Array], ModalBasis]  # of R modes, deflection at stations
    is_on_chord: bool  # both ends lie on the frame's axis: Y_j(L) = 0
    has_joints: bool = False  # includes rotary inertia at the joints
    has_patches: bool = False  # includes the patches' mass and stiffness


def build_basis(
    kind: str,
    beam: Beam,
    patches: Patches,
    n_modes: int,
    stations: Num[Array, "S"] | Num[Array, "links S"],
    mode_mask: Num[Array, ""] | Num[Array, "R"] = 1.0,
) -> ModalBasis:
    """Modal basis of all links, usually three.

    Args:
        kind: name of one of `BASES` (static).
        beam: link data.
        patches: patch data.
        n_modes: R, modes per link (static).
        stations: where to take the chord deflection [m]; links may have positions of their own.
        mode_mask: 1 for modes that exist, 0 for modes switched off. A mode that is off keeps
            its oscillator but couples to nothing, so it stays at rest.

    Returns:
        ModalBasis with the true bending stiffness (with `stiffness_factor`).

    Raises:
        ValueError: unknown kind, or no modes.

    Example:
        >>> machine = paper_machine()
        >>> basis = build_basis("loaded", machine.beam, machine.patches, 3, jnp.full((3, 1), 0.1))
        >>> jnp.sqrt(basis.stiffness / basis.mass).shape
        (3, 3)
    """
    if kind not in BASES:
        raise ValueError(f"basis = {kind!r}; allowed: {', '.join(BASES)}")
    if n_modes < 1:
        raise ValueError(f"n_modes = {n_modes}; allowed: 1 or more [1]")

    def one_link(beam_i: Beam, patches_i: Patches, stations_i: Array) -> ModalBasis:
        return BASES[kind].modes(beam_i, patches_i, n_modes, stations_i)

    return mask_modes(jax.vmap(one_link)(*by_link(beam, patches, stations)), mode_mask)


def by_link(beam: Beam, patches: Patches, stations: Array) -> tuple[Beam, Patches, Array]:
    """Data of the links with a leading axis, one value per link; patches without own factors."""
    centers, stations = jnp.asarray(patches.center), jnp.asarray(stations)
    n_links = len(centers)
    alike = patches._replace(center=0.0, sensor_factor=1.0, actuator_factor=1.0)
    own = _each_link(alike, n_links)._replace(center=centers)
    stations = jnp.broadcast_to(stations, (n_links, stations.shape[-1]))
    return _each_link(beam, n_links), own, stations


def _each_link(parts: _Parts, n_links: int) -> _Parts:
    """Link data, broadcast to one value per link."""
    return type(parts)(*(jnp.broadcast_to(jnp.asarray(field), (n_links,)) for field in parts))


def mask_modes(basis: ModalBasis, mode_mask: Array) -> ModalBasis:
    """Switch modes off, see `build_basis`."""
    mask = jnp.broadcast_to(jnp.asarray(mode_mask, basis.mass.dtype), basis.mass.shape[1:])
    rows = mask[:, None]
    return map_modes(basis, lambda x: x * mask, lambda x: x * rows, lambda x: x * mask * rows)


def map_modes(
    basis: ModalBasis,
    last: Callable[[Array], Array],
    rows: Callable[[Array], Array],
    both: Callable[[Array], Array],
) -> ModalBasis:
    """A basis whose arrays of modes are changed, but for masses and stiffness.

    Args:
        basis: of some links.
        last, rows, both: change arrays with modes last, last but one, and on both these axes.
    """

    def changed(change: Callable[[Array], Array], *names: str) -> dict[str, Array]:
        return {x: change(y) for x in names if (y := getattr(basis, x)) is not None}

    return basis._replace(
        **changed(last, "tip", "shortening", "b", "c", "deflection_at"),
        **changed(rows, "sensor_slope", "actuator_slope", "end_slope"),
        **changed(both, "mixed_shortening", "inward", "centrifugal"),
    )


def left_out_of_loads(
    kind: str, beam: Beam, patches: Patches, stations: Array, basis: ModalBasis
) -> Array:
    """What the modes of a basis leave out of the static response to loads.

    Args:
        kind, beam, patches, stations, basis: as `build_basis` took and returned them.

    Returns:
        As `static_loads` of each link, less the share of the modes, (3, 2 K + S, S + 2).
    """
    loads = partial(static_loads, has_patches=BASES[kind].has_patches)
    exact = jax.vmap(loads)(*by_link(beam, patches, stations))
    slopes = [jnp.swapaxes(x, 1, 2) for x in (basis.sensor_slope, basis.actuator_slope)]
    seen = jnp.concatenate([slopes[0], basis.deflection_at, slopes[1]], axis=1)
    forces = [jnp.swapaxes(basis.deflection_at, 1, 2), basis.b[..., None], basis.c[..., None]]
    return exact - seen @ (jnp.concatenate(forces, axis=2) / basis.stiffness[..., None])


def held_frequency(kind: str, beam: Beam, basis: ModalBasis) -> Array:
    """Frequencies of links with held ends [rad/s], (3, R).

    This is how links vibrate in the assembled machine (docs/theory.md). A basis whose ends lie on
    the chord has these frequencies itself; any other describes links that no platform holds, so
    the bare link's (j pi)^2 sqrt(E I/(rhoA L^4)) replace its own.

    Args:
        kind: modal basis (static).
        beam: link data.
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


def _ends(beam: Beam) -> Array:
    return jnp.stack([jnp.zeros_like(beam.length), beam.length])


def _pinned_pinned(beam: Beam, patches: Patches, n_modes: int, stations: Array) -> ModalBasis:
    order = jnp.arange(1, n_modes + 1)
    wave = order * np.pi / beam.length
    line_mass, mass, moment, inertia = _rigid(beam)
    sign = jnp.where(order % 2 == 1, 1.0, -1.0)  # -cos(j pi)
    waves = np.arange(1, 2 * n_modes + 1)  # int f cos(m pi xi) dxi of f = 1 - xi and 1 - xi^2
    beyond = np.concatenate([[1 / 2], (1 - (-1.0) ** waves) / (waves * np.pi) ** 2])
    moment_beyond = np.concatenate([[2 / 3], -2 * (-1.0) ** waves / (waves * np.pi) ** 2])
    stiffness = bare_stiffness(beam) * beam.stiffness_factor * wave**4 * beam.length / 2
    scale = wave[:, None] * wave * line_mass / 2 * beam.length**2
    slopes, bent = static_bending(beam, patches, stations, has_patches=False)

    def slope(x: Array) -> Array:
        return wave[:, None] * jnp.cos(wave[:, None] * x)

    return ModalBasis(
        mass=jnp.full((n_modes,), 0.5) * mass,
        stiffness=stiffness,
        tip=None,
        shortening=wave**2 * beam.length / 2,
        mixed_shortening=None,
        inward=scale * _products(beyond),
        centrifugal=scale * beam.length / 2 * _products(moment_beyond),
        b=line_mass * (1 + sign) / wave,
        c=line_mass * beam.length * sign / wave,
        link_mass=mass,
        first_moment=moment,
        inertia=inertia,
        deflection_at=jnp.sin(wave * stations[:, None]),
        sensor_slope=_slope_difference(slope, patches, patches.sensor_length),
        actuator_slope=_slope_difference(slope, patches, patches.actuator_length),
        end_slope=slope(_ends(beam)),
        static_slope=slopes,
        static_deflection=bent,
    )


def _products(total: Array | np.ndarray, sign: int = 1) -> Array | np.ndarray:
    """2 int f cos(j pi xi) cos(k pi xi) dxi from int f cos(m pi xi) dxi, m = 0.. 2 R, (R, R).

    With sign -1 that of sines.
    """
    order = np.arange(1, len(total) // 2 + 1)
    return total[abs(order[:, None] - order)] + sign * total[order[:, None] + order]


def _pinned_free(beam: Beam, patches: Patches, n_modes: int, stations: Array) -> ModalBasis:
    # Y = (sin kx/sin kL + sinh kx/sinh kL)/2, the hyperbolic ratio in a form that cannot overflow
    root = jnp.asarray(pinned_free_roots(n_modes))
    wave = root / beam.length
    line_mass, mass, moment, inertia = _rigid(beam)
    sine, scale = jnp.sin(root), 1 - jnp.exp(-2 * root)
    slopes, bent = static_bending(beam, patches, stations, has_patches=False)

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
        inward=None,
        centrifugal=None,
        b=line_mass * (jnp.tan(root / 2) + jnp.tanh(root / 2)) / (2 * wave),
        c=jnp.zeros((n_modes,)) * mass,
        link_mass=mass,
        first_moment=moment,
        inertia=inertia,
        deflection_at=jax.vmap(shape)(stations) - (stations / beam.length)[:, None],
        sensor_slope=_slope_difference(slope, patches, patches.sensor_length),
        actuator_slope=_slope_difference(slope, patches, patches.actuator_length),
        end_slope=slope(_ends(beam)),
        static_slope=slopes,
        static_deflection=bent,
    )


class _Shapes(NamedTuple):
    """Ritz functions at some points, as functions of xi = x/L."""

    value: Num[Array, "functions points"]
    slope: Num[Array, "functions points"]


def _smooth_shapes(xi: Array, n_sines: int) -> _Shapes:
    """Sines, and two cubics, since sines cannot carry an end moment."""
    k = np.arange(1, n_sines + 1)[:, None] * np.pi
    sine, cosine = _harmonics(xi, n_sines)
    value = [sine / k**2, jnp.stack([xi * (1 - xi) ** 2, xi**2 * (1 - xi)])]
    slope = [cosine / k, jnp.stack([1 - 4 * xi + 3 * xi**2, 2 * xi - 3 * xi**2])]
    return _Shapes(jnp.concatenate(value), jnp.concatenate(slope))


def _harmonics(xi: Array, count: int) -> tuple[Array, Array]:
    """sin and cos of j pi xi, j = 1.., (count, points) each; by rotation, which is cheaper."""
    first = jnp.sin(np.pi * xi), jnp.cos(np.pi * xi)
    found = [first]
    for _ in range(count - 1):
        sine, cosine = found[-1]
        found.append((sine * first[1] + cosine * first[0], cosine * first[1] - sine * first[0]))
    sine, cosine = (jnp.stack(part) for part in zip(*found, strict=True))
    return sine, cosine


class _Bends(NamedTuple):
    """Ritz functions with constant curvature over a patch, zero elsewhere.

    Two for each pair of patches: over what both cover, and over what only the longer one covers.
    Smooth functions follow the steps of curvature at the ends of patches slowly: with sines alone a
    sensor sees mode 1 of the default link 6 % too strongly.
    """

    pieces: Pieces  # their ends as shares of the link's length [1]
    curvature: Num[Array, "2*K n"]  # of each function on each piece [1]


def _bends(pieces: Pieces, length: Array) -> _Bends:
    both, either = pieces.has_sensor * pieces.has_actuator, pieces.has_sensor + pieces.has_actuator
    cover = jnp.concatenate([both, either - 2 * both])
    pieces = pieces._replace(left=pieces.left / length, right=pieces.right / length)
    width = jnp.sum(cover * (pieces.right - pieces.left), axis=1)
    is_there = width > 1e-6  # patches of equal length have no second one
    size = jnp.where(is_there, 1 / jnp.sqrt(jnp.where(is_there, width, 1.0)), 0.0)
    return _Bends(pieces, cover * size[:, None])


def _bent_shapes(xi: Array, bends: _Bends) -> _Shapes:
    p, q, x = bends.pieces.left, bends.pieces.right, jnp.asarray(xi)[:, None]
    end = ((1 - p) ** 2 - (1 - q) ** 2) / 2
    slope = jnp.maximum(x - p, 0.0) - jnp.maximum(x - q, 0.0) - end
    value = bent_at(bends.pieces, jnp.ones(()), xi)
    return _Shapes(bends.curvature @ value.T, bends.curvature @ slope.T)


def _polynomials(bends: _Bends) -> Array:
    """Coefficients of 1, xi, .. xi^3 of the cubics and bends on each piece, (2 + 2 K, n, 4)."""
    p, q = bends.pieces.left, bends.pieces.right
    end, n, zero = ((1 - p) ** 2 - (1 - q) ** 2) / 2, len(p), jnp.zeros_like(p)
    # of a piece that is bent (first axis): on pieces before it, on itself, and on those after it
    after, before = np.triu(np.ones((n, n)), 1), np.tril(np.ones((n, n)), -1)
    parts = (
        (before, (zero, -end, zero, zero)),
        (np.eye(n), (p**2 / 2, -p - end, zero + 0.5, zero)),
        (after, ((p**2 - q**2) / 2, q - p - end, zero, zero)),
    )
    unit = sum(where[:, :, None] * jnp.stack(x, axis=1)[:, None] for where, x in parts)
    cubics = np.array([[0.0, 1.0, -2.0, 1.0], [0.0, 0.0, 1.0, -1.0]])
    smooth = jnp.broadcast_to(cubics[:, None], (2, n, 4))
    return jnp.concatenate([smooth, jnp.einsum("mn,npd->mpd", bends.curvature, unit)])


def _moments(pieces: Pieces, count: int) -> tuple[Array, Array]:
    """int xi^d sin(j pi xi) dxi and that of cos over each piece, d = 0.. 4, (count, n, 5) each."""
    wave = np.arange(1, count + 1)[:, None] * np.pi
    xi = jnp.concatenate([pieces.left, pieces.right[-1:]])
    sine, cosine = _harmonics(xi, count)
    of_sine, of_cosine = [-cosine / wave], [sine / wave]
    for d in range(1, 5):  # by parts
        last = of_sine[-1], of_cosine[-1]
        of_sine.append((d * last[1] - xi**d * cosine) / wave)
        of_cosine.append((xi**d * sine - d * last[0]) / wave)
    return jnp.diff(jnp.stack(of_sine, -1), axis=1), jnp.diff(jnp.stack(of_cosine, -1), axis=1)


def _times(factor: Array, rest: Array) -> Array:
    """Coefficients of the products of polynomials, (n, W) and (m, n, D), (m, n, W + D - 1)."""
    degree = np.add.outer(*map(np.arange, (factor.shape[1], rest.shape[2])))
    shift = degree[..., None] == np.arange(degree.max() + 1)
    return jnp.einsum("nw,mnd,wde->mne", factor, rest, shift.astype(float))


class _Integrals(NamedTuple):
    """Exact integrals over a link of Ritz functions times a factor, a polynomial on each piece."""

    sine: Array  # `_moments` of twice as many harmonics as there are sines
    cosine: Array
    power: Num[Array, "n 7"]  # int xi^d dxi over each piece, d = 0.. 6

    def single(self, factor: Array, sines: np.ndarray, rest: Array) -> Array:
        """int f y dxi, f (n, W), of sines of these sizes and polynomials (m, n, D), (n_s + m,)."""
        smooth = jnp.einsum("kpd,pd->k", self.sine[: len(sines), :, : factor.shape[1]], factor)
        product = _times(factor, rest)
        others = jnp.einsum("mpd,pd->m", product, self.power[:, : product.shape[2]])
        return jnp.concatenate([sines * smooth, others])

    def double(
        self, factor: Array, sizes: np.ndarray, rest: Array, is_cosine: bool = False
    ) -> Array:
        """int f y z dxi likewise, of every two functions; of cosines in place of sines."""
        product = _times(factor, rest)
        waves = (self.cosine if is_cosine else self.sine)[: len(sizes), :, : product.shape[2]]
        mixed = sizes[:, None] * jnp.einsum("kpd,mpd->km", waves, product)
        # int f cos(m pi xi) dxi, m = 0.., makes the products of two waves
        width = factor.shape[1]
        total = jnp.concatenate([self.power[None, :, :width], self.cosine[..., :width]])
        total = jnp.einsum("kpd,pd->k", total, factor)
        smooth = sizes[:, None] * sizes * _products(total, 1 if is_cosine else -1) / 2
        degree = np.arange(rest.shape[2])[:, None] + np.arange(product.shape[2])
        own = jnp.einsum("mpd,npe,pde->mn", rest, product, self.power[:, degree])
        top, bottom = jnp.concatenate([smooth, mixed], 1), jnp.concatenate([mixed.T, own], 1)
        return jnp.concatenate([top, bottom])


#: Added to the diagonal of the Ritz functions' stiffness, so that coinciding patches stay finite.
_TINY = 1e-10


def _loaded(beam: Beam, patches: Patches, n_modes: int, stations: Array) -> ModalBasis:
    n_sines = max(12, n_modes + 6)
    length = beam.length
    pieces = link_pieces(beam, patches)
    bends = _bends(pieces, length)
    line_mass = section_mass(beam, patches, pieces, has_patches=True)
    stiffness = section_stiffness(beam, patches, pieces, has_patches=True)

    def shapes(xi: Array) -> _Shapes:
        smooth, bent = _smooth_shapes(xi, n_sines), _bent_shapes(xi, bends)
        return _Shapes(*(jnp.concatenate(pair) for pair in zip(smooth, bent, strict=True)))

    order = np.arange(1, 8)
    xi = bends.pieces.left[:, None], bends.pieces.right[:, None]
    integrals = _Integrals(
        *_moments(bends.pieces, 2 * n_sines), (xi[1] ** order - xi[0] ** order) / order
    )
    ends = shapes(jnp.array([0.0, 1.0])).slope / length
    joint = jnp.stack([beam.joint_inertia_b, beam.joint_inertia_c])
    small, rest = 1 / (np.arange(1, n_sines + 1) * np.pi) ** 2, _polynomials(bends)
    density = jnp.stack([jnp.zeros_like(line_mass), line_mass], axis=1)  # times xi
    mass_matrix = length * integrals.double(density[:, 1:], small, rest) + (ends * joint) @ ends.T
    bent = jnp.stack([2 * rest[..., 2], 6 * rest[..., 3]], axis=2)
    stiffness_matrix = integrals.double(stiffness[:, None], -np.ones(n_sines), bent) / length**3

    # functions of unit energy; one that is absent gets a unit of its own, no mass and so no mode
    energy = jnp.diagonal(stiffness_matrix)
    is_there = energy > 0
    scale = jnp.where(is_there, 1 / jnp.sqrt(jnp.where(is_there, energy, 1.0)), 0.0)
    unit = jnp.diag(jnp.where(is_there, _TINY, 1.0))
    lower = jnp.linalg.cholesky(scale[:, None] * stiffness_matrix * scale + unit)
    half = jax.scipy.linalg.solve_triangular(
        lower, scale[:, None] * mass_matrix * scale, lower=True
    )
    reduced = jax.scipy.linalg.solve_triangular(lower, half.T, lower=True)
    softness, vector = jnp.linalg.eigh((reduced + reduced.T) / 2)  # 1/omega^2, ascending
    softness, vector = softness[: -n_modes - 1 : -1], vector[:, : -n_modes - 1 : -1]
    coefficient = jax.scipy.linalg.solve_triangular(lower.T, vector, lower=False)
    coefficient = scale[:, None] * coefficient
    coefficient = coefficient * jnp.where(ends[:, 0] @ coefficient < 0, -1.0, 1.0)
    left, right = pieces.left, pieces.right
    total_mass, first_moment, inertia = (
        jnp.sum(line_mass * (right**n - left**n) / n) for n in (1, 2, 3)
    )
    coefficient = coefficient * jnp.sqrt(total_mass / 2 / softness)

    def slope(x: Array) -> Array:
        return coefficient.T @ shapes(x / length).slope / length

    def slope_products(factor: Array) -> Array:
        """int f Y_i' Y_j' dx."""
        rising = rest[..., 1:] * np.array([1.0, 2.0, 3.0])
        return (
            coefficient.T
            @ integrals.double(factor, np.sqrt(small), rising, is_cosine=True)
            @ coefficient
            / length
        )

    shortening = slope_products(jnp.ones((len(left), 1)))
    # mass and first moment of what lies beyond a point, piece by piece
    mass, moment = line_mass * (right - left), line_mass * (right**2 - left**2) / 2
    beyond = (
        [jnp.sum(mass) - jnp.cumsum(mass) + line_mass * right, -line_mass * length],
        [
            jnp.sum(moment) - jnp.cumsum(moment) + line_mass * right**2 / 2,
            jnp.zeros_like(left),
            -line_mass * length**2 / 2,
        ],
    )
    inward, centrifugal = (slope_products(jnp.stack(x, axis=1)) for x in beyond)
    slopes, bent = static_bending(beam, patches, stations, has_patches=True)
    return ModalBasis(
        mass=jnp.full((n_modes,), 0.5) * total_mass,
        stiffness=total_mass / 2 / softness,
        tip=None,
        shortening=jnp.diagonal(shortening),
        mixed_shortening=shortening * (1 - jnp.eye(n_modes)),
        inward=inward,
        centrifugal=centrifugal,
        b=length * integrals.single(density[:, 1:], small, rest) @ coefficient,
        c=(length**2 * integrals.single(density, small, rest) + joint @ ends.T) @ coefficient,
        link_mass=total_mass,
        first_moment=first_moment,
        inertia=inertia + jnp.sum(joint),
        deflection_at=shapes(stations / length).value.T @ coefficient,
        sensor_slope=_slope_difference(slope, patches, patches.sensor_length),
        actuator_slope=_slope_difference(slope, patches, patches.actuator_length)
        + opposite_gain(beam, patches)
        * _slope_difference(
            slope, patches, jnp.minimum(patches.sensor_length, patches.actuator_length)
        ),
        end_slope=coefficient.T @ ends,
        static_slope=slopes,
        static_deflection=bent,
    )


BASES = Table(
    "modal basis",
    (
        Basis("pinned_pinned", _pinned_pinned, is_on_chord=True),
        Basis("pinned_free", _pinned_free, is_on_chord=False),
        Basis("loaded", _loaded, is_on_chord=True, has_joints=True, has_patches=True),
    ),
)
