"""The numbers that one evaluation of the dynamics reads, computed once per case.

Layout used by every per-step function: structure first, lanes last. Pose arrays have shape (pose,),
link arrays (links,), mode arrays (links, Q); any further trailing axes are lanes of a batch. Link
arrays meet mode arrays as `x[:, None]`, sums run over axis 1 (modes) and axis 0 (links), so the
same code runs on one case, under `vmap`, and on lanes in the last axis.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.beam import ModalBasis
from jaxmodel.lazy import jnp
from jaxmodel.mechanisms.contract import Legs
from jaxmodel.parameters import Array, Damping, Machine, Num, Shaped
from jaxmodel.stretch import Stretch


class Plant(NamedTuple):
    """Machine and modal basis in the form the equations of motion use (axes as above)."""

    legs: Legs  # paths of the near joints
    joint_cos: Num[Array, "links"] | None  # |PC| cos(psi) [m]; None: the platform is a point
    joint_sin: Num[Array, "links"] | None  # |PC| sin(psi) [m]
    length: Num[Array, "links"]  # L [m]
    # rigid inertia
    slider_link_mass: Num[Array, "links"]  # m_b + m_s [kg]
    tip_mass: Num[Array, "links"]  # e/L: share of the link's mass that moves with C [kg]
    inertia: Num[Array, "links"]  # J0 [kg m2]
    # platform and payload
    platform_mass: Num[Array, ""]  # [kg]
    platform_inertia: Num[Array, ""]  # about the reference point [kg m2]
    platform_moment: Num[Array, "2"] | None  # mass times its centre in the platform's axes [kg m]
    # modes
    modal_mass: Num[Array, "links"]  # m, the same for all modes of a link [kg]
    stiffness: Num[Array, "links Q"]  # k_j [N/m]
    damping: Num[Array, "links Q"]  # d_j = 2 zeta sqrt(k m) [N s/m]
    tip: Num[Array, "links Q"] | None  # Y_j(L) [1], None where zero
    shortening: Num[Array, "links R"] | None  # S_jj [1/m], None where the chord keeps its length
    # S_jk, zero for j = k [1/m], None where all zero
    mixed_shortening: Num[Array, "links R R"] | None
    inward: Num[Array, "links Q Q"] | None  # P_jk - mu S_jk [kg/m], None where lumped at the joints
    centrifugal: Num[Array, "links Q Q"] | None  # Q_jk [kg], None likewise
    b: Num[Array, "links Q"]  # [kg]
    c: Num[Array, "links Q"]  # [kg m]
    # elongation of a link per last coordinate, which is no mode [1]; None: no such one
    stretch: Num[Array, "links"] | None = None
    # of joints that rub: T [N m] and speed of its tanh [rad/s], slopes of the coordinates
    # at the near and the far end [1/m]; None: they do not
    joint_friction: tuple[Num[Array, ""] | Num[Array, "links Q"], ...] | None = None


def damping_ratio(damping: Damping, omega: Array) -> Array:
    """Ratios of all modes [1], (3, R), omega their frequencies [rad/s]."""
    order = jnp.arange(omega.shape[1])
    own = jnp.minimum(order, jnp.asarray(damping.count, int)[:, None] - 1)
    ratio = jnp.asarray(damping.ratio)
    specified = jnp.take_along_axis(ratio, jnp.minimum(own, ratio.shape[1] - 1), axis=1)
    return specified * (omega / jnp.take_along_axis(omega, own, axis=1)) ** damping.exponent


#: Mass added to locked drives [kg]: 1 N for 1 s moves it by 0.5 nm.
LOCK_MASS = 1e9


def build_plant(
    machine: Machine,
    basis: ModalBasis,
    is_locked: Shaped[Array, ""] = False,
    has_shortening: bool = True,
    is_distributed: bool = False,
    stretch: Stretch | None = None,
    has_joint_friction: bool = False,
) -> Plant:
    """Collect machine and basis into a `Plant`.

    The payload adds its mass, inertia and first moment to the platform's. Links that lengthen have
    one coordinate more, of the modes' modal mass.

    Args:
        machine: physical description.
        basis: modal basis of the links.
        is_locked: hold all actuated joints, by `LOCK_MASS`.
        has_shortening: bent links have shorter chords (static); False: as in the paper.
        is_distributed: every point of a bent link moves inwards by its own amount (static); False:
            half of the link moves in with joint C.
        stretch: of the links; None: they keep their length.
        has_joint_friction: joints rub (static).

    Returns:
        Plant.

    Example:
        >>> machine = paper_machine()
        >>> basis = build_basis("loaded", machine.beam, machine.patches, 3, jnp.full((3, 1), 0.1))
        >>> build_plant(machine, basis).stiffness.shape
        (3, 3)
    """
    geometry, masses, beam = machine.geometry, machine.masses, machine.beam
    legs, arms = geometry.legs(), geometry.arms()
    count = basis.mass.shape[:1]

    def link(x: Array) -> Array:
        return jnp.broadcast_to(jnp.asarray(x), count)

    length = link(beam.length)
    payload, offset = jnp.asarray(masses.payload_mass), masses.payload_offset
    mass = masses.platform_mass + payload
    inertia = masses.platform_inertia + jnp.asarray(masses.payload_inertia)
    if offset is not None:
        inertia = inertia + payload * jnp.sum(jnp.asarray(offset) ** 2)
    modes = basis
    if stretch is not None:
        basis = lengthening(basis, stretch)
    rubbing = machine.joint_friction, machine.joint_friction_speed
    plant = Plant(
        legs=legs,
        joint_cos=None if arms is None else arms[0],
        joint_sin=None if arms is None else arms[1],
        length=length,
        slider_link_mass=link(masses.slider_mass)
        + basis.link_mass
        + LOCK_MASS * jnp.asarray(is_locked, basis.mass.dtype),
        tip_mass=basis.first_moment / length,
        inertia=basis.inertia,
        platform_mass=mass,
        platform_inertia=inertia,
        platform_moment=None if offset is None else payload * jnp.asarray(offset),
        modal_mass=basis.mass[:, 0],
        stiffness=basis.stiffness,
        damping=2
        * damping_ratio(machine.damping, jnp.sqrt(basis.stiffness / basis.mass))
        * jnp.sqrt(basis.stiffness * basis.mass),
        tip=basis.tip,
        shortening=modes.shortening if has_shortening else None,
        mixed_shortening=modes.mixed_shortening if has_shortening else None,
        inward=unlumped(basis, length) if has_shortening and is_distributed else None,
        centrifugal=basis.centrifugal if has_shortening and is_distributed else None,
        b=basis.b,
        c=basis.c,
        stretch=basis.stretch,
        joint_friction=(*rubbing, *jnp.moveaxis(basis.end_slope, 2, 0))
        if has_joint_friction
        else None,
    )
    if stretch is None or basis.stretch is None:
        return plant
    along = basis.stretch**2 * stretch.damping
    return plant._replace(damping=plant.damping.at[:, -1].set(along))


def lengthening(basis: ModalBasis, stretch: Stretch) -> ModalBasis:
    """A basis with one coordinate more, of the modes' modal mass: a link's elongation over a scale.

    Args:
        basis: of the links.
        stretch: of the links.
    """
    scale = jnp.sqrt(basis.mass[:, 0] / stretch.mass)

    def beside(x: Array, value: Array = 0.0) -> Array:
        return jnp.pad(x, ((0, 0), (0, 1))).at[:, -1].set(value)

    def around(x: Array | None) -> Array | None:
        return None if x is None else jnp.pad(x, ((0, 0), (0, 1), (0, 1)))

    return basis._replace(
        mass=beside(basis.mass, basis.mass[:, 0]),
        stiffness=beside(basis.stiffness, scale**2 * stretch.stiffness),
        shortening=None if basis.shortening is None else beside(basis.shortening),
        mixed_shortening=around(basis.mixed_shortening),
        inward=around(basis.inward),
        centrifugal=around(basis.centrifugal),
        b=beside(basis.b),
        c=beside(basis.c),
        stretch=scale,
        end_slope=jnp.pad(basis.end_slope, ((0, 0), (0, 1), (0, 0))),
    )


def unlumped(basis: ModalBasis, length: Array) -> Array | None:
    """P - mu S [kg/m], (3, R, R), what lumping the axial inertia leaves out; None without S.

    Args:
        basis: of the links.
        length: L [m], (3,).
    """
    if basis.inward is None or basis.shortening is None:
        return None
    slopes = shortening_matrix(basis.shortening, basis.mixed_shortening)
    return basis.inward - (basis.first_moment / length)[:, None, None] * slopes


def shortening_matrix(shortening: Array, mixed: Array | None) -> Array:
    """S [1/m], (3, R, R), from its diagonal and, unless all zero, the rest."""
    diagonal = shortening[:, :, None] * jnp.eye(shortening.shape[1])
    return diagonal if mixed is None else diagonal + mixed
