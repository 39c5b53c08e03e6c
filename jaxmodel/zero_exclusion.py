"""Return difference of a sampled loop over whole cells of frequency and uncertain numbers.

Unknowns are the rigid part of p coordinates ("the pose" in short, with the elongations of links
that lengthen), the low modes of each link and the commands m at one point of the unit circle; F is
linear in them, and the loop has an eigenvalue there if and only if F is singular. For a cell, F is
a disc of matrices (`jaxmodel.discs`): a centre and how far entries can move. If no member is
singular on any cell of a box, and one point of the box is stable, then all of it is: the zero
exclusion principle. docs/theory.md, "A proven box".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.discs import Disc, interval, inverse_of, largest_over, maxima_over_slices, phase
from jaxmodel.modal_loop import LawPoles, ModalLoop, law_poles, law_response
from jaxmodel.mode_tail import Tail, bound_tail, least_denominator, pose_scale, static_rest
from jaxmodel.parameters import Array, Num

#: Images on either side whose direct responses are evaluated rather than bounded.
NEAR = 2

#: The coordinates of a cell, in this order: nu = omega/sqrt(E) [rad/s], factor E on the stiffness
#: of all links [1], extra delay of all commands [samples], payload [kg], factor on all gains [1].
COORDINATES = ("nu", "stiffness", "delay", "payload", "gain")


class Exclusion(NamedTuple):
    """A loop prepared for a box."""

    loop: ModalLoop  # NumPy arrays, the rigid part in coordinates of unit mass
    law: LawPoles
    tail: Tail  # sizes zero: the model's modes only
    base: int  # modes that are evaluated
    low: int  # of them, those that are unknowns of F
    middle: Num[Array, "U p"]  # half the static answer of sensors to the pose beyond the base modes
    rest: Num[Array, "links K K"]  # static answer beside the low modes
    images: list[Array]  # of the tail, maxima over 1, 2, 4, ... slices


def prepare_exclusion(
    loop: ModalLoop,
    base: int,
    stiffness: tuple[float, float],
    payload: tuple[float, float],
    has_tail: bool,
) -> Exclusion:
    """Everything that does not depend on a cell.

    Args:
        loop: NumPy arrays.
        base: modes of the model.
        stiffness: range of the box [1].
        payload: range of the box [kg].
        has_tail: bound the modes beyond `base` too; otherwise the plant has `base` modes.

    Raises:
        ValueError: there is no bound, or no partial fractions of the law.
    """
    known = loop if has_tail else _without_high(loop, base)
    tail = bound_tail(known, base, NEAR, stiffness, payload[0])
    if tail is None:
        raise ValueError(
            "no bound of the modes that are left out: damping ratios that fall with frequency, or "
            "too little damping"
        )
    if not has_tail:
        tail = Tail(tail.images, *(np.zeros_like(x) for x in tail[1:]))
    edge = 1.1 * np.pi / float(loop.period) / np.sqrt(stiffness[0])
    low = int(np.clip(np.sum(np.min(loop.omega, axis=0) < edge), 1, base))
    scale = pose_scale(loop, payload[0])

    def reduced(x: Array) -> Array:
        return scale @ x @ scale.T

    scaled = loop._replace(
        mass=reduced(loop.mass),
        payload_mass=reduced(loop.payload_mass),
        damping=reduced(loop.damping),
        stiffness=reduced(loop.stiffness),
        axial_damping=reduced(loop.axial_damping),
        axial_stiffness=reduced(loop.axial_stiffness),
        enter=scale @ loop.enter,
        leave=scale @ loop.leave,
        push=scale @ loop.push,
        read=loop.read @ scale.T,
    )
    static = known.leave / loop.omega[:, None] ** 2
    middle = np.einsum("ikr,ipr->ikp", known.sensor[..., base:], scale @ static[..., base:]) / 2
    return Exclusion(
        loop=scaled,
        law=law_poles(loop.law),
        tail=tail,
        base=base,
        low=low,
        middle=middle.reshape(-1, len(scale)),
        rest=static_rest(loop, low),
        images=maxima_over_slices(tail.images),
    )


def _without_high(loop: ModalLoop, base: int) -> ModalLoop:
    """The plant with `base` modes; its static correction stays that of these."""
    on = np.arange(loop.omega.shape[1]) < base
    return loop._replace(
        sensor=loop.sensor * on,
        actuator=loop.actuator * on[:, None],
        enter=loop.enter * on,
        leave=loop.leave * on,
        steepest=(0 * loop.steepest[0], 0 * loop.steepest[1]),
    )


def return_difference(setup: Exclusion, low: Array, high: Array) -> Disc:
    """F over cells.

    Args:
        setup: from `prepare_exclusion`, whose box contains the cells.
        low, high: their corners, see `COORDINATES`, (cells, 5) each.

    Returns:
        Disc of (cells, n, n).
    """
    nu, stiffness, delay, payload, gain = (
        interval(low[:, k], high[:, k]) for k in range(len(COORDINATES))
    )
    root = interval(np.sqrt(low[:, 1]), np.sqrt(high[:, 1]))
    period = float(setup.loop.period)
    ends = np.minimum(
        [low[:, 0] * np.sqrt(low[:, 1]), high[:, 0] * np.sqrt(high[:, 1])], 1.05 * np.pi / period
    )
    omega = interval(*ends)
    mechanical = _mechanics(setup, nu, stiffness, root, payload)
    chains = [_chain(setup.loop, omega, delay, image) for image in range(-NEAR, NEAR + 1)]
    by_voltage, by_pose, by_mode = _sensors(setup, nu, stiffness, root, payload, omega, chains)
    law = law_response(setup.law, omega, period)
    size = by_voltage.mid.shape[1]
    per_stiffness = stiffness.inverse()
    law_y = Disc(law.mid[:, :, :size], law.rad[:, :, :size])
    law_v = Disc(law.mid[:, :, size:], law.rad[:, :, size:])
    late = phase(Disc(omega.mid * period, omega.rad * period))
    times = gain * per_stiffness
    seen = _side_by_side(by_pose, by_mode, by_voltage)
    row = (law_y @ seen) * _lift(times)
    own = law_v * _lift(late * gain)
    mid, rad = -row.mid, row.rad
    mid[:, :, -size:] += np.eye(size) - own.mid
    rad[:, :, -size:] += own.rad
    return Disc(
        np.concatenate([mechanical.mid, mid], axis=1),
        np.concatenate([mechanical.rad, rad], axis=1),
    )


def _lift(x: Disc) -> Disc:
    return Disc(x.mid[:, None, None], x.rad[:, None, None])


def _side_by_side(*parts: Disc) -> Disc:
    return Disc(
        np.concatenate([x.mid for x in parts], axis=2),
        np.concatenate([x.rad for x in parts], axis=2),
    )


def _square(x: Disc) -> Disc:
    """Of real intervals, exactly."""
    return interval((x.mid - x.rad) ** 2, (x.mid + x.rad) ** 2)


class _Resonance(NamedTuple):
    """Of modes, (cells, 3, modes)."""

    x2: Disc  # (nu/omega_j)^2
    denominator: Disc  # 1 + spring/E - x^2 + 2 i zeta x
    inverse: Disc


def _resonance(
    setup: Exclusion, nu: Disc, stiffness: Disc, first: int, last: int, is_inverted: bool = True
) -> _Resonance:
    """Links with the same modes are evaluated once, (cells, 1, modes)."""
    loop, modes = setup.loop, slice(first, last)
    omega, zeta, spring = (x[:, modes] for x in (loop.omega, loop.zeta, loop.spring))
    if all(np.allclose(x, x[:1], rtol=1e-14, atol=0) for x in (omega, zeta, spring)):
        omega, zeta, spring = omega[:1], zeta[:1], spring[:1]
    x = Disc(nu.mid[:, None, None] / omega, nu.rad[:, None, None] / omega)
    x2 = _square(x)
    soft = stiffness.inverse()
    sprung = Disc(1 + spring * soft.mid[:, None, None], np.abs(spring) * soft.rad[:, None, None])
    # along nu, -x^2 + 2 i zeta x moves by (-2 x + 2 i zeta) dx - dx^2
    mid = sprung.mid - x.mid**2 + 2j * zeta * x.mid
    rad = sprung.rad + 2 * np.hypot(x.mid, zeta) * x.rad + x.rad**2
    denominator = Disc(mid, rad)
    if not is_inverted:
        return _Resonance(x2, denominator, denominator)
    least = least_denominator(np.maximum(sprung.mid - sprung.rad, 1e-3), zeta)
    return _Resonance(x2, denominator, denominator.inverse(least))


def _mass(loop: ModalLoop, payload: Disc) -> Disc:
    return Disc(loop.mass + 0j, 0 * loop.mass) + _lift(payload).scaled(loop.payload_mass)


def _springs(loop: ModalLoop, nu: Disc, root: Disc, stiffness: Disc) -> Disc:
    """Forces of drives and of links along themselves, by pose and over E, (cells, p, p)."""
    drive = _lift(nu * root.inverse()).scaled(1j * loop.damping)
    drive = drive + _lift(stiffness.inverse()).scaled(loop.stiffness)
    along = _lift(nu * root).scaled(1j * loop.axial_damping)
    return drive + along + Disc(loop.axial_stiffness, 0 * loop.axial_stiffness)


def _mechanics(setup: Exclusion, nu: Disc, stiffness: Disc, root: Disc, payload: Disc) -> Disc:
    """Rows of the pose and of the low modes; columns: pose, low modes, commands."""
    loop, low, tail = setup.loop, setup.low, setup.tail
    links, patches, _ = loop.sensor.shape
    n, p = len(nu.mid), len(loop.mass)
    first = p + links * low  # of the commands
    size = first + links * patches
    mid, rad = np.zeros((n, first, size), complex), np.zeros((n, first, size))
    nu2 = _lift(_square(nu))
    pose = _springs(loop, nu, root, stiffness) + (_mass(loop, payload) * nu2).scaled(-1.0)
    high = _resonance(setup, nu, stiffness, low, setup.base)
    enter, leave = loop.enter[:, :, low : setup.base], loop.leave[:, :, low : setup.base]
    pull = loop.actuator[:, low : setup.base] / loop.omega[:, low : setup.base, None] ** 2
    # M - sum enter x^2 leave/D of the modes above: what they add to the pose
    weigh = high.inverse * high.x2
    pose = pose + _over_modes("ipr,cir,iqr->cpq", enter, weigh, leave) * nu2.scaled(-1.0)
    forced = _over_modes("ipr,cir,irk->cpik", enter, high.inverse, pull)
    forced = Disc(*(x.reshape(n, p, -1) for x in forced)) * nu2.scaled(-1.0)
    reach = nu2.mid + nu2.rad
    mid[:, :p, :p], rad[:, :p, :p] = pose.mid, pose.rad + reach**2 * tail.pose_by_pose
    mid[:, :p, first:] = forced.mid - loop.push
    rad[:, :p, first:] = forced.rad + reach * tail.pose_by_voltage
    own = _resonance(setup, nu, stiffness, 0, low, is_inverted=False)
    for i in range(links):
        at, link = slice(p + i * low, p + (i + 1) * low), i % own.denominator.mid.shape[1]
        enters = loop.enter[i, :, :low]
        mid[:, :p, at], rad[:, :p, at] = -nu2.mid * enters, nu2.rad * np.abs(enters)
        each = np.arange(at.start, at.stop)
        mid[:, each, each] = own.denominator.mid[:, link]
        rad[:, each, each] = own.denominator.rad[:, link]
        leaves = loop.leave[i, :, :low].T
        mid[:, at, :p] = -own.x2.mid[:, link, :, None] * leaves
        rad[:, at, :p] = own.x2.rad[:, link, :, None] * np.abs(leaves)
        ports = slice(first + i * patches, first + (i + 1) * patches)
        mid[:, at, ports] = -loop.actuator[i, :low] / loop.omega[i, :low, None] ** 2
    return Disc(mid, rad)


def _over_modes(path: str, one: Array, weight: Disc, other: Array) -> Disc:
    """Sum over modes of one weight other."""
    spread = np.broadcast_to(weight.mid, (len(weight.mid), len(one), weight.mid.shape[2]))
    rad = np.broadcast_to(weight.rad, spread.shape)
    return Disc(
        np.einsum(path, one, spread, other, optimize=True),
        np.einsum(path, np.abs(one), rad, np.abs(other), optimize=True),
    )


def _chain(loop: ModalLoop, omega: Disc, delay: Disc, image: int) -> Disc:
    """From command to voltage, and from sensor to converter, at one image, (cells,)."""
    period = float(loop.period)
    at = Disc(omega.mid + image * 2 * np.pi / period, omega.rad)
    late = at * delay.scaled(period)
    late = Disc(late.mid + omega.mid * period, late.rad + omega.rad * period)
    if image == 0:
        half = omega.mid * period / 2
        hold = Disc(np.exp(-1j * half) * np.sinc(half / np.pi), omega.rad * period / 2)
    else:
        nearest = np.abs(at.mid) - at.rad
        begun = 1 - np.exp(-1j * omega.mid * period)
        slope = 1 / nearest + np.minimum(np.abs(begun) + omega.rad * period, 2) / (
            period * nearest**2
        )
        hold = Disc(begun / (1j * at.mid * period), omega.rad * slope)
    corner = float(loop.antialias)
    x = Disc(at.mid / corner, at.rad / corner)
    below = Disc(
        1 - x.mid**2 + np.sqrt(2) * 1j * x.mid,
        np.abs(np.sqrt(2) * 1j - 2 * x.mid) * x.rad + x.rad**2,
    )
    chain = phase(late) * hold * below.inverse(1 + 0 * x.mid)
    if loop.highpass is not None:
        corner = float(loop.highpass)
        # s/(s + c) = 1 - c/(s + c)
        pole = Disc(1j * at.mid + corner, at.rad).inverse(corner + 0 * at.mid).scaled(-corner)
        chain = chain * Disc(1 + pole.mid, pole.rad)
    if loop.lag is not None:
        lag = float(loop.lag)
        chain = chain * Disc(1j * at.mid * lag + 1, at.rad * lag).inverse(1 + 0 * at.mid)
    return chain


def _sensors(
    setup: Exclusion,
    nu: Disc,
    stiffness: Disc,
    root: Disc,
    payload: Disc,
    omega: Disc,
    chains: list[Disc],
) -> tuple[Disc, Disc, Disc]:
    """Sampled voltages times E by commands, pose and low modes, (cells, U, U or p or n J)."""
    loop, tail, low, base = setup.loop, setup.tail, setup.low, setup.base
    links, patches, _ = loop.sensor.shape
    size, n = links * patches, len(nu.mid)
    sense, leave = loop.sensor[:, :, low:base], loop.leave[:, :, low:base]
    pull = loop.actuator / loop.omega[:, :, None] ** 2
    high = _resonance(setup, nu, stiffness, low, base)
    first = _lift(chains[NEAR])
    blocks = _over_modes("ikr,cir,irl->cikl", sense, high.inverse, pull[:, low:base])
    blocks = Disc(blocks.mid + _rest_of(setup, base), blocks.rad)
    direct = _on_diagonal(blocks) * first
    whole = _near_images(setup, omega, root, stiffness, payload, chains, pull)
    left_out = largest_over(setup.images, omega, float(loop.period))
    direct = Disc(direct.mid + whole.mid, direct.rad + whole.rad + left_out)
    turned = _over_modes("ikr,cir,ipr->cikp", sense, high.inverse * high.x2, leave)
    by_pose = Disc(*(x.reshape(n, size, len(loop.mass)) for x in turned))
    reach = (nu.mid + nu.rad)[:, None, None] ** 2
    by_pose = by_pose + _lift(_square(nu)).scaled(setup.middle)
    by_pose = Disc(by_pose.mid + loop.read, by_pose.rad + reach * tail.sensor_by_pose) * first
    seen = np.zeros((size, links * low))
    for i in range(links):
        seen[i * patches : (i + 1) * patches, i * low : (i + 1) * low] = loop.sensor[i, :, :low]
    return direct, by_pose, first.scaled(seen)


def _rest_of(setup: Exclusion, base: int) -> Array:
    """Static answer beside the base modes, (3, K, K)."""
    loop, modes = setup.loop, slice(setup.low, base)
    if loop.exact is None:
        return setup.rest
    soft = 1 / loop.omega[:, modes] ** 2
    return setup.rest - np.einsum(
        "ikr,ir,irl->ikl", loop.sensor[:, :, modes], soft, loop.actuator[:, modes]
    )


def _near_images(
    setup: Exclusion,
    omega: Disc,
    root: Disc,
    stiffness: Disc,
    payload: Disc,
    chains: list[Disc],
    pull: Array,
) -> Disc:
    """Near images, from commands to sampled voltages times E, (cells, U, U)."""
    loop, base = setup.loop, setup.base
    total = None
    for image, chain in zip(range(-NEAR, NEAR + 1), chains, strict=True):
        if image == 0:
            continue
        shifted = Disc(np.abs(omega.mid + image * 2 * np.pi / float(loop.period)), omega.rad)
        at = shifted * root.inverse()
        each = _resonance(setup, at, stiffness, 0, base)
        sense, pulled = loop.sensor[:, :, :base], pull[:, :base]
        blocks = _over_modes("ikr,cir,irl->cikl", sense, each.inverse, pulled)
        blocks = Disc(blocks.mid + _rest_of(setup, base), blocks.rad)
        springs = _springs(loop, at, root, stiffness)
        mass = _mass(loop, payload)
        part = _on_diagonal(blocks) + _through_pose(setup, each, at, mass, springs, pulled)
        if image < 0:  # evaluated at -omega
            part = Disc(np.conj(part.mid), part.rad)
        part = part * _lift(chain)
        total = part if total is None else total + part
    assert total is not None
    return total


def _through_pose(
    setup: Exclusion, each: _Resonance, nu: Disc, mass: Disc, springs: Disc, pull: Array
) -> Disc:
    """From voltage to pose to sensor of the base modes, (cells, U, U).

    (M - springs/nu^2 + sum enter x^2 leave/D) p = -(push/nu^2 + sum enter pull/D) u.
    """
    loop, base, n = setup.loop, setup.base, len(nu.mid)
    enter, leave = loop.enter[:, :, :base], loop.leave[:, :, :base]
    moved = each.inverse * each.x2
    own = _over_modes("ipr,cir,iqr->cpq", enter, moved, leave)
    slowness = _lift(_square(nu).inverse())
    whole = own + mass + (springs * slowness).scaled(-1.0)
    pushed = _over_modes("ipr,cir,irk->cpik", enter, each.inverse, pull)
    seen = _over_modes("ikr,cir,ipr->cikp", loop.sensor[:, :, :base], moved, leave)
    p = len(loop.mass)
    pushed = Disc(*(x.reshape(n, p, -1) for x in pushed)) + slowness.scaled(loop.push)
    seen = Disc(*(x.reshape(n, -1, p) for x in seen)) + Disc(loop.read, 0 * loop.read)
    return (seen @ inverse_of(whole) @ pushed).scaled(-1.0)


def _on_diagonal(blocks: Disc) -> Disc:
    def whole(x: Array) -> Array:
        n, links, a, b = x.shape
        full = np.zeros((n, links, a, links, b), x.dtype)
        for i in range(links):
            full[:, i, :, i] = x[:, i]
        return full.reshape(n, links * a, links * b)

    return Disc(whole(blocks.mid), whole(blocks.rad))
