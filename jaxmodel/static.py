"""Static bending of a link by its actuators: exact, and what the modes of a basis leave out of it.

A link between pinned ends is statically determinate: the pair of moments of an actuator bends it
between its own ends and nowhere else, whatever the stiffness E I(x). So sensor k answers to
actuator l with lambda_s lambda_a int dx/(E I) over what both cover, and no other sensor answers
at all. A sum over modes approaches this as 1/R and changes sign on the way; the plant therefore
carries the difference as a direct term from voltage to voltage and to deflection
(docs/theory.md, "Static correction").
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Beam, Num, Patches
from jaxmodel.piezo import (
    bare_stiffness,
    one_sided_section,
    opposite_gain,
    patch_ends,
    two_sided_section,
)

if TYPE_CHECKING:
    from jaxmodel.beam import ModalBasis


class Pieces(NamedTuple):
    """A link in n pieces between the ends of its patches, each of constant section."""

    left: Num[Array, "n"]  # [m]
    right: Num[Array, "n"]  # [m]
    has_sensor: Num[Array, "K n"]  # 1 where sensor k covers it, else 0
    has_actuator: Num[Array, "K n"]  # 1 where actuator k covers it, else 0
    has_ceramic: Num[Array, "K n"]  # 1 where a sensor that is a patch covers it, else 0


def link_pieces(beam: Beam, patches: Patches, places: Array = ()) -> Pieces:
    """Cut one link at the ends of its patches, in any order and overlap.

    Args:
        beam: one link's data, () fields.
        patches: its patches, () fields and centres (K,) [m].
        places: where else to cut [m], (S,).
    """
    length = jnp.asarray(beam.length)
    sensor = patch_ends(patches.center, patches.sensor_length)
    actuator = patch_ends(patches.center, patches.actuator_length)
    cuts = jnp.sort(jnp.concatenate([*sensor, *actuator, jnp.asarray(places)]))
    cuts = jnp.concatenate([jnp.zeros((1,)), jnp.clip(cuts, 0.0, length), length[None]])
    middle = (cuts[1:] + cuts[:-1]) / 2

    def covers(ends: tuple[Array, Array]) -> Array:
        left, right = (end[:, None] for end in ends)
        return ((left < middle) & (middle < right)).astype(cuts.dtype)

    seen = covers(sensor)
    return Pieces(
        left=cuts[:-1],
        right=cuts[1:],
        has_sensor=seen,
        has_actuator=covers(actuator),
        has_ceramic=seen * (1.0 - patches.is_gauge),
    )


def _ceramic_faces(patches: Patches, pieces: Pieces) -> tuple[Array, Array]:
    """1 where ceramic covers one face, and the other, else 0, (K, n) each."""
    paired = pieces.has_actuator * patches.is_paired
    return jnp.maximum(pieces.has_ceramic, paired), pieces.has_actuator


def patch_count(patches: Patches, pieces: Pieces) -> Array:
    """Layers of ceramic on each piece, (n,)."""
    one, other = _ceramic_faces(patches, pieces)
    return jnp.sum(one + other, axis=0)


def driving(beam: Beam, patches: Patches, pieces: Pieces, has_patches: bool) -> Array:
    """Moment of each actuator on each piece over `actuator_constant` [1], (K, n)."""
    if not has_patches:
        return pieces.has_actuator
    return pieces.has_actuator * (1 + opposite_gain(beam, patches) * pieces.has_ceramic)


def section_stiffness(beam: Beam, patches: Patches, pieces: Pieces, has_patches: bool) -> Array:
    """True bending stiffness E I of each piece [N m2], (n,).

    Args:
        beam, patches: one link's data.
        pieces: of that link.
        has_patches: patches stiffen the link (static).
    """
    stiffness = bare_stiffness(beam) * jnp.ones_like(pieces.left)
    if has_patches:
        single = one_sided_section(beam, patches).stiffness
        double = two_sided_section(beam, patches).stiffness
        one, other = _ceramic_faces(patches, pieces)
        stiffness = stiffness + single * jnp.sum(one + other, axis=0)
        stiffness = stiffness + (double - 2 * single) * jnp.sum(one * other, axis=0)
    return stiffness * beam.stiffness_factor


def section_mass(beam: Beam, patches: Patches, pieces: Pieces, has_patches: bool) -> Array:
    """Mass per length rhoA of each piece [kg/m], (n,).

    Args:
        beam, patches: one link's data.
        pieces: of that link.
        has_patches: patches load the link (static).
    """
    line_mass = beam.density * beam.width * beam.thickness
    if not has_patches:
        return line_mass * jnp.ones_like(pieces.left)
    patch_mass = patches.density * patches.width * patches.thickness
    return line_mass + patch_mass * patch_count(patches, pieces)


def bent_at(pieces: Pieces, length: Array, x: Array) -> Array:
    """Deflection from the chord under unit curvature of one piece [m/(1/m)], (len(x), n).

    w = (<x - p>^2 - <x - q>^2)/2 - (x/L) ((L - p)^2 - (L - q)^2)/2 for a piece from p to q.
    """
    p, q, x = pieces.left, pieces.right, jnp.asarray(x)[:, None]
    above = jnp.maximum(x - p, 0.0) ** 2 - jnp.maximum(x - q, 0.0) ** 2
    return (above - x / length * ((length - p) ** 2 - (length - q) ** 2)) / 2


def static_bending(
    beam: Beam, patches: Patches, stations: Array, has_patches: bool
) -> tuple[Array, Array]:
    """Static response of one link.

    Args:
        beam, patches: one link's data.
        stations: where to take the deflection [m], (S,).
        has_patches: patches stiffen the link (static).

    Returns:
        Per moment of the actuators, differences of slope over the sensors [rad/(N m)], (K, K), and
        deflections from the chord at the stations [m/(N m)], (S, K).
    """
    pieces = link_pieces(beam, patches)
    softness = 1 / section_stiffness(beam, patches, pieces, has_patches)
    width = (pieces.right - pieces.left) * softness
    drive = driving(beam, patches, pieces, has_patches)
    slope = jnp.einsum("kn,ln,n->kl", pieces.has_sensor, drive, width)
    bent = bent_at(pieces, beam.length, stations) * softness
    return slope, jnp.einsum("sn,ln->sl", bent, drive)


def static_loads(beam: Beam, patches: Patches, stations: Array, has_patches: bool) -> Array:
    """Static response of one link to forces across it and to the inertia of its own motion.

    With M = E I w'' under a load and M_x under a unit force at x, w(x) = int M M_x/(E I) dx, and
    the slopes at the ends of a sensor differ by int M/(E I) over it. M_x = <s - x> - s (1 - x/L);
    under a load f the first term is int f <s - x> dx, and M vanishes at both ends. All are
    polynomials between the cuts, integrated exactly.

    Args:
        beam, patches: one link's data.
        stations: where forces act and deflections are taken [m], (S,).
        has_patches: patches stiffen and load the link, and its joints have inertia (static).

    Returns:
        (2 K + S, S + 2): slopes over the sensors [rad], deflections at the stations [m] and slopes
        over the actuators [rad], by unit forces at the stations [1/N], the load rhoA [per m/s2]
        and the load rhoA x [per rad/s2].
    """
    length, pieces = beam.length, link_pieces(beam, patches, stations)
    left, width = pieces.left[:, None], (pieces.right - pieces.left)[:, None]
    node, weight = np.polynomial.legendre.leggauss(3)
    s = left + width * (node + 1) / 2  # (n, 3)
    stiffness = section_stiffness(beam, patches, pieces, has_patches)
    softness = width * weight / 2 / stiffness[:, None]
    line_mass = section_mass(beam, patches, pieces, has_patches)

    def heaped(s: Array) -> Array:
        """int rhoA <s - x> dx and int rhoA x <s - x> dx, (2, len(s))."""

        def beyond(p: Array) -> Array:
            reach = jnp.maximum(s[:, None] - p, 0.0)
            return jnp.stack([reach**2 / 2, p * reach**2 / 2 + reach**3 / 6])

        return (beyond(pieces.left) - beyond(pieces.right)) @ line_mass

    at = jnp.asarray(stations)[:, None, None]
    pushed = jnp.maximum(s - at, 0.0) - s * (1 - at / length)
    inertia = jnp.reshape(heaped(s.ravel()), (2, *s.shape))
    inertia -= s / length * heaped(jnp.reshape(length, (1,)))[:, :, None]
    if has_patches:
        ends = beam.joint_inertia_c * s / length - beam.joint_inertia_b * (1 - s / length)
        inertia = inertia.at[1].add(ends)
    moment = jnp.concatenate([pushed, inertia])
    drive = driving(beam, patches, pieces, has_patches)
    seen, driven = (x[:, :, None] * jnp.ones_like(s) for x in (pieces.has_sensor, drive))
    rows = jnp.concatenate([seen, pushed, driven])
    return jnp.einsum("vng,lng,ng->vl", rows, moment, softness)


def static_remainder(basis: ModalBasis, mode_mask: Array = 1.0) -> tuple[Array, Array]:
    """Exact static response of all links less that of the modes, sum_j Phi_s,jk Phi_a,jl/k_j.

    Args:
        basis: of all links.
        mode_mask: modes that count, (3, R) or what broadcasts to it; default: all that exist.
    """
    driven = basis.actuator_slope * (mode_mask / basis.stiffness)[..., None]
    return (
        basis.static_slope - jnp.einsum("irk,irl->ikl", basis.sensor_slope, driven),
        basis.static_deflection - jnp.einsum("isr,irl->isl", basis.deflection_at, driven),
    )
