"""The closed chain (6) in closed form: actuated coordinates and link angles from pose and bending.

In the frame of a link's chord (along t, across n_t) its far joint C lies at (c, w):
w = sum Y_j(L) q_j is zero in bases whose ends lie on the chord, and there c = L - d is shorter than
the link by d = 1/2 sum S_jk q_j q_k. With s = u.(C - A), h = n.(C - A), l2 = c^2 + w^2 and
P = sqrt(l2 - h^2): rho = s - P, sin gamma = (h c - w P)/l2, cos gamma = (c P + w h)/l2, and
gamma = beta - alpha.
Shapes as in `jaxmodel.plant`: structure first, lanes last.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.lazy import jax, jnp
from jaxmodel.mechanisms.contract import SINGULAR_MARGIN, Near
from jaxmodel.parameters import Array, Num, PerLink
from jaxmodel.plant import Plant
from jaxmodel.trigonometry import sine_cosine

#: Keeps the root of a joint's distance from the platform's centre away from 0 [m2].
TINY_AREA = 1e-20


class Bend(NamedTuple):
    """Effect of bending on a link's far joint; None: none."""

    tip: Num[Array, "links"] | None = None  # w, deflection of C from the link's tangent frame [m]
    tip_rate: Num[Array, "links"] | None = None  # [m/s]
    shortening: Num[Array, "links"] | None = None  # d, link length minus chord length [m]
    shortening_rate: Num[Array, "links"] | None = None  # [m/s]


class Frame(NamedTuple):
    """Axes f and g (f turned by +90 deg) at the joints C.

    f points where bending moves C within its link: along t as the chord shortens, or along -n_t
    where Y_j(L) is not zero. When C of a rigid link moves by (f, g), rho moves by
    rho_f f + rho_g g and gamma by beta_f f + beta_g g.
    """

    x: Num[Array, "links"]  # direction of f in the plane [1]
    y: Num[Array, "links"]
    c_f: Num[Array, "links"] | None  # C - X along f [m]; None: the platform is a point
    c_g: Num[Array, "links"] | None
    rho_f: Num[Array, "links"]  # [1]
    rho_g: Num[Array, "links"] | None  # None: zero
    beta_f: Num[Array, "links"]  # [1/m]
    beta_g: Num[Array, "links"]

    def link_motion(self, along_f: Array, along_g: Array) -> tuple[Array, Array]:
        """Rates of rho and gamma from those of C."""
        rho = self.rho_f * along_f
        if self.rho_g is not None:
            rho = rho + self.rho_g * along_g
        return rho, self.beta_f * along_f + self.beta_g * along_g

    def joint_force(self, on_rho: Array, on_beta: Array) -> tuple[Array, Array]:
        """Force at C along f and g equivalent to forces on rho and gamma."""
        g = self.beta_g * on_beta
        if self.rho_g is not None:
            g = g + self.rho_g * on_rho
        return self.rho_f * on_rho + self.beta_f * on_beta, g

    def joint_motion(self, pose_rate: Array) -> tuple[Array, Array]:
        """Velocity of C along f and g from that of the pose (accelerations without phi'^2)."""
        x_rate, y_rate = pose_rate[0], pose_rate[1]
        along_f = self.x * x_rate + self.y * y_rate
        along_g = self.x * y_rate - self.y * x_rate
        if self.c_f is None or self.c_g is None:
            return along_f, along_g
        return along_f - self.c_g * pose_rate[2], along_g + self.c_f * pose_rate[2]


class Chain(NamedTuple):
    """Positions and rates of the chain at one instant, per link."""

    bend: Bend
    frame: Frame
    # sin and cos of phi [1]; None: it is a point
    turn: tuple[Num[Array, ""], Num[Array, ""]] | None
    cx: Num[Array, "links"] | None  # C - X in the plane [m]
    cy: Num[Array, "links"] | None
    near: Near  # joints B
    far: tuple[PerLink, PerLink]  # joints C in the plane [m]
    chord: Num[Array, "links"]  # c [m]
    sine: Num[Array, "links"]  # sin gamma [1]
    cosine: Num[Array, "links"]  # cos gamma [1]
    rho: Num[Array, "links"]  # position of the actuated joint [m]
    rho_rate: Num[Array, "links"]  # [m/s]
    beta_rate: Num[Array, "links"]  # of the link in the plane [rad/s]
    # rho'^2/r, acceleration of B towards n [m/s2]; None: straight paths
    turning: Num[Array, "links"] | None


def close_chain(
    plant: Plant, pose: Num[Array, "pose"], pose_rate: Num[Array, "pose"], bend: Bend | None = None
) -> Chain:
    """Solve the closure (6) and its rate.

    gamma' = (h' - cos(gamma) w' + sin(gamma) d')/P,
    rho' = s' + h gamma' + sin(gamma) w' + cos(gamma) d'.

    Args:
        plant: the machine.
        pose: (x, y, phi) [m, m, rad].
        pose_rate: its rate.
        bend: of the links; None: straight.

    Returns:
        Chain. Out of reach or at a singular pose P is replaced by a safe value, so the numbers are
        finite there but meaningless: see `chain_status`.

    Example:
        >>> plant = prepare(*paper_case({"link.modes": 2})).loop.plant
        >>> chain = close_chain(plant, jnp.array(HOME), jnp.zeros(3))
        >>> chain.rho.shape
        (3,)
    """
    bend = Bend() if bend is None else bend
    x, y, cx, cy, turn = pose[0], pose[1], None, None, None
    if plant.joint_cos is not None and plant.joint_sin is not None:
        turn = sine, cosine = sine_cosine(pose[2])
        cx = plant.joint_cos * cosine - plant.joint_sin * sine
        cy = plant.joint_sin * cosine + plant.joint_cos * sine
        x, y = x + cx, y + cy
    chord = plant.length if bend.shortening is None else plant.length - bend.shortening
    squared = chord * chord
    if bend.tip is not None:
        squared = squared + bend.tip * bend.tip
    near = plant.legs.near(x, y, squared, (SINGULAR_MARGIN * plant.length) ** 2)
    root, h = near.root, near.across
    if bend.tip is None:
        product = 1 / (chord * root)  # one division for 1/c and 1/P
        inverse, over = chord * product, root * product
        sin_gamma, cos_gamma = h * over, root * over
        f_u, f_n = cos_gamma, sin_gamma
        ways = (chord * inverse, None, sin_gamma * inverse, over)
    else:
        inverse = 1 / root
        sin_gamma = (h * chord - bend.tip * root) / squared
        cos_gamma = (chord * root + bend.tip * h) / squared
        f_u, f_n = sin_gamma, -cos_gamma
        ways = tuple(inverse * x for x in (-bend.tip, chord, -cos_gamma, sin_gamma))
    f_x, f_y = near.x * f_u - near.y * f_n, near.y * f_u + near.x * f_n
    c_f, c_g = (None, None) if cx is None else (f_x * cx + f_y * cy, f_x * cy - f_y * cx)
    frame = Frame(f_x, f_y, c_f, c_g, *ways)
    along_f, along_g = frame.joint_motion(pose_rate)
    for rate in (bend.tip_rate, bend.shortening_rate):
        along_f = along_f if rate is None else along_f + rate
    rho_rate, beta_rate = frame.link_motion(along_f, along_g)
    return Chain(
        bend=bend,
        frame=frame,
        turn=turn,
        cx=cx,
        cy=cy,
        near=near,
        far=(x, y),
        chord=chord,
        sine=sin_gamma,
        cosine=cos_gamma,
        rho=near.position,
        rho_rate=rho_rate,
        beta_rate=beta_rate,
        turning=None if near.curvature is None else near.curvature * rho_rate * rho_rate,
    )


def chain_status(plant: Plant, chain: Chain) -> Array:
    """Status of the pose: OK, OUT_OF_REACH (h^2 > l2) or SINGULAR (gamma at 0 or 90 deg).

    Of the deformed machine: bent links reach less far.

    Returns:
        () code of `jaxmodel.status`, as a floating-point number.
    """
    margin = SINGULAR_MARGIN
    is_out = jnp.any(chain.near.root_squared <= 0, axis=0)
    is_near = (plant.legs.side(chain.sine) < margin) | (
        chain.near.root_squared < (margin * plant.length) ** 2
    )
    code = jnp.where(jnp.any(is_near, axis=0), status.SINGULAR, status.OK)
    return jnp.where(is_out, status.OUT_OF_REACH, code).astype(chain.sine.dtype)


def link_angle(chain: Chain) -> Array:
    """gamma = beta - alpha [rad], (3,)."""
    return jnp.arctan2(chain.sine, chain.cosine)


def link_direction(chain: Chain) -> Array:
    """beta, of the links in the plane [rad], (3,)."""
    near = chain.near
    return jnp.arctan2(
        chain.cosine * near.y + chain.sine * near.x, chain.cosine * near.x - chain.sine * near.y
    )


def singularity_distance(plant: Plant, pose: Array) -> Array:
    """Distance of a path from poses that drives cannot pass or cannot hold [rad], ().

    The smaller of two: of any link angle gamma from 0 and 90 deg, and `hold`.

    Args:
        plant: the machine.
        pose: of the undeformed machine, (N, 3) [m, m, rad].
    """
    lanes = over_poses(plant, 1)
    chain = close_chain(lanes, pose.T, jnp.zeros_like(pose.T))
    gamma = link_angle(chain)
    nearest = jnp.min(jnp.minimum(plant.legs.side(gamma), jnp.pi / 2 - jnp.abs(gamma)))
    return jnp.minimum(nearest, jnp.min(hold(chain)))


def hold(chain: Chain) -> Array:
    """How firmly links of given length hold the platform [1], (): from 0, not at all, to 1.

    A point is held by the sine of the angle between two links. Three links whose lines meet in one
    point, or are parallel, let the platform turn about that point. |det| of their directions and
    moments about the centre of the joints, over its largest value; near 0 it is the angle [rad] by
    which the lines miss.

    Args:
        chain: of straight links.
    """
    frame = chain.frame
    x, y = frame.x, frame.y
    if chain.cx is None or chain.cy is None:
        return jnp.abs(x[0] * y[1] - y[0] * x[1])
    from_x, from_y = (c - jnp.mean(c, axis=0) for c in (chain.cx, chain.cy))
    arm = x * from_y - y * from_x
    size = jnp.mean(jnp.sqrt(jnp.maximum(from_x**2 + from_y**2, TINY_AREA)), axis=0)
    determinant = sum(
        arm[i] * (x[j] * y[k] - y[j] * x[k]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    )
    return jnp.abs(determinant) / (size * np.sqrt(6.75))


def over_poses(plant: Plant, axes: int) -> Plant:
    """What `close_chain` needs of a machine, for poses on so many further axes."""

    def wide(x: Array) -> Array:
        return jnp.reshape(x, (*jnp.shape(x), *(1,) * axes))

    return plant._replace(
        legs=jax.tree.map(wide, plant.legs),
        joint_cos=None if plant.joint_cos is None else wide(plant.joint_cos),
        joint_sin=None if plant.joint_sin is None else wide(plant.joint_sin),
        length=wide(plant.length),
    )


def inverse_kinematics(
    plant: Plant, pose: Num[Array, "... pose"], pose_rate: Num[Array, "... pose"]
) -> tuple[Num[Array, "... links"], Num[Array, "... links"]]:
    """Actuated coordinates [m] and rates [m/s] of the unbent machine for poses on any time axis.

    Args:
        plant: the machine.
        pose: [m, m, rad].
        pose_rate: [m/s, m/s, rad/s].

    Returns:
        (rho, rho_rate).

    Example:
        >>> plant = prepare(*paper_case({"link.modes": 2})).loop.plant
        >>> rho, rate = inverse_kinematics(plant, jnp.array(HOME), jnp.array([0.1, 0.0, 0.0]))
        >>> bool(jnp.ptp(rho) < 1e-9)  # all alike at home
        True
    """
    lanes = over_poses(plant, pose.ndim - 1)
    chain = close_chain(lanes, jnp.moveaxis(pose, -1, 0), jnp.moveaxis(pose_rate, -1, 0))
    return jnp.moveaxis(chain.rho, 0, -1), jnp.moveaxis(chain.rho_rate, 0, -1)


def path_status(plant: Plant, pose: Array) -> Array:
    """First bad status along poses of the undeformed machine, with its index.

    Also SINGULAR where the links do not `hold` the platform.

    Args:
        plant: the machine.
        pose: (N, 3) [m, m, rad].

    Returns:
        (code (), index ()): code OK and index 0 if the whole path is fine.
    """
    lanes = over_poses(plant, 1)
    chain = close_chain(lanes, pose.T, jnp.zeros_like(pose.T))
    codes = chain_status(lanes, chain)
    is_loose = (codes == status.OK) & (hold(chain) < SINGULAR_MARGIN)
    codes = jnp.where(is_loose, float(status.SINGULAR), codes)
    index = jnp.argmax(codes != status.OK)
    return codes[index], index


def lift(plant: Plant, pose: Array) -> Array:
    """Distance of the joints C from their guides over the lengths of the links [1], (3,).

    The sine of gamma: a joint beyond 1 is out of reach, one below 0 on the wrong side.

    Args:
        plant: the machine.
        pose: of the undeformed machine, (3,) [m, m, rad].
    """
    return close_chain(plant, pose, jnp.zeros_like(pose)).near.across / plant.length
